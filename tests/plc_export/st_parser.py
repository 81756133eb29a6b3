"""Reads the Structured Text that the export writes: a strict, small part of the language, as a tree of its own."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

TOKEN: Final = re.compile(r"""
    (?P<space>\s+|\(\*.*?\*\)) | (?P<lreal>LREAL\#\d+\.\d+(?:E[+-]?\d+)?)
    | (?P<real>REAL\#\d+\.\d+(?:E[+-]?\d+)?) | (?P<untyped>\d+\.\d+E[+-]\d+) | (?P<time>T\#\d+ms)
    | (?P<int>\d+(?!\d|\.\d)) | (?P<name>[A-Za-z][A-Za-z0-9_]*) | (?P<sign>:=|<>|<=|>=|\.\.|[-+*/=<>()\[\],;:.])
""", re.VERBOSE | re.DOTALL)  # fmt: skip
SECTIONS: Final = ("VAR_INPUT", "VAR_IN_OUT", "VAR_OUTPUT", "VAR_EXTERNAL", "VAR_GLOBAL", "VAR")
RESERVED: Final = """
    AND ARRAY AT BOOL BY CASE CONFIGURATION CONSTANT D DINT DO DT ELSE ELSIF END_CASE END_FOR END_IF END_WHILE EXIT
    FALSE FOR FUNCTION FUNCTION_BLOCK IF L LD LIMIT LN LREAL LT MAX MIN MOD MUX N NOT OF ON OR P PROGRAM R REAL RESOURCE
    RETURN S SD SEL SL SQRT ST STEP T TASK THEN TIME TO TOD TRUE TYPE UNTIL VAR WHILE WITH XOR
"""
LEVELS: Final = (("OR",), ("AND",), ("=", "<>", "<", ">", "<=", ">="), ("+", "-"), ("*", "/", "MOD"))
ELEMENTARY: Final = ("REAL", "LREAL", "DINT", "BOOL")
Tree = tuple[object, ...]


@dataclass(frozen=True)
class Variable:
    """A declaration: its section, whether it is constant, type and value as written."""

    name: str
    section: str
    constant: bool
    type: str
    value: object = None


@dataclass
class Unit:
    """A function, function block or program."""

    kind: str
    name: str
    result: str
    variables: dict[str, Variable] = field(default_factory=dict)
    body: list[Tree] = field(default_factory=list)


@dataclass
class Library:
    """What all files together declare."""

    arrays: dict[str, tuple[int, str]] = field(default_factory=dict)
    units: dict[str, Unit] = field(default_factory=dict)
    globals: dict[str, Variable] = field(default_factory=dict)


class Parser:
    """Reads one text into a library."""

    def __init__(self, text: str, library: Library) -> None:
        self.tokens = [*self._tokens(text), ("end", "")]
        self.at, self.library = 0, library

    @staticmethod
    def _tokens(text: str) -> Iterator[tuple[str, str]]:
        place = 0
        while place < len(text):
            found = TOKEN.match(text, place)
            assert found, f"not read: {text[place : place + 40]!r}"
            if found.lastgroup != "space":
                yield str(found.lastgroup), found[0]
            place = found.end()

    # -- tokens --------------------------------------------------------------------------------------------------------

    @property
    def next(self) -> str:
        return self.tokens[self.at][1]

    def take(self, *expected: str) -> str:
        kind, text = self.tokens[self.at]
        assert not expected or text in expected, f"{text!r} where {expected} is expected"
        assert kind != "end"
        self.at += 1
        return text

    def skip(self, text: str) -> bool:
        if self.next == text:
            self.at += 1
            return True
        return False

    def name(self) -> str:
        kind, text = self.tokens[self.at]
        assert kind == "name", text
        assert not re.search(rf"\b{text.upper()}\b", RESERVED), f"{text} is a keyword"
        assert len(text) <= 32, f"{text} is long"
        assert "__" not in text, text
        assert not text.endswith("_"), text
        self.at += 1
        return text.lower()

    def integer(self) -> int:
        sign = -1 if self.skip("-") else 1
        return sign * int(self.take())

    # -- declarations --------------------------------------------------------------------------------------------------

    def read(self) -> None:
        while self.tokens[self.at][0] != "end":
            head = self.take("TYPE", "FUNCTION", "FUNCTION_BLOCK", "PROGRAM", "CONFIGURATION")
            if head == "TYPE":
                self._type_block()
            elif head == "CONFIGURATION":
                self._configuration()
            else:
                self._unit(head)

    def _type_block(self) -> None:
        """Read a TYPE block, which has one type: not every tool takes a second one there."""
        name = self.name()
        assert name not in self.library.arrays
        for text in (":", "ARRAY", "[", "0", ".."):
            self.take(text)
        size = self.integer() + 1
        self.take("]")
        self.take("OF")
        self.library.arrays[name] = size, self.take(*ELEMENTARY)
        self.take(";")
        self.take("END_TYPE")

    def _configuration(self) -> None:
        self.name()
        while self.next == "VAR_GLOBAL":
            for variable in self._section():
                assert variable.name not in self.library.globals
                self.library.globals[variable.name] = variable
        while not self.skip("END_CONFIGURATION"):
            self.take()

    def _unit(self, head: str) -> None:
        unit = Unit(head, self.name(), "")
        assert unit.name not in self.library.units, unit.name
        if head == "FUNCTION":
            self.take(":")
            unit.result = self._type()
        while self.next in SECTIONS:
            for variable in self._section():
                assert variable.name not in unit.variables, f"{variable.name} twice in {unit.name}"
                unit.variables[variable.name] = variable
        unit.body = self._statements(f"END_{head}")
        self.take(f"END_{head}")
        self.library.units[unit.name] = unit

    def _type(self) -> str:
        return self.take() if self.next in ELEMENTARY else self.name()

    def _section(self) -> Iterator[Variable]:
        section = self.take(*SECTIONS)
        constant = section == "VAR" and self.skip("CONSTANT")
        while not self.skip("END_VAR"):
            name = self.name()
            self.take(":")
            kind = self._type()
            value = self._initial() if self.skip(":=") else None
            self.take(";")
            yield Variable(name, section, constant, kind, value)

    def _initial(self) -> object:
        if not self.skip("["):
            return self._value()
        values = [self._value()]
        while self.skip(","):
            values.append(self._value())
        self.take("]")
        return values

    def _value(self) -> Tree:
        """Return an initial value: a typed literal, or a negative one without type."""
        kind, text = self.tokens[self.at + 1]
        if kind != "untyped":
            return self._unary()
        self.take("-")
        return "untyped", f"-{self.take(text)}"

    # -- statements ----------------------------------------------------------------------------------------------------

    def _statements(self, *ends: str) -> list[Tree]:
        result: list[Tree] = []
        while self.next not in ends:
            result.append(self._statement())
        return result

    def _statement(self) -> Tree:
        match self.next:
            case "IF":
                return self._if()
            case "FOR":
                return self._for()
            case "WHILE":
                self.take()
                condition = self.expression()
                self.take("DO")
                body = self._statements("END_WHILE")
                return self._ended("END_WHILE", ("while", condition, body))
            case "CASE":
                return self._case()
            case "RETURN":
                return self._ended("RETURN", ("return",))
        return self._assignment_or_call()

    def _ended(self, text: str, statement: Tree) -> Tree:
        self.take(text)
        self.take(";")
        return statement

    def _if(self) -> Tree:
        self.take("IF")
        condition = self.expression()
        self.take("THEN")
        body = self._statements("ELSE", "END_IF")
        other = self._statements("END_IF") if self.skip("ELSE") else []
        return self._ended("END_IF", ("if", condition, body, other))

    def _for(self) -> Tree:
        self.take("FOR")
        name = self.name()
        self.take(":=")
        first = self.expression()
        self.take("TO")
        last = self.expression()
        step = self.integer() if self.skip("BY") else 1
        self.take("DO")
        return self._ended("END_FOR", ("for", name, first, last, step, self._statements("END_FOR")))

    def _case(self) -> Tree:
        self.take("CASE")
        chosen = self.expression()
        self.take("OF")
        cases: list[tuple[int, list[Tree]]] = []
        while self.next != "END_CASE":
            number = self.integer()
            self.take(":")
            cases.append((number, self._until_next_case()))
        return self._ended("END_CASE", ("case", chosen, cases))

    def _until_next_case(self) -> list[Tree]:
        body: list[Tree] = []
        while self.next != "END_CASE" and self.tokens[self.at][0] != "int":
            body.append(self._statement())
        return body

    def _assignment_or_call(self) -> Tree:
        name = self.name()
        if self.skip("("):
            passed = []
            while not self.skip(")"):
                parameter = self.name()
                self.take(":=")
                passed.append((parameter, self.expression()))
                self.skip(",")
            self.take(";")
            return "call", name, passed
        target: Tree = ("variable", name)
        if self.skip("["):
            target = "element", target, self.expression()
            self.take("]")
        self.take(":=")
        value = self.expression()
        self.take(";")
        return "assign", target, value

    # -- expressions ---------------------------------------------------------------------------------------------------

    def expression(self, level: int = 0) -> Tree:
        if level == len(LEVELS):
            return self._unary()
        result = self.expression(level + 1)
        while self.next in LEVELS[level]:
            result = "operation", self.take(), result, self.expression(level + 1)
        return result

    def _unary(self) -> Tree:
        if self.next in {"-", "NOT"}:
            return "operation", self.take(), self._unary()
        kind, text = self.tokens[self.at]
        if kind in {"real", "lreal", "int"} or text in {"TRUE", "FALSE"}:
            self.at += 1
            return kind if kind != "name" else "bool", text
        if self.skip("("):
            result = self.expression()
            self.take(")")
            return result
        return self._named()

    def _named(self) -> Tree:
        name = self.take().lower() if self.next in {"SQRT", "LN"} else self.name()
        if self.skip("("):
            arguments = [self.expression()]
            while self.skip(","):
                arguments.append(self.expression())
            self.take(")")
            return "function", name, arguments
        result: Tree = ("variable", name)
        if self.skip("."):
            result = "output", name, self.name()
        if self.skip("["):
            result = "element", result, self.expression()
            self.take("]")
        return result


def parsed(*texts: str) -> Library:
    """Return what the texts declare; what is used is declared before."""
    library = Library()
    for text in texts:
        Parser(text, library).read()
    return library
