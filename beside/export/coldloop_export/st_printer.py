"""Blocks and constants as IEC 61131-3 Structured Text (third edition): REAL and DINT, arrays of one dimension."""

import math
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final

import numpy as np

from coldloop_export import golden, st_lowering, tree
from coldloop_export.tree import ArrayType, Block, Call, Convert, Kind, Name, Path, Statement, Type, type_of
from coldloop_rig.text_tables import markdown_table

LONGEST: Final = 32
"""Significant characters of a name in every tool."""
PREFIX: Final = "cl_"
"""Prefix of all global names: types, functions, function blocks and constants."""
KEYWORDS: Final = tree.template("structured_text/keywords.txt")


def identifier(name: str) -> str:
    """Return a name with its letters and digits, changed where it is a keyword or too long."""
    plain = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", name)).strip("_") or "unused"
    plain = f"{plain}_v" if re.search(rf"\b{plain.lower()}\b", KEYWORDS) else plain
    if len(plain) <= LONGEST:
        return plain
    return f"{plain[: LONGEST - 9].rstrip('_')}_{zlib.crc32(plain.encode()):08x}"


class Names:
    """Names within one function block, which are case-insensitive; each key has one."""

    def __init__(self) -> None:
        self._of: dict[object, str] = {}
        self._taken: set[str] = set()

    def __call__(self, key: object, wanted: str) -> str:
        """Return the name of a key; at first the one that is wanted, or it with a number."""
        if key not in self._of:
            plain = identifier(wanted)
            found, number = plain, 2
            while found.lower() in self._taken:
                found, number = identifier(f"{plain}_{number}"), number + 1
            self._of[key] = found
            self._taken.add(found.lower())
        return self._of[key]


_FOR: Final = re.compile(r"( *)FOR (\w+) := (.+) TO (.+?)(?: BY (-?\d+))? DO")


def portable(text: str) -> str:
    """Return Structured Text with a WHILE for each FOR that may have a single round: newer MATIEC leaves that one out.

    Bounds do not change within a loop of this package.
    """
    lines, steps = [], list[str]()
    for line in text.split("\n"):
        if found := _FOR.fullmatch(line):
            pad, name, first, last, by = found.groups()
            step = int(by or 1)
            if first.isdigit() and last.isdigit() and (int(last) - int(first)) // step > 0:
                steps.append("")
                lines.append(line)
                continue
            steps.append(f"{pad}    {name} := ({name} {'+' if step > 0 else '-'} {abs(step)});\n{pad}END_WHILE;")
            lines += [f"{pad}{name} := {first};", f"{pad}WHILE ({name} {'<=' if step > 0 else '>='} {last}) DO"]
        else:
            lines.append((line.strip() == "END_FOR;" and steps.pop()) or line)
    return "\n".join(lines)


VERDICT: Final = "cl_verdict"
LENGTH: Final = 10
"""Integers that the verdict has room for."""
COMMON: Final = ("done", "passed", "failures", "what", "vector")
"""Outputs of each self-test; two truth values, which are 0 or 1."""


def main_program(outputs: Sequence[str]) -> str:
    """Return the program; `outputs` are those of the self-test beside the common ones, integers."""
    puts = "".join(
        f"    {VERDICT}[{place}] := {f'BOOL_TO_DINT(test.{name})' if name in COMMON[:2] else f'test.{name}'};\n"
        for place, name in enumerate((*COMMON, *outputs))
    )
    parts = {"VERDICT": VERDICT, "LENGTH": str(LENGTH), "PUTS": puts}
    return tree.filled(tree.template("structured_text/main.st"), parts)


def verdict_table(outputs: Sequence[str]) -> str:
    """Return what is where in the verdict, for registers of two words each."""
    rows = [
        (f"`{VERDICT}[{place}]`", f"+{2 * place}", f"`test.{name}`") for place, name in enumerate((*COMMON, *outputs))
    ]
    return markdown_table(("integer", "register", ""), rows)


