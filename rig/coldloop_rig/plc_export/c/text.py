"""What a C source has besides its kernels: helpers, and the types of records."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from coldloop_rig.plc_export.c.printer import Array, Printer, identifier
from coldloop_rig.plc_export.tree.nodes import Function, Kind, RecordType, RowsType, StructType, Type

GENERATED: Final = "/* Written by Coldloop from the kernels of its optimiser; changes belong there. */\n"


SUMS: Final = ("sum_of_constants", "sum_of_reals", "sum_of_integers")


class KernelFiles:
    """Kernels as two files, whose literals are for a file of tables.

    A compiler that sees a table copies its numbers into the code, and a sum over the table is not one over the copies.

    Args:
        printer: It gets their literals.
        functions: Callees before their callers.
        entries: Those that others call.
        part: Part of the export; what the linker sees has this prefix, so that several parts link in one program.
        tables: Names of the part's tables that the linker sees, beside the literals.
        more: Types of records beside those of the parameters.
    """

    def __init__(
        self, printer: Printer, functions: Sequence[Function], entries: Sequence[Function], part: str,
        tables: Iterable[str], more: Iterable[Type] = (),
    ) -> None:  # fmt: skip
        self._printer, self._entries = printer, entries
        seen = (*(identifier(each.name) for each in entries), printer.table, *SUMS, *tables)
        self._names = "".join(f"#define {each} {part}_kernel_{each}\n" for each in seen)
        self._real = printer.scalars[Kind.REAL]
        self._text = "\n".join(printer.function(each, "" if each in entries else "static ") for each in functions)
        self.records = records_in([*(one.type for each in functions for one in each.parameters), *more])

    def texts(self) -> dict[str, str]:
        """Return the texts of the files by their names."""
        printer = self._printer
        records = "\n".join(map(printer.structure, self.records))
        signatures = "\n".join(f"{printer.signature(each)};" for each in self._entries)
        return {
            "kernels.h": f"""{GENERATED}#ifndef KERNELS_H
#define KERNELS_H

#include <stdbool.h>
#include <stdint.h>

/* Names that the linker sees. */
{self._names}
#define N_LITERALS {len(printer.literals)}
extern const {self._real} literals[N_LITERALS];

{records}
{signatures}

#endif
""",
            "kernels.c": f"""{GENERATED}#include <math.h>

#include "kernels.h"

{helpers(self._real, self._text)}
{self._text}""",
        }

    def literals(self) -> str:
        """Return the definition of the table of literals, for a file without kernels."""
        listed = "".join(f"    {each},\n" for each in self._printer.literals)
        return f"const {self._real} literals[N_LITERALS] = {{\n{listed}}};\n"


def golden_files(printer: Printer, sum_: int, tables: Mapping[str, Array], **sizes: int) -> dict[str, str]:
    """Return the files of golden vectors: tables by name with lengths, the sum over them, and sizes by name."""
    defined = "".join(f"#define {name} {size}\n" for name, size in sizes.items())
    externs = "".join(f"extern const {printer.scalar(values)} {name};\n" for name, values in tables.items())
    arrays = "\n".join(printer.tabulated(name, values) for name, values in tables.items())
    return {"golden.h": f"{GENERATED}#include <stdint.h>\n\n{defined}#define SUM_OF_GOLDEN UINT32_C({sum_})\n{externs}",
            "golden.c": f'{GENERATED}#include <math.h>\n\n#include "golden.h"\n\n{arrays}'}  # fmt: skip


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
