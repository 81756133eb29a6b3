"""Calls in a kernel: of other kernels, of functions that the tree has, of types; new arrays and records."""

import ast
from collections.abc import Callable, Mapping
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from coldloop.kernels.compiled import python_of
from coldloop_export import expressions, tree
from coldloop_export.expressions import FUNCTIONS, NEW_ARRAYS, DType, Elementwise, Kernel, Known, Python, Record, Value
from coldloop_export.tree import ArrayType, Expression, Field, Function, Item, Kind, Literal, Name, RecordType, Storage

if TYPE_CHECKING:
    from coldloop_export.statements import Program

Returned: TypeAlias = Name | Field | tree.Group
Generic: TypeAlias = Mapping[Callable[..., Any], Mapping[str, Kernel]]
"""Functions that stand for several kernels: the kernel for each type of the first argument."""


class CallReader(expressions.ExpressionReader):
    """Reads expressions with calls.

    Args:
        source: The kernel.
        specialised: Has the functions of other kernels.
    """

    def __init__(self, source: expressions.Source, specialised: "Program") -> None:
        super().__init__(source, specialised.platform, double=specialised.double)
        self.specialised = specialised
        self.alone: set[int] = set()
        """Nodes of calls that may write: a statement is about their result alone."""
        self.written: set[str] = set()
        self.pointers: dict[str, tree.View | Item] = {}
        """Names of parts of arrays, and of records in them."""
        self.intermediate = 0

    def _call(self, node: ast.Call) -> Value:  # noqa: C901, PLR0911, PLR0912 one case for what can be called
        if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise self.refusal(node, "arguments are given by their places")
        if isinstance(node.func, ast.Attribute) and node.func.attr == "copy" and not node.args:
            return self.copied(node, self.storage(node.func.value))
        called = self.read(node.func)
        if isinstance(called, DType):
            return self._converted(node, called.kind)
        if not isinstance(called, Python):
            raise self.refusal(node, "this cannot be called")
        if kernel := self.kernel(node):
            alone = id(node) in self.alone
            function, arguments = self.call(node, kernel)
            if function.written and not alone:
                raise self.refusal(node, f"the call of {function.name}, which writes, is a statement or an argument")
            if function.value is not None:
                return tree.Invocation(function.value, function, arguments)
            if function.returned is None:
                raise self.refusal(node, f"{function.name} has no result")
            return self.received(node, function, arguments, function.returned, "")
        if called.value is type and len(node.args) == 1:
            return DType(cast("Kind", self.scalar(node.args[0]).type))
        if called.value is len and len(node.args) == 1:
            return Known(self.array(node.args[0], "only arrays have a length").shape[0])
        if called.value is int and len(node.args) == 1:
            operand = self.scalar(node.args[0])
            rounded = isinstance(operand, tree.Operation) and operand.operator == "round"
            if operand.type is not Kind.BOOL and not rounded:
                raise self.refusal(node, f"int of type {expressions.named(operand.type)} is not in the subset")
            return tree.Convert(Kind.INT, operand)
        if hasattr(called.value, "_fields"):
            made: Any = called.value
            self.refuse_if(len(node.args) != len(made._fields), node, f"{made.__name__} has {len(made._fields)} fields")
            parts = (self.typed(each, self.read(each)) for each in node.args)
            return Record(made.__name__, tuple(zip(made._fields, parts, strict=True)))
        if called.value in FUNCTIONS:
            return self._function(node, FUNCTIONS[called.value])
        if called.value in NEW_ARRAYS:
            return self._new_array(node)
        name = ast.unparse(node.func)
        raise self.refusal(node, f"{name} is not in the subset: its order of operations or its bits are not defined")

    def kernel(self, node: ast.Call) -> Kernel | None:
        """Return the kernel that is called; of several with one name that for the type of its first argument."""
        of = node.func.value if isinstance(node.func, ast.Attribute) else node.func
        called = self.read(node.func) if isinstance(self.read(of), Python) else None
        if not isinstance(called, Python) or not callable(called.value):
            return None
        if python_of(called.value) or called.value in self.specialised.portable:
            return called.value
        chosen = self.specialised.generic.get(called.value)
        return None if chosen is None else chosen[expressions.named(self.storage(node.args[0]).type)]

    def _tuple(self, node: ast.Tuple) -> Record:
        return Record("", tuple(("", self.typed(each, self.read(each))) for each in node.elts))

    def array(self, node: ast.expr, else_: str) -> ArrayType:
        """Return the type of an array that has a name; anything else is refused with `else_`."""
        kind = self.storage(node).type
        if not isinstance(kind, ArrayType):
            raise self.refusal(node, else_)
        return kind

    def copied(self, node: ast.AST, array: Storage) -> Elementwise:
        """Return the elements of an array."""
        if not isinstance(array.type, ArrayType):
            raise self.refusal(node, "only arrays are copied")
        return Elementwise(array.type, lambda indices: expressions.element_of(array, indices))

    def _converted(self, node: ast.Call, kind: Kind) -> Value:
        self.refuse_if(len(node.args) != 1, node, "a type takes one argument")
        value = self.read(node.args[0])
        if isinstance(value, Known):
            return Literal(kind, value.value)
        operand = self.scalar(node.args[0])
        if operand.type is kind:
            return operand
        if operand.type is not Kind.INT:
            raise self.refusal(node, f"{expressions.named(operand.type)} to {kind.value} is not in the subset")
        return tree.Convert(kind, operand)

    def _function(self, node: ast.Call, name: str) -> Value:
        self.refuse_platform(node, name)
        if name == "isfinite":
            return self.each(node, lambda parts: self._applied(node, name, parts), (self.read(node.args[0]),))
        return self._applied(node, name, tuple(self.scalar(argument) for argument in node.args))

    def _applied(self, node: ast.Call, name: str, operands: tuple[Expression, ...]) -> Expression:
        least = expressions.OPERANDS.get(name, 1)
        if len(operands) < least or any(one.type is not operands[0].type for one in operands):
            raise self.refusal(node, f"{name} of operands of different types, or of too few")
        kind = cast("Kind", operands[0].type)
        if name not in {"min", "max"} and (kind is not Kind.REAL or len(operands) != least):
            raise self.refusal(node, f"{name} of type {kind.value} is not in the subset")
        if least == 1:
            return tree.Operation(Kind.BOOL if name.startswith("is") else kind, name, operands)
        return reduce(lambda one, other: tree.Operation(kind, name, (one, other)), operands)

    def _new_array(self, node: ast.Call) -> Value:
        name = cast("ast.Attribute", node.func).attr
        if name.endswith("_like"):
            made = self.array(node.args[0], "an array is expected")
        else:
            dtype = self.read(node.args[1]) if len(node.args) == 2 else None
            if not isinstance(dtype, DType):
                raise self.refusal(node, "a new array needs its type")
            lengths = node.args[0].elts if isinstance(node.args[0], ast.Tuple) else [node.args[0]]
            made = ArrayType(dtype.kind, tuple(map(self.known_integer, lengths)))
        return Elementwise(made, lambda _indices: Literal(made.kind, 0))

    def call(self, node: ast.Call, kernel: Kernel) -> tuple[Function, tuple[Expression, ...]]:
        """Return the function that is called, and its arguments; those that are new arrays get names."""
        self.alone |= {id(argument) for argument in node.args}
        arguments = tuple(self._argument(argument) for argument in node.args)
        function = self.specialised.function(kernel, tuple(argument.type for argument in arguments))
        if len(arguments) != len(function.parameters):
            raise self.refusal(node, f"{function.name} takes {len(function.parameters)} arguments")
        for parameter, argument in zip(function.parameters, arguments, strict=True):
            if parameter.name in function.written:
                self.write_to(node, cast("Storage", argument))
        return function, arguments

    def _argument(self, node: ast.expr) -> Expression:
        value = self.typed(node, self.read(node))
        if isinstance(value, Elementwise):
            return self.named_array(node, value)
        if isinstance(value, Record):
            return value.variable or self.made(node, value, None)
        if isinstance(value, expressions.Untyped):
            raise self.refusal(node, "arguments are arrays, records and numbers")
        return value

    def write_to(self, node: ast.AST, target: Value) -> None:
        """Note that an array, or a record of numbers, is written to."""
        match target:
            case Name(_, name):
                self.written.add(name)
                if name in self.pointers:
                    self.write_to(node, self.pointers[name])
            case Field(_, record) if isinstance(record.type, RecordType) and record.type.state:
                self.write_to(node, record)
            case tree.View(_, array) | Item(_, array) | tree.Element(_, array) | tree.Member(_, array):
                self.write_to(node, array)
            case _:
                raise self.refusal(node, "arrays in records are constant")

    def is_constant(self, target: Value) -> bool:
        """Return whether nothing may be written there."""
        match target:
            case Field(_, record):
                return not (isinstance(record.type, RecordType) and record.type.state) or self.is_constant(record)
            case tree.View(_, array) | Item(_, array):
                return self.is_constant(array)
        return False

    def received(
        self, node: ast.AST, function: Function, arguments: tuple[Expression, ...], returned: Returned, name: str
    ) -> Value:
        """Return the results of a call as they belong together, in new variables; its statement goes before."""
        taken: dict[Name, Name] = {}
        value = self._taken(node, function, arguments, returned, name, taken)
        self.before.append(tree.Invoke(function, arguments, tuple(taken[each] for each in function.results)))
        if isinstance(value, Record) and value.name and name:
            return self.recorded(node, value, name)
        return value

    def _taken(
        self, node: ast.AST, function: Function, arguments: tuple[Expression, ...], returned: Returned, name: str,
        taken: dict[Name, Name],
    ) -> Value:  # fmt: skip
        """Return a result, with new variables for those that are no fields of the arguments."""
        if isinstance(returned, tree.Group):
            return Record(returned.name, tuple(
                (field, self._taken(node, function, arguments, part, f"{name}_{field}" if name else "", taken))
                for field, part in returned.parts
            ))  # fmt: skip
        if returned in function.results:
            taken[returned] = variable = self.new_name(node, returned.type, name)
            return variable
        if isinstance(returned.type, ArrayType) and not returned.type.size:
            return Elementwise(returned.type, lambda _indices: Literal(Kind.INT, 0))
        return rooted(returned, dict(zip(function.parameters, arguments, strict=True)))

    def recorded(self, node: ast.AST, value: Record, name: str) -> Record:
        """Return a record of the tree with these values."""
        variable = self.made(node, value, name)
        parts = tuple(
            (field, Field(part.type, variable, field) if isinstance(part.type, Kind) else part)
            for field, part in value.parts
        )
        return Record(value.name, parts, variable)

    def made(self, node: ast.AST, value: Record, name: str | None) -> Name:
        """Return a new variable that is a record with these values."""
        parts: list[tuple[str, Expression]] = []
        for field, part in value.parts:
            if isinstance(part, Record):
                raise self.refusal(node, "a record within a record that is made")
            one = self.named_array(node, part) if isinstance(part, Elementwise) and part.type.size else part
            if not isinstance(one, Elementwise):
                parts.append((field, cast("Expression", one)))
        kind = RecordType(value.name, tuple((field, part.type) for field, part in parts))
        variable = self.new_name(node, kind, name or "", declared=False)
        self.before.append(tree.Make(variable, tuple(parts)))
        return variable

    def new_name(self, node: ast.AST, kind: tree.Type, name: str = "", *, declared: bool = True) -> Name:
        """Return a new variable, declared before the statement, with this name where it is free."""
        if self.conditional:
            raise self.refusal(node, "an array that is made under a condition needs a statement of its own")
        if not name or name in self.source.assigned or any(name in scope for scope in self.scopes):
            self.intermediate += 1
            name = f"new_{self.intermediate}"
        variable = Name(kind, name)
        if declared:
            self.before.append(tree.Declare(variable))
        return variable

    def named_array(self, node: ast.AST, value: Elementwise) -> Name:
        """Return a new variable that has the elements of an array."""
        raise NotImplementedError


def rooted(storage: Name | Field, arguments: Mapping[Name, Expression]) -> Expression:
    """Return a field of a parameter as a field of the argument."""
    if not isinstance(storage, Field):
        return arguments[storage]
    return Field(storage.type, cast("Name | Field", rooted(storage.record, arguments)), storage.name)
