"""What a C source has besides its kernels: helpers, and the types of records."""

from collections.abc import Iterable
from typing import Final

from rig.plc_export.tree.nodes import RecordType, RowsType, StructType, Type

GENERATED: Final = "/* Written by Coldloop from the kernels of its optimiser; changes belong there. */\n"


def helpers(real: str, kernels: str) -> str:
    """Return what kernels call: min and max as they have them, and division that rounds down."""
    known = {
        **{
            f"{name}_{of}": f"static inline {kind} {name}_{of}({kind} one, {kind} other) {{\n"
                            f"    return other {sign} one ? other : one;\n}}\n"
            for of, kind in (("real", real), ("int", "int32_t")) for name, sign in (("min", "<"), ("max", ">"))
        },
        "floor_mod": """static inline int32_t floor_mod(int32_t one, int32_t other) {
    const int32_t rest = one % other;
    return rest < 0 ? rest + other : rest;
}
""",
        "floor_div": """static inline int32_t floor_div(int32_t one, int32_t other) {
    return (one - floor_mod(one, other)) / other;
}
""",
    }  # fmt: skip
    divided = "floor_div(" in kernels
    return "".join(text for name, text in known.items()
                   if f"{name}(" in kernels or (divided and name == "floor_mod"))  # fmt: skip


def records_in(types: Iterable[Type]) -> list[RecordType | StructType]:
    """Return the types of records, once for each name, fields before what has them."""
    found: dict[str, RecordType | StructType] = {}

    def visit(kind: Type) -> None:
        if isinstance(kind, RowsType):
            visit(kind.struct)
        elif isinstance(kind, RecordType | StructType):
            for _, field in kind.fields:
                visit(field)
            found.setdefault(kind.name, kind)

    for kind in types:
        visit(kind)
    return list(found.values())
