"""The typed tree as C99: every literal typed, operations in the order of the tree, memory on the stack."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop_export import golden, tree
from coldloop_export.tree import Expression, Function, Kind, Literal, Name, RecordType, RowsType, StructType, Type, View

Array = NDArray[Any]

KEYWORDS: Final = """
    auto break case char const continue default do double else enum extern float for goto if inline int long register
    restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true false
    main y0 y1 j0 j1 gamma
"""
OPERATORS: Final = {
    "and": "({0} && {1})", "or": "({0} || {1})", "not": "(!{0})", "negative": "(-{0})", "min": "min_{kind}({0}, {1})",
    "max": "max_{kind}({0}, {1})", "%": "floor_mod({0}, {1})", "//": "floor_div({0}, {1})", "sqrt": "sqrt@F@({0})",
    "abs": "fabs@F@({0})", "power": "pow@F@({0}, {1})", "log": "log@F@({0})", "copysign": "copysign@F@({0}, {1})",
    "round": "rint@F@({0})",  # a half to the even number, as Python does
    "single": "((@REAL@)(float){0})", **{name: f"({name}({{0}}) != 0)" for name in ("isfinite", "isinf", "isnan")},
}  # fmt: skip
"""Formats of operators and of functions of <math.h>, with @F@ for the suffix of single precision."""


def identifier(name: str) -> str:
    """Return a name that C and its library leave free."""
    return f"{name}_" if re.search(rf"\b{name}\b", KEYWORDS) else name


class Printer(tree.TreePrinter):
    """Prints for one floating-point type."""

    table, truth = "literals", ("false", "true")

    def __init__(self, real: type[np.floating]) -> None:
        super().__init__(real)
        self.scalars = {Kind.REAL: "float" if self.single else "double", Kind.INT: "int32_t",
                        Kind.UNSIGNED: "int32_t", Kind.BOOL: "bool"}  # fmt: skip
        precision = {"F": "f" * self.single, "REAL": self.scalars[Kind.REAL]}
        self.operators = {name: tree.filled(text, precision) for name, text in OPERATORS.items()}
        self.kinds = {**dict.fromkeys(Kind, "int"), Kind.REAL: "real"}
        self._loops = 0
        self._results: tuple[Name, ...] = ()
        self._made: set[Name] = set()
        self._constant: set[str] = set()

    def number(self, value: float) -> str:
        """Return a number as a literal with a point, which keeps its bits; a non-finite one as a macro."""
        if np.isinf(value):
            return "-INFINITY" if value < 0 else "INFINITY"
        if np.isnan(value):
            return "NAN"
        return f"{np.float32(value):.9e}f" if self.single else f"{value:.17e}"

    def declaration(self, kind: Type, name: str, *, constant: bool = True) -> str:
        """Return the declaration of a parameter or of a field."""
        if isinstance(kind, Kind):
            return f"{self.scalars[kind]} {name}"
        return f"{'const ' * constant}{self._element(kind)} *{name}"

    def _element(self, kind: Type) -> str:
        """Return the type of what a pointer to it points to."""
        if isinstance(kind, Kind):
            return self.scalars[kind]
        if isinstance(kind, tree.ArrayType):
            return self.scalars[kind.kind]
        return kind.struct.name if isinstance(kind, RowsType) else kind.name

    def structure(self, record: RecordType | StructType) -> str:
        """Return the declaration of a record's type; the arrays of a state are in it."""
        state = isinstance(record, RecordType) and record.state
        body = "".join(f"    {self._field(identifier(name), kind, state=state)};\n" for name, kind in record.fields)
        return f"typedef struct {{\n{body}}} {record.name};\n"

    def _field(self, name: str, kind: Type, *, state: bool) -> str:
        if isinstance(kind, RecordType):
            return f"{kind.name} {name}"
        if state and isinstance(kind, tree.ArrayType | RowsType):
            length = kind.length if isinstance(kind, RowsType) else max(kind.size, 1)
            return f"{self._element(kind)} {name}[{length}]"
        return self.declaration(kind, name)

    def scalar(self, values: Array) -> str:
        """Return the type of an array's elements."""
        return self.scalars[Kind.REAL] if values.dtype.kind == "f" else "int32_t"

    def array(self, name: str, values: Array, storage: str = "static ") -> str:
        """Return the definition of a constant array; one without elements has a zero."""
        listed = values.ravel() if values.size else np.zeros(1, values.dtype)
        rows = "".join(f"    {row},\n" for row in self._rows(listed, 6))
        return f"{storage}const {self.scalar(values)} {name}[{listed.size}] = {{\n{rows}}};\n"

    def tabulated(self, name: str, values: Array) -> str:
        """Return the definition of a constant array, of numbers or of rows; its name has the lengths."""
        lines = (f"{{{', '.join(self._rows(row, 6))}}}" for row in values) if values.ndim > 1 else self._rows(values, 6)
        rows = "".join(f"    {line},\n" for line in lines)
        return f"const {self.scalar(values)} {name} = {{\n{rows}}};\n"

    def _rows(self, values: Array, width: int) -> Iterator[str]:
        printed = [self.number(each) if values.dtype.kind == "f" else str(int(each)) for each in values]
        yield from (", ".join(printed[place : place + width]) for place in range(0, len(printed), width))

    def signature(self, function: Function) -> str:
        """Return the head of a function."""
        parameters = [self.declaration(each.type, identifier(each.name), constant=each.name not in function.written)
                      for each in function.parameters]  # fmt: skip
        parameters += [f"{self.scalars[each.type.kind if isinstance(each.type, tree.ArrayType) else each.type]} *"
                       f"{each.name}"
                       for each in function.results if isinstance(each.type, tree.ArrayType | Kind)]  # fmt: skip
        value = self.scalars[function.value] if function.value else "void"
        listed = ",\n    ".join(parameters)
        return f"{value} {identifier(function.name)}(\n    {listed}\n)"

    def function(self, function: Function, storage: str = "") -> str:
        """Return a function."""
        self._results, self._made = function.results, set()
        self._constant = {each.name for each in function.parameters if each.name not in function.written}
        unused = [f"    (void){identifier(each.name)};" for each in function.parameters
                  if each.name not in function.used]  # fmt: skip
        body = "".join(f"{line}\n" for line in (*unused, *self._body(function.body)))
        return f"/* {tree.place_of(function.source)} */\n{storage}{self.signature(function)} {{\n{body}}}\n"

    def _statement(self, statement: tree.Statement) -> Iterator[str]:  # noqa: C901, PLR0912 one case a statement
        match statement:
            case tree.Declare(variable, value):
                name, kind = identifier(variable.name), variable.type
                if isinstance(kind, tree.ArrayType):
                    yield f"{self.scalars[kind.kind]} {name}[{max(kind.size, 1)}] = {{0}};"
                else:
                    initial = self._bare(value or Literal(kind, 0)) if isinstance(kind, Kind) else ""
                    yield f"{self.declaration(kind, name)} = {initial};"
            case tree.Assign(target, value):
                place = f"*{target.name}" if target in self._results else self.expression(target)
                yield f"{place} = {self._bare(value)};"
            case tree.Point(variable, part, constant):
                root: Expression = part.array if isinstance(part, View) else part.rows
                while isinstance(root, tree.Field):
                    root = root.record
                fixed = constant or (isinstance(root, Name) and root.name in self._constant)
                self._constant |= {variable.name} if fixed else set()
                declared = self.declaration(variable.type, identifier(variable.name), constant=fixed)
                yield f"{declared} = {self._argument(part)};"
            case tree.Make(variable, parts):
                self._made.add(variable)
                listed = ", ".join(f".{identifier(name)} = {self._argument(part)}" for name, part in parts)
                yield f"const {self._element(variable.type)} {identifier(variable.name)} = {{{listed}}};"
            case tree.Copy(target, source):
                yield f"*{self._argument(target)} = *{self._argument(source)};"
            case tree.Invoke(function, arguments, results):
                yield f"{self._call(function, (*arguments, *results), len(arguments))};"
            case tree.For(variable, start, stop, step, body):
                name, first, end = identifier(variable.name), self._bare(start), self._bare(stop)
                if not isinstance(stop, Literal):
                    self._loops += 1
                    yield f"const int32_t stop_{self._loops} = {end};"
                    end = f"stop_{self._loops}"
                sign, change = ("<", f"{name} += {step}") if step > 0 else (">", f"{name} -= {-step}")
                yield from self._nested(f"for (int32_t {name} = {first}; {name} {sign} {end}; {change}) {{", body, "}")
            case tree.While(condition, body):
                yield from self._nested(f"while ({self._bare(condition)}) {{", body, "}")
            case tree.If():
                head, other = "if", tuple[tree.Statement, ...]((statement,))
                while len(other) == 1 and isinstance(other[0], tree.If):
                    yield f"{head} ({self._bare(other[0].condition)}) {{"
                    yield from self._body(other[0].body)
                    head, other = "} else if", other[0].other
                yield from self._nested("} else {", other, "}") if other else "}"
            case tree.Return(value):
                yield f"return {self._bare(value)};" if value else "return;"

    def place(self, element: tree.Element) -> str:
        """Return the index of an element in its array."""
        return bare(super().place(element))

    def _other(self, expression: Expression) -> str:  # noqa: PLR0911 one case a kind of expression
        match expression:
            case tree.Field(_, record, name):
                pointed = isinstance(record, Name) and record not in self._made
                return f"{self.expression(record)}{'->' if pointed else '.'}{identifier(name)}"
            case tree.Member(_, record, name):
                return f"{self.expression(record)}{'->' if isinstance(record, Name) else '.'}{identifier(name)}"
            case tree.Item(_, rows, index):
                return f"{self.expression(rows)}[{self.expression(index)}]"
            case View():
                return self._argument(expression)
            case tree.Select(_, condition, one, other):
                return f"({self.expression(condition)} ? {self.expression(one)} : {self.expression(other)})"
            case tree.Convert(kind, operand):
                return f"(({self.scalars[kind]}){self.expression(operand)})"
            case tree.Invocation(_, function, arguments):
                return self._call(function, arguments, len(arguments))
        assert isinstance(expression, Name)  # noqa: S101 no other is left
        return identifier(expression.name)

    def _bare(self, expression: Expression) -> str:
        return bare(self.expression(expression))

    def _call(self, function: Function, arguments: tuple[Expression, ...], results_from: int) -> str:
        printed = []
        for place, argument in enumerate(arguments):
            scalar_result = place >= results_from and isinstance(argument.type, Kind)
            own = isinstance(argument, Name) and argument in self._results
            printed.append(f"&{self.expression(argument)}" if scalar_result and not own else self._argument(argument))
        return f"{identifier(function.name)}({', '.join(printed)})"

    def _argument(self, argument: Expression) -> str:
        """Return a number; of anything else where it is."""
        if isinstance(argument, View):
            text, offset = self.expression(argument.array), self.expression(argument.offset)
            return text if offset == "0" else f"&{text}[{bare(offset)}]"
        by_address = isinstance(argument, tree.Item) or (isinstance(argument, Name) and argument in self._made)
        by_address = by_address or (isinstance(argument, tree.Field) and isinstance(argument.type, RecordType))
        return f"{'&' * by_address}{self.expression(argument)}"