SCALARS: Final = {Kind.REAL: "REAL", Kind.INT: "DINT", Kind.UNSIGNED: "DINT", Kind.BOOL: "BOOL"}
DOUBLE: Final = {**SCALARS, Kind.REAL: "LREAL"}
BYTES: Final = {"REAL": 4, "LREAL": 8, "DINT": 4, "BOOL": 1}
OPERATORS: Final = {
    "and": "({0} AND {1})", "or": "({0} OR {1})", "==": "({0} = {1})", "!=": "({0} <> {1})", "not": "(NOT {0})",
    "negative": "(-{0})", "sqrt": "SQRT({0})", "abs": "ABS({0})", "power": "EXPT({0}, {1})", "log": "LN({0})",
    "min": "cl_min_{kind}({0}, {1})", "max": "cl_max_{kind}({0}, {1})", "round": "cl_round({0})",
    "copysign": "cl_copysign({0}, {1})", "%": "cl_floor_mod({0}, {1})", "//": "cl_floor_div({0}, {1})",
    "isinf": "(NOT cl_is_finite({0}))", "isnan": "(NOT cl_is_finite({0}))", "isfinite": "cl_is_finite({0})",
    "single": "{0}",
}  # fmt: skip
OF_DOUBLE: Final = {"isfinite": "cl_is_finite_lreal({0})", "single": "REAL_TO_LREAL(LREAL_TO_REAL({0}))"}
NO_NOTES: Final[Mapping[str, str]] = {}
TABLE: Final = f"{PREFIX}literals"
LARGEST: Final = np.finfo(np.float32).max
"""Largest number of single precision, printed in the place of infinities and NaN, for which there is no literal."""


