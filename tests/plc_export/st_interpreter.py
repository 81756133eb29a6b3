"""Executes Structured Text: REAL as float32, LREAL as float64, both operands of AND and OR computed, types strict.

Each unit becomes a Python function of the objects that hold its variables. An index beyond its array, an assignment to
a constant or an input, and operands of two types are errors.
"""

import ctypes
import ctypes.util
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from tests.plc_export.st_parser import Library, Tree, Unit, Variable, parsed

_LIBM = ctypes.CDLL(ctypes.util.find_library("m") or "libm.so.6")
_POWF, _LOGF = _LIBM.powf, _LIBM.logf
_POWF.restype, _POWF.argtypes = ctypes.c_float, (ctypes.c_float, ctypes.c_float)
_LOGF.restype, _LOGF.argtypes = ctypes.c_float, (ctypes.c_float,)
STANDARD: Final = {
    "sqrt": ("np.sqrt", "REAL", "REAL"), "expt": ("power", "REAL", "REAL"),
    "ln": ("logarithm", "REAL", "REAL"), "real_to_dint": ("to_integer", "REAL", "DINT"),
    "dint_to_real": ("np.float32", "DINT", "REAL"), "bool_to_dint": ("int", "BOOL", "DINT"),
    "real_to_lreal": ("np.float64", "REAL", "LREAL"), "lreal_to_real": ("np.float32", "LREAL", "REAL"),
    "dint_to_lreal": ("np.float64", "DINT", "LREAL"), "lreal_to_dint": ("to_integer", "LREAL", "DINT"),
}  # fmt: skip
"""In Python, with the types of arguments and result; ABS has that of its argument."""
ZEROS: Final = {"REAL": "np.float32(0)", "LREAL": "np.float64(0)", "DINT": "0", "BOOL": "False"}
COUNTED: Final = {"sqrt", "expt", "ln"}
COMPARISONS: Final = {"=": "==", "<>": "!=", "<": "<", ">": ">", "<=": "<=", ">=": ">="}
LOGICAL: Final = {"AND": "&", "OR": "|"}


def power(base: np.float32, exponent: np.float32) -> np.float32:
    return np.float32(_POWF(base, exponent))


def logarithm(value: np.float32) -> np.float32:
    return np.float32(_LOGF(value))


def to_integer(value: np.float32) -> int:
    return dint(int(np.rint(value)))


def dint(value: int) -> int:
    assert -(2**31) <= value < 2**31, value
    return value


def quotient(one: int, other: int) -> int:
    return int(one / other)


def put(array: dict[int, object], index: int, value: object) -> None:
    assert index in array, index
    array[index] = value


class Reals(dict[str, np.floating[Any]]):
    """Literals that have been read."""

    def __missing__(self, text: str) -> np.floating[Any]:
        kind, _, number = text.partition("#")
        self[text] = np.float64(number) if kind == "LREAL" else np.float32(number)
        return self[text]


REALS: Final = Reals()


class Machine:
    """A loaded library; arrays are dictionaries from index to element."""

    def __init__(self, *texts: str) -> None:
        self.library: Library = parsed(*texts)
        self.globals = SimpleNamespace()
        self.operations = [0]
        """Sums, differences, products, quotients, roots, powers and logarithms of REAL and LREAL so far."""
        self.names: dict[str, Any] = {"np": np, "power": power, "to_integer": to_integer, "logarithm": logarithm,
                                      "dint": dint, "put": put, "quotient": quotient,
                                      "globals": self.globals, "reals": REALS, "count": self.operations}  # fmt: skip
        for variable in self.library.globals.values():
            setattr(self.globals, variable.name, self.initial(variable))
        for unit in self.library.units.values():
            exec(Translation(self.library, unit).text(), self.names)  # noqa: S102 the tests' own text

    def instance(self, name: str) -> SimpleNamespace:
        """Return a new instance of a function block or program."""
        held = SimpleNamespace()
        for variable in self.library.units[name].variables.values():
            if variable.type in self.library.units:
                setattr(held, variable.name, self.instance(variable.type))
            elif variable.section not in {"VAR_IN_OUT", "VAR_EXTERNAL"}:
                setattr(held, variable.name, self.initial(variable))
        held.run_ = lambda: self.names[f"run_{name}"](held)
        return held

    def initial(self, variable: Variable) -> object:
        if variable.type not in self.library.arrays:
            return self.value(variable.type, variable.value)
        size, kind = self.library.arrays[variable.type]
        values = variable.value if isinstance(variable.value, list) else [None] * size
        assert len(values) == size, variable.name
        return {place: self.value(kind, each) for place, each in enumerate(values)}

    @staticmethod
    def value(kind: str, written: object) -> object:
        if written is None:
            return {"REAL": np.float32(0), "LREAL": np.float64(0), "DINT": 0, "BOOL": False}[kind]
        match kind, written:
            case ("REAL", ("real" | "untyped", str(text))) | ("LREAL", ("lreal" | "untyped", str(text))):
                return REALS[f"{kind}#{text.rpartition('#')[2]}"]
            case "DINT", ("int", str(text)):
                return int(text)
            case "DINT", ("operation", "-", ("int", str(text))):
                return -int(text)
            case "BOOL", ("bool", "FALSE"):
                return False
            case "BOOL", ("bool", "TRUE"):
                return True
        raise AssertionError((kind, written))

    def call(self, name: str, *arguments: object) -> object:
        """Return the value of a function."""
        function: Callable[..., object] = self.names[f"call_{name}"]
        return function(*arguments)