def bare(text: str) -> str:
    """Return an operation without the parentheses around it."""
    depth = 0
    for place, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if not depth:
            return text[1:-1] if place == len(text) - 1 and text[0] == "(" else text
    return text


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
        header = {"GENERATED": GENERATED.rstrip(), "NAMES": self._names, "COUNT": str(len(printer.literals)),
                  "REAL": self._real, "RECORDS": records, "SIGNATURES": signatures}  # fmt: skip
        source = (
            f'{GENERATED}#include <math.h>\n\n#include "kernels.h"\n\n{helpers(self._real, self._text)}\n{self._text}'
        )
        return {"kernels.h": tree.filled(tree.template("c/kernels.h"), header), "kernels.c": source}

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
    texts = tree.filled(tree.template("c/helpers.c"), {"REAL": real}).split("\n\n")
    known = {re.findall(r"(\w+)\(", text)[0]: f"{text.rstrip()}\n" for text in texts}
    called = f"{kernels}{known['floor_div']}" if "floor_div(" in kernels else kernels
    return "".join(text for name, text in known.items() if f"{name}(" in called)


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


class ConstantRecords:
    """Records of constants, noted as they are printed; first the literals of what has been printed that uses them."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.arrays: dict[str, Array] = {}
        """Arrays of constants, by name."""
        self.real, self.type = np.dtype(np.float32 if printer.single else np.float64), printer.scalars[Kind.REAL]
        self._sums: list[str] = []
        self._sum = golden.crc(np.array([float(each.rstrip("f")) for each in printer.literals], self.real))

    def printed(self, path: str, value: object) -> str:
        """Return the initial value of a record, a number or an array, whose arrays and numbers are noted."""
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            parts = (f".{identifier(name)} = {self.printed(f'{path}.{identifier(name)}', part)}"
                     for name, part in zip(value._fields, value, strict=True))  # fmt: skip
            return f"{{{', '.join(parts)}}}"
        array = np.asarray(value)
        array = array if array.size else np.zeros(1, array.dtype)  # C has no array without elements
        real = array.dtype.kind == "f"
        self._sum = golden.crc(array.astype(self.real if real else np.int32), self._sum)
        function, kind = ("sum_of_reals", self.type) if real else ("sum_of_integers", "int32_t")
        if array.ndim:
            name = path.replace(".", "_")
            self._sums.append(f"changed = changed || *(const {kind} *const volatile *)&{path} != {name};")
            self._sums.append(f"sum = {function}(sum, {name}, {array.size});")
            self.arrays[name] = array
            return name
        if isinstance(value, bool | np.bool_):
            self._sums.append(f"sum = sum_of_integers(sum, &(int32_t){{*(const volatile unsigned char *)&{path}}}, 1);")
            return str(bool(value)).lower()
        self._sums.append(f"sum = {function}(sum, &{path}, 1);")
        return self.printer.number(float(array)) if real else str(int(array))

    def bytes(self) -> int:
        """Return the bytes of arrays and literals."""
        reals = self.real.itemsize
        arrays = sum((reals if array.dtype.kind == "f" else 4) * array.size for array in self.arrays.values())
        return arrays + reals * len(self.printer.literals)

    def parts(self, kernels: KernelFiles) -> dict[str, str]:
        """Return the parts of the files that have the constants, and the literals of some kernels."""
        arrays = "\n".join(self.printer.array(name, values) for name, values in self.arrays.items())
        bits = {"REAL": self.type, "BITS": f"uint{8 * self.real.itemsize}_t", "BYTES": str(self.real.itemsize)}
        body = "".join(f"    {each}\n" for each in self._sums)
        declared = f"""/* Sum over literals and constants; SUM_OF_CONSTANTS is what it was when they were written. */
uint32_t sum_of_constants(void);
uint32_t sum_of_reals(uint32_t sum, const volatile {self.type} *values, int32_t count);
uint32_t sum_of_integers(uint32_t sum, const volatile int32_t *values, int32_t count);
#define SUM_OF_CONSTANTS UINT32_C({self._sum})
"""
        summing = f"""{tree.filled(tree.template("c/sums.c"), bits)}
uint32_t sum_of_constants(void) {{
    bool changed = false; /* where an array is */
    uint32_t sum = sum_of_reals(0, literals, N_LITERALS);
{body}    return changed ? ~SUM_OF_CONSTANTS : sum;
}}
"""
        return {"DECLARED": declared, "LITERALS": kernels.literals(), "ARRAYS": arrays, "SUMMING": summing}