class StructuredTextPrinter(tree.TreePrinter):
    """Prints blocks; keeps the types of arrays that they use.

    Args:
        variables: Types of the fields of records that are global: constants and state.
        real: Single or double precision.
    """

    table, truth = TABLE, ("FALSE", "TRUE")

    def __init__(self, variables: Mapping[Path, Type], real: type[np.floating] = np.float32) -> None:
        super().__init__(real)
        self.scalars = SCALARS if self.single else DOUBLE
        self.operators = OPERATORS if self.single else {**OPERATORS, **OF_DOUBLE}
        self.kinds = {kind: scalar.lower() for kind, scalar in self.scalars.items()}
        self.globals = variables
        self.arrays: dict[str, str] = {}
        """Definition of each type of arrays, by its name."""
        self._names, self._notes, self._uses_literals = Names(), NO_NOTES, False

    def number(self, value: float) -> str:
        """Return an initial value with enough digits for its bits; the largest one in the place of a non-finite one.

        A type is named where there is no sign, as not every tool takes one behind `REAL#`.
        """
        finite = value if np.isfinite(value) else LARGEST * (-1 if value < 0 else 1)
        text = f"{np.float32(finite):.9E}" if self.single else f"{float(finite):.16E}"
        return text if text.startswith("-") else f"{self.scalars[Kind.REAL]}#{text}"

    def literal(self, value: float) -> str:
        """Return the element of the table that has this value."""
        self._uses_literals = True
        return super().literal(value)

    def type(self, kind: Type) -> str:
        """Return the name of a type of numbers or of arrays."""
        if isinstance(kind, Kind):
            return self.scalars[kind]
        assert isinstance(kind, ArrayType)  # noqa: S101 blocks have no records
        return self.array_type(self.scalars[kind.kind], kind.size)

    def array_type(self, scalar: str, size: int) -> str:
        """Return the name of a type of arrays, which is then among those to be defined."""
        name = f"{PREFIX}{scalar.lower()}s_{max(size, 1)}"
        self.arrays[name] = f"ARRAY [0..{max(size, 1) - 1}] OF {scalar}"
        return name

    def types(self) -> str:
        """Return the definitions of the types of arrays so far, and of the table of literals."""
        self.arrays[f"{TABLE}_table"] = f"ARRAY [0..{len(self.literals) - 1}] OF {self.scalars[Kind.REAL]}"
        return "".join(f"TYPE\n    {name} : {definition};\nEND_TYPE\n"
                       for name, definition in sorted(self.arrays.items()))  # fmt: skip

    def block(self, block: Block, notes: Mapping[str, str] = NO_NOTES) -> str:
        """Return a function block; variables that have a note are outputs, too."""
        self._names, self._uses_literals = Names(), False
        self._notes = notes
        inputs, shared = self._declared(block.inputs), self._declared(block.shared)
        outputs = self._declared([*block.outputs, *(each for each in block.variables if each.name in notes)])
        outside = {global_name(path): self.type(self.globals[path]) for path in block.constants}
        variables = self._declared([each for each in block.variables if each.name not in notes])
        body = [*self._body(block.body)]
        variables |= {self._instance(each): block_name(each) for each in block.called}
        if self._uses_literals:
            outside[TABLE] = f"{TABLE}_table"
        head = comment(f"{tree.place_of(block.source)}: {block.summary}")
        return "".join([
            head, f"FUNCTION_BLOCK {block_name(block)}\n", section("VAR_INPUT", inputs),
            section("VAR_IN_OUT", shared), section("VAR_OUTPUT", outputs), section("VAR_EXTERNAL", outside),
            section("VAR", variables), *(f"{line}\n" for line in body), "END_FUNCTION_BLOCK\n",
        ])  # fmt: skip

    def _declared(self, names: Iterable[Name]) -> dict[str, str]:
        notes = {name: f" (* {note} *)" for name, note in self._notes.items()}
        return {self._local(each): self.type(each.type) + notes.get(each.name, "") for each in names}

    def _local(self, name: Name) -> str:
        """Return the name of a variable; those of one name and type are one variable."""
        return self._names((name.name, self.type(name.type)), name.name)

    def _instance(self, block: Block) -> str:
        return self._names(block, f"do_{block.name}")

    def _statement(self, statement: Statement) -> Iterator[str]:  # noqa: C901 one case a statement
        match statement:
            case tree.Assign(target, value):
                yield f"{self.expression(target)} := {self.expression(value)};"
            case Call():
                yield from self._call(statement)
            case tree.PausingCall(call, anew, busy, following):
                yield from self._call(replace(call, results=()))
                yield f"{self._local(anew)} := FALSE;"
                paused = interface_names(call.block, self.type)[busy]
                yield f"IF (NOT {self._instance(call.block)}.{paused}) THEN"
                yield from ("    " + line for line in self._taken(call))
                yield from self._body(following)
                yield "END_IF;"
            case tree.Switch(number, cases):
                yield f"CASE {self._local(number)} OF"
                for case, body in cases:
                    yield f"    {case}:"
                    yield from (f"    {line}" for line in self._body(body))
                yield "END_CASE;"
            case tree.Count(variable, first, last, step, body):
                by = f" BY {step}" if step != 1 else ""
                bounds = f"{self.expression(first)} TO {self.expression(last)}{by}"
                yield from self._nested(f"FOR {self._local(variable)} := {bounds} DO", body, "END_FOR;")
            case tree.While(condition, body):
                yield from self._nested(f"WHILE {self.expression(condition)} DO", body, "END_WHILE;")
            case tree.If(condition, body, other):
                yield from self._nested(f"IF {self.expression(condition)} THEN", body, "ELSE" if other else "END_IF;")
                if other:
                    yield from self._body(other)
                    yield "END_IF;"
            case tree.Return():
                yield "RETURN;"

    def _call(self, call: Call) -> Iterator[str]:
        instance, inside = self._instance(call.block), interface_names(call.block, self.type)
        passed = [f"{inside[each]} := {self.expression(value)}" for each, value in call.arguments]
        yield f"{instance}({'' if passed else ');'}"
        yield from (f"    {each}{',' if each is not passed[-1] else ');'}" for each in passed)
        yield from self._taken(call)

    def _taken(self, call: Call) -> Iterator[str]:
        instance, inside = self._instance(call.block), interface_names(call.block, self.type)
        yield from (f"{self._local(variable)} := {instance}.{inside[output]};" for variable, output in call.results)

    def _other(self, expression: tree.Expression) -> str:
        match expression:
            case Name(_, name):
                path = tuple(name.split("."))
                return global_name(path) if path in self.globals else self._local(expression)
            case Convert(Kind.REAL, operand):
                return f"DINT_TO_{self.scalars[Kind.REAL]}({self.expression(operand)})"
            case Convert(Kind.BOOL, operand):
                return f"({self.expression(operand)} <> 0)"
            case Convert(_, operand) if operand.type is Kind.BOOL:
                return f"BOOL_TO_DINT({self.expression(operand)})"
            case Convert(_, operand):
                return self.expression(operand)
        raise AssertionError(expression)  # lowering leaves no other