class Translation:
    """One unit as Python."""

    def __init__(self, library: Library, unit: Unit) -> None:
        self.library, self.unit = library, unit
        self.operations = 0
        for variable in unit.variables.values():
            if variable.section == "VAR_EXTERNAL":
                there = library.globals.get(variable.name)
                assert there, variable.name
                assert there.type == variable.type, variable.name

    def text(self) -> str:
        """Return the Python function."""
        unit = self.unit
        if unit.kind != "FUNCTION":
            return "\n".join([f"def run_{unit.name}(self):", *self.block(unit.body)])
        inputs = [each.name for each in unit.variables.values() if each.section == "VAR_INPUT"]
        local = [f" {each.name} = {ZEROS[each.type]}" for each in unit.variables.values() if each.name not in inputs]
        head = f"def call_{unit.name}({', '.join(inputs)}):"
        return "\n".join([head, *local, *self.block(unit.body), f" return {unit.name}"])

    # -- statements ----------------------------------------------------------------------------------------------------

    def block(self, statements: list[Tree]) -> list[str]:
        return [f" {line}" for each in statements for line in self.counted(each)] or [" pass"]

    def counted(self, statement: Tree) -> Iterator[str]:
        """Yield a statement, and before it what counts its own operations; conditions of loops have none."""
        self.operations, before = 0, self.operations
        lines = [*self.statement(statement)]
        own, self.operations = self.operations, before
        if own and self.unit.kind != "FUNCTION":
            yield f"count[0] += {own}"
        yield from lines

    def statement(self, statement: Tree) -> Iterator[str]:
        match statement:
            case "assign", target, value:
                yield self.assignment(target, self.typed(value))
            case "call", str(name), list(passed):
                yield from self.call(name, dict(passed))
            case "if", condition, list(body), list(other):
                yield f"if {self.of(condition, 'BOOL')}:"
                yield from self.block(body)
                yield "else:"
                yield from self.block(other)
            case "while", condition, list(body):
                yield f"while {self.of(condition, 'BOOL')}:"
                assert not self.operations, condition
                yield from self.block(body)
            case "for", str(name), first, last, int(step), list(body):
                beyond = f"{self.of(last, 'DINT')} {'+' if step > 0 else '-'} 1"
                yield f"for {self.writable(name)} in range({self.of(first, 'DINT')}, {beyond}, {step}):"
                yield from self.block(body)
            case "case", chosen, list(cases):
                yield f"case = {self.of(chosen, 'DINT')}"
                for place, (number, body) in enumerate(cases):
                    yield f"{'elif' if place else 'if'} case == {number}:"
                    yield from self.block(body)
            case ("return",):
                yield f"return {self.unit.name}" if self.unit.kind == "FUNCTION" else "return"
            case _:
                raise AssertionError(statement)

    def writable(self, name: str) -> str:
        variable = self.unit.variables.get(name)
        if variable:
            assert not variable.constant, f"{name} is constant"
            assert variable.section != "VAR_INPUT", f"{name} is an input"
            held = self.library.globals.get(name) if variable.section == "VAR_EXTERNAL" else None
            assert held is None or held.value is None, f"{name} has an initial value: nothing writes to it"
        return self.typed(("variable", name))[0]

    def assignment(self, target: object, value: tuple[str, str]) -> str:
        text, kind = value
        match target:
            case "element", ("variable", str(name)), index:
                array = self.writable(name)
                assert self.typed(target)[1] == kind, target
                return f"put({array}, {self.of(index, 'DINT')}, {text})"
            case "variable", str(name):
                assert self.typed(target)[1] == kind, target
                return f"{self.writable(name)} = {f'dint({text})' if kind == 'DINT' else text}"
        raise AssertionError(target)

    def call(self, name: str, passed: dict[str, object]) -> Iterator[str]:
        block = self.library.units[self.unit.variables[name].type]
        wanted = {each.name: each for each in block.variables.values() if each.section in {"VAR_INPUT", "VAR_IN_OUT"}}
        assert set(passed) == set(wanted), (name, set(passed) ^ set(wanted))
        back = []
        for parameter, value in passed.items():
            text, kind = self.typed(value)
            assert kind == wanted[parameter].type, (name, parameter, kind)
            if wanted[parameter].section == "VAR_IN_OUT":
                assert isinstance(value, tuple)
                self.writable(str(value[1]))
                back += [f"{text} = self.{name}.{parameter}"] if kind not in self.library.arrays else []
            yield f"self.{name}.{parameter} = {text}"
        yield f"self.{name}.run_()"
        yield from back

    # -- expressions ---------------------------------------------------------------------------------------------------

    def of(self, expression: object, kind: str) -> str:
        text, found = self.typed(expression)
        assert found == kind, (expression, kind)
        return text

    def typed(self, expression: object) -> tuple[str, str]:  # noqa: PLR0911 one case a kind
        match expression:
            case ("real" | "lreal") as kind, str(text):
                return f"reals['{text}']", kind.upper()
            case "int", str(text):
                return text, "DINT"
            case "bool", str(text):
                return text.capitalize(), "BOOL"
            case "variable", str(name):
                return self.variable(name)
            case "output", str(instance), str(name):
                output = self.library.units[self.unit.variables[instance].type].variables[name]
                assert output.section == "VAR_OUTPUT"
                return f"self.{instance}.{name}", output.type
            case "element", array, index:
                text, kind = self.typed(array)
                return f"{text}[{self.of(index, 'DINT')}]", self.library.arrays[kind][1]
            case "function", str(name), list(arguments):
                return self.function(name, arguments)
            case "operation", str(sign), *operands:
                return self.operation(sign, [self.typed(each) for each in operands])
        raise AssertionError(expression)

    def variable(self, name: str) -> tuple[str, str]:
        if self.unit.kind == "FUNCTION":
            return name, self.unit.result if name == self.unit.name else self.unit.variables[name].type
        variable = self.unit.variables[name]
        return f"{'globals' if variable.section == 'VAR_EXTERNAL' else 'self'}.{name}", variable.type

    def function(self, name: str, arguments: list[Tree]) -> tuple[str, str]:
        if name == "abs":
            ((text, kind),) = map(self.typed, arguments)
            assert kind in {"REAL", "LREAL"}
            return f"abs({text})", kind
        if name in STANDARD:
            called, taken, result = STANDARD[name]
            self.operations += name in COUNTED
            return f"{called}({', '.join(self.of(each, taken) for each in arguments)})", result
        function = self.library.units[name]
        wanted = [each.type for each in function.variables.values() if each.section == "VAR_INPUT"]
        passed = [self.of(each, kind) for each, kind in zip(arguments, wanted, strict=True)]
        return f"call_{name}({', '.join(passed)})", function.result

    def operation(self, sign: str, operands: list[tuple[str, str]]) -> tuple[str, str]:
        (one, kind), (other, other_kind) = operands[0], operands[-1]
        assert kind == other_kind, (sign, kind, other_kind)
        if len(operands) == 1:
            assert (sign == "NOT") == (kind == "BOOL")
            return (f"(not {one})" if sign == "NOT" else f"(-{one})"), kind
        if sign in LOGICAL:
            assert kind == "BOOL"
            return f"({one} {LOGICAL[sign]} {other})", kind
        assert kind in {"REAL", "LREAL", "DINT"}
        if sign in COMPARISONS:
            return f"({one} {COMPARISONS[sign]} {other})", "BOOL"
        if kind == "DINT" and sign in {"/", "MOD"}:
            whole = f"quotient({one}, {other})"
            return (whole if sign == "/" else f"({one} - {whole} * {other})"), kind
        assert sign in {"+", "-", "*", "/"}
        self.operations += kind != "DINT"
        return f"({one} {sign} {other})", kind