def interface_names(block: Block, type_of: Callable[[Type], str]) -> dict[Name, str]:
    """Return the names of a block's parameters, as it is printed: they are named first."""
    names = Names()
    return {each: names((each.name, type_of(each.type)), each.name)
            for each in (*block.inputs, *block.shared, *block.outputs)}  # fmt: skip


def passed_by_name(block: Block, parameters: Iterable[Name], type_of: Callable[[Type], str], indent: int) -> str:
    """Return arguments of a call, a line each: variables with the last parts of the parameters' names."""
    names = interface_names(block, type_of)
    return ",\n".join(f"{' ' * indent}{names[each]} := {each.name.rstrip('.').rpartition('.')[2]}"
                      for each in parameters)  # fmt: skip


def block_name(block: Block) -> str:
    """Return the name of the type of a block."""
    return identifier(f"{PREFIX}{block.name}")


def global_name(path: Path) -> str:
    """Return the name of a constant or of the state: the fields that lead to it."""
    return identifier(PREFIX + "_".join(each for each in path[1:] if each != "numbers").lower())


def section(head: str, declared: Mapping[str, str]) -> str:
    """Return declarations under their keyword; nothing where there are none."""
    body = "".join(f"    {name} : {kind};\n" for name, kind in declared.items())
    return f"{head}\n{body}END_VAR\n" if body else ""


def comment(text: str) -> str:
    """Return a comment of one line."""
    return f"(* {text.replace('*)', '* )')} *)\n"


def memory(block: Block, scalars: Mapping[Kind, str] = SCALARS) -> int:
    """Return the bytes of an instance: numbers, arrays and the instances within; without references to arrays."""
    own = sum(size_of(each.type, scalars) for each in (*block.inputs, *block.outputs, *block.variables))
    return own + sum(memory(each, scalars) for each in block.called)


def size_of(kind: Type, scalars: Mapping[Kind, str] = SCALARS) -> int:
    """Return the bytes of a number or of an array."""
    if isinstance(kind, ArrayType):
        return max(kind.size, 1) * BYTES[scalars[kind.kind]]
    assert isinstance(kind, Kind)  # noqa: S101 blocks have no records
    return BYTES[scalars[kind]]


LARGEST_LIST: Final = 64 * 1024
"""Bytes of a list of constants: a data block of standard access of an S7-1200 or S7-1500 holds no more."""
PRIME, FACTOR = 65521, 257
PARTS: Final = 3
"""Integers that the bits of a number in double precision are read as."""
LEAST_EXPONENT: Final = -1100
"""Exponent below that of the smallest number of double precision."""


class Constants:
    """Read-only values as `VAR_GLOBAL`: the literals of a printer, and values by the fields that lead to them.

    Not every tool takes `VAR_EXTERNAL CONSTANT`, which would have to go with `VAR_GLOBAL CONSTANT`.
    """

    def __init__(self, values: Mapping[Path, golden.Array], printer: StructuredTextPrinter) -> None:
        self.values, self.printer = values, printer

    def _weighed(self, of_real: int, of_integer: int) -> list[int]:
        """Return the numbers of each one, those with a point and the others counted so often; first the literals."""
        weights = {"f": of_real}
        return [of_real * len(self.printer.literals), *(weights.get(values.dtype.kind, of_integer) * max(values.size, 1)
                                                        for values in self.values.values())]  # fmt: skip

    def _sizes(self) -> list[int]:
        return self._weighed(4 if self.printer.single else 8, 4)

    def bytes(self) -> int:
        """Return the bytes of all of them."""
        return sum(self._sizes())

    def declared(self) -> dict[str, tuple[str, str]]:
        """Return type and value of each constant by its name."""
        literals = f"[\n        {', '.join(self.printer.literals)}]"
        found = {TABLE: (f"{TABLE}_table", literals)}
        for path, values in self.values.items():
            name = global_name(path)
            if name in found:
                raise tree.UnfitKernelError(f"two constants have the name {name}")
            found[name] = (self.printer.type(type_of(values[()])), self.value(values))
        return found

    def value(self, values: golden.Array) -> str:
        """Return a number, or an array as an initialiser; one without elements has a zero."""
        if values.dtype.kind == "b":
            return "TRUE" if values else "FALSE"
        number = self.printer.number if values.dtype.kind == "f" else lambda each: str(int(each))
        printed = [number(each) for each in (values.ravel() if values.size else np.zeros(1, values.dtype))]
        rows = [", ".join(printed[place : place + 6]) for place in range(0, len(printed), 6)]
        return f"[\n        {(',' + chr(10) + ' ' * 8).join(rows)}]" if values.ndim else printed[0]

    def lists(self) -> Iterator[str]:
        """Yield lists of constants, none larger than tools take."""
        listed: dict[str, str] = {}
        room = LARGEST_LIST
        for (name, (kind, value)), size in zip(self.declared().items(), self._sizes(), strict=True):
            if size > LARGEST_LIST:
                raise tree.UnfitKernelError(f"{name}: {size} bytes, and a list of constants has at most {LARGEST_LIST}")
            if size > room:
                yield section("VAR_GLOBAL", listed)
                listed, room = {}, LARGEST_LIST
            listed[name] = f"{kind} := {value}"
            room -= size
        yield section("VAR_GLOBAL", listed)

    def configuration(self, state: Mapping[Path, Type] = MappingProxyType({})) -> str:
        """Return the configuration: these lists, a state, room for the self-test's verdict, one task for `cl_main`."""
        listed = section("VAR_GLOBAL", {global_name(path): self.printer.type(kind) for path, kind in state.items()})
        verdict = section("VAR_GLOBAL", {VERDICT: self.printer.array_type("DINT", LENGTH)})
        return configuration([*self.lists(), listed, verdict])

    def sum(self) -> int:
        """Return the sum over all of them that the self-test computes."""
        double = not self.printer.single
        sum_ = sum_of(np.array([float(each.rpartition("#")[2]) for each in self.printer.literals]), double=double)
        for values in self.values.values():
            sum_ = sum_of(values if values.size else np.zeros(1), sum_, double=double)
        return sum_

    def summed(self) -> dict[str, str]:
        """Return the parts of a self-test that sum them up: declarations, lengths, a case for each constant."""
        lengths = self._weighed(1 if self.printer.single else PARTS, 1)
        self.printer.array_type("DINT", len(lengths))
        declared = self.declared()
        return {
            "EXTERNALS": "\n".join(f"    {name} : {kind};" for name, (kind, _) in declared.items()),
            "PARTS": str(len(lengths)), "LENGTHS": ", ".join(map(str, lengths)), "SUM": str(self.sum()),
            "CONSTANTS": "".join(self._item(part, name, values) for part, (name, values)
                                 in enumerate(zip(declared, (None, *self.values.values()), strict=True))).rstrip(),
        }  # fmt: skip

    def _item(self, part: int, name: str, values: golden.Array | None) -> str:
        pad = " " * 20
        if values is not None and values.dtype.kind == "b":
            read = f"IF {name} THEN\n{pad}    item := 1;\n{pad}ELSE\n{pad}    item := 0;\n{pad}END_IF;"
        else:
            real = values is None or values.dtype.kind == "f"
            double = real and not self.printer.single
            place = f"(offset / {PARTS})" if double else "offset"
            element = f"{name}[{place}]" if values is None or values.ndim else name
            bits = f"cl_lreal_bits({element}, (offset MOD {PARTS}))" if double else f"cl_bits({element})"
            read = f"item := {bits if real else element};"
        return f"{pad}{part}:\n{pad}    {read.replace(chr(10), chr(10) + '    ')}\n"


def configuration(lists: Iterable[str]) -> str:
    """Return a configuration with these lists of variables, and one task that runs `cl_main`."""
    return tree.filled(tree.template("structured_text/configuration.st"), {"LISTS": "".join(lists)})


def in_pieces(constants: Mapping[Path, golden.Array]) -> tuple[dict[Path, golden.Array], st_lowering.Split]:
    """Return constants with those that are larger than a list in pieces of whole rows; and which these are."""
    found: dict[Path, golden.Array] = {}
    split: dict[Path, list[tuple[Path, int]]] = {}
    for path, values in constants.items():
        rows = LARGEST_LIST // (4 * values[0].size) if values.ndim > 1 and values.size else 0
        if 4 * values.size <= LARGEST_LIST or not rows:
            found[path] = values
            continue
        pieces = {(*path, str(first)): values[first : first + rows] for first in range(0, len(values), rows)}
        split[path] = [(piece, part.size) for piece, part in pieces.items()]
        found |= pieces
    return found, split


def types_in(values: Mapping[Path, golden.Array]) -> dict[Path, Type]:
    """Return the types of constants."""
    return {path: type_of(each[()]) for path, each in values.items()}


def scalar_of(values: golden.Array) -> str:
    """Return the type of an array's elements."""
    return "REAL" if values.dtype.kind == "f" else "DINT"


def sum_of(values: golden.Array, before: int = 0, *, double: bool = False) -> int:
    """Return the sum over numbers that the self-test computes: no change of one bit leaves it as it is."""
    if values.dtype.kind == "f" and double:
        items = np.array([item for value in values.ravel().tolist() for item in bits_of_double(value)])
    elif values.dtype.kind == "f":
        single = np.nan_to_num(values.astype(np.float32).ravel(), nan=float(LARGEST))
        items = np.abs(single).view(np.int32).astype(int) * np.where(single < 0, -1, 1)
    else:
        items = values.astype(int).ravel()
    for item in items.tolist():
        before = (before * FACTOR + item % PRIME) % PRIME
    return before


def bits_of_double(value: float) -> tuple[int, int, int]:
    """Return exponent, negative where the number is, and the halves of what is behind the point: `cl_lreal_bits`."""
    finite = value if np.isfinite(value) else math.copysign(float(LARGEST), value)
    share, exponent = math.frexp(abs(finite))
    mantissa, exponent = (2.0 * share - 1.0, exponent - 1) if share else (-1.0, LEAST_EXPONENT)
    high, low = divmod(int(mantissa * 2**52), 2**26)
    return (exponent - LEAST_EXPONENT) * (-1 if finite < 0 else 1), high, low


def summing(array: str, scalar: str, length: int) -> str:
    """Return the loop of the self-test that sums up an array."""
    item = f"cl_bits({array}[i])" if scalar == "REAL" else f"{array}[i]"
    return (f"            FOR i := 0 TO {length - 1} DO\n"
            f"                sum := cl_floor_mod(((sum * {FACTOR}) + cl_floor_mod({item}, {PRIME})), {PRIME});\n"
            "            END_FOR;\n")  # fmt: skip
