"""Kernels as functions of the typed tree, one for each set of argument types, callees first."""

import ast
from collections import Counter
from collections.abc import Callable
from types import MappingProxyType
from typing import Any, cast

from coldloop_rig.plc_export.tree.assignments import SAME, AssignmentReader
from coldloop_rig.plc_export.tree.calls import Generic, Returned, rooted
from coldloop_rig.plc_export.tree.nodes import (
    ArrayType,
    Expression,
    Field,
    For,
    Function,
    Group,
    If,
    Invocation,
    Invoke,
    Kind,
    Literal,
    Name,
    RecordType,
    Return,
    Statement,
    Type,
    While,
)
from coldloop_rig.plc_export.tree.subset import Kernel, Source
from coldloop_rig.plc_export.tree.values import DType, Known, Python, Record, Shape, Value, is_number, named


class Program:
    """Functions of kernels and of all that they call.

    Args:
        platform: Operators whose bits are the platform's library's and that are accepted all the same.
        generic: Functions that stand for several kernels.
        portable: Functions of plain Python that are read as kernels are.
        double: Numbers with a point are in double precision, as are those without a type, and quotients of integers.
    """

    def __init__(
        self, platform: frozenset[str] = frozenset(), generic: Generic = MappingProxyType({}),
        portable: frozenset[Callable[..., Any]] = frozenset(), *, double: bool = False,
    ) -> None:  # fmt: skip
        self.platform, self.generic, self.portable, self.double = platform, generic, portable, double
        self.functions: list[Function] = []
        """Callees before their callers."""
        self._names: Counter[str] = Counter()
        self._known: dict[tuple[Kernel, tuple[Type, ...]], Function | None] = {}

    def function(self, kernel: Kernel, types: tuple[Type, ...]) -> Function:
        """Return the function of a kernel for arguments of these types.

        Raises:
            UnfitKernelError: The kernel, or one that it calls, is not in the subset.
        """
        key = (kernel, types)
        if key not in self._known:
            self._known[key] = None
            source = Source(kernel)
            self._names[source.name] += 1
            count = self._names[source.name]
            name = source.name if count == 1 else f"{source.name}__{count}"
            found = KernelReader(source, self, types).function(name)
            self.functions.append(found)
            self._known[key] = found
        function = self._known[key]
        if function is None:
            source = Source(kernel)
            raise source.refusal(source.definition, f"{source.name} calls itself")
        return function


class KernelReader(AssignmentReader):
    """Reads one kernel."""

    def __init__(self, source: Source, program: Program, types: tuple[Type, ...]) -> None:
        super().__init__(source, program)
        arguments = source.definition.args
        if arguments.vararg or arguments.kwarg or arguments.kwonlyargs or arguments.defaults or arguments.posonlyargs:
            raise source.refusal(source.definition, "parameters are given by their places, without defaults")
        if len(arguments.args) != len(types):
            raise source.refusal(source.definition, f"{source.name} takes {len(arguments.args)} arguments")
        self.parameters = tuple(Name(kind, each.arg) for each, kind in zip(arguments.args, types, strict=True))
        self.scopes[0].update({each.name: each for each in self.parameters})
        self.returns: tuple[tuple[Name, ...], Returned | None, Kind | None] | None = None

    def function(self, name: str) -> Function:
        """Return the whole kernel."""
        definition = self.source.definition
        body = self.block(definition.body, new_scope=False)
        written = self.written & {each.name for each in self.parameters}
        where = f"{self.source.file}:{definition.lineno}"
        results, returned, value = self.returns or ((), None, None)
        summary = (ast.get_docstring(definition) or "").partition("\n")[0]
        return Function(
            name, where, summary, self.parameters, written, self.used, results, returned, value, body
        )  # fmt: skip

    # -- statements ----------------------------------------------------------------------------------------------------

    def block(self, nodes: list[ast.stmt], *, new_scope: bool = True) -> tuple[Statement, ...]:
        """Return the statements of a block; what it declares is not known behind it."""
        if new_scope:
            self.scopes.append({})
        result: list[Statement] = []
        for node in nodes:
            outer, self.before = self.before, []
            read = self.statement(node)
            result += [*self.before, *read]
            self.before = outer
        if new_scope:
            self.scopes.pop()
        return tuple(result)

    def statement(self, node: ast.stmt) -> list[Statement]:  # noqa: PLR0911 one case a statement
        """Return what a statement is."""
        match node:
            case ast.Expr(value=ast.Constant()):
                return []
            case ast.Expr(value=ast.Call() as call):
                return self._called(call)
            case ast.Assign(targets=[target], value=value) | ast.AnnAssign(target=target, value=ast.expr() as value):
                return self.assigned(target, value)
            case ast.Assign(targets=targets, value=value) if all(isinstance(one, ast.Subscript | ast.Attribute)
                                                                 for one in targets):  # fmt: skip
                return self.into_all(targets, value)
            case ast.AugAssign(target=ast.Name() | ast.Subscript() | ast.Attribute() as target, op=sign, value=value):
                return self._augmented(target, sign, value)
            case ast.For(target=ast.Name(id=name), iter=ast.Call() as counted, orelse=[]):
                return self._for(node, name, counted)
            case ast.While(test=test, orelse=[]):
                self.conditional += 1
                condition = self.of_kind(test, Kind.BOOL)
                self.conditional -= 1
                return [While(condition, self.block(node.body))]
            case ast.If(test=test):
                condition = self.of_kind(test, Kind.BOOL)
                return [If(condition, self.block(node.body), self.block(node.orelse))]
            case ast.Return(value=value):
                return self._return(node, value)
        raise self.source.refusal(node, f"the statement {type(node).__name__} is not in the subset in this form")

    def _called(self, node: ast.Call) -> list[Statement]:
        kernel = self.kernel(node)
        if not kernel:
            raise self.source.refusal(node, "a call for what it writes is a call of a kernel")
        function, arguments = self.call(node, kernel)
        if function.value:
            raise self.source.refusal(node, f"the result of {function.name} is not used")
        if function.returned:  # for what it writes alone
            self.received(node, function, arguments, function.returned, "")
            return []
        return [Invoke(function, arguments, ())]

    def _for(self, node: ast.For, name: str, counted: ast.Call) -> list[Statement]:
        if not (isinstance(counted.func, ast.Name) and counted.func.id == "range") or counted.keywords:
            raise self.source.refusal(node, "a loop counts: for ... in range(...)")
        bounds = [self.scalar(each) for each in counted.args]
        step = self.known_integer(counted.args[2]) if len(bounds) == 3 else 1
        start, stop = (Literal(Kind.INT, 0), bounds[0]) if len(bounds) == 1 else bounds[:2]
        if start.type is Kind.INT and stop.type is Kind.UNSIGNED and len(bounds) == 1:
            start = Literal(Kind.UNSIGNED, 0)
        if start.type is not stop.type or start.type not in {Kind.INT, Kind.UNSIGNED} or not step:
            raise self.source.refusal(node, f"a loop from {named(start.type)} to {named(stop.type)}")
        if any(name in scope for scope in self.scopes):
            raise self.source.refusal(node, f"{name} is a variable already")
        variable = Name(start.type, name)
        self.loop_variables.append(name)
        self.scopes.append({name: variable})
        body = self.block(node.body)
        self.scopes.pop()
        self.loop_variables.pop()
        return [For(variable, start, stop, step, body)]

    def _return(self, node: ast.Return, value: ast.expr | None) -> list[Statement]:
        if value is None:
            return [Return()]
        if isinstance(value, ast.Call) and (kernel := self.kernel(value)):
            return self._return_call(node, value, kernel)
        read = self.typed(value, self.read(value))
        if is_number(read):
            return self._return_number(node, cast("Expression", read))
        kept: list[Value] = []
        returned = self._returned(node, read, kept)
        results = tuple(Name(part.type, f"result_{place}")  # type: ignore[union-attr]
                        for place, part in enumerate(kept))  # fmt: skip
        self._agree(node, results, returned, None)
        stored = [each for target, part in zip(results, kept, strict=True) for each in self.store(target, part)]
        return [*stored, Return()]

    def _return_call(self, node: ast.Return, value: ast.Call, kernel: Kernel) -> list[Statement]:
        function, arguments = self.call(value, kernel)
        if function.value:
            return self._return_number(node, Invocation(function.value, function, arguments))
        given = dict(zip(function.parameters, arguments, strict=True))

        def rerooted(part: Returned) -> Returned:
            if isinstance(part, Group):
                return Group(part.name, tuple((name, rerooted(inner)) for name, inner in part.parts))
            alias = part not in function.results and not (isinstance(part.type, ArrayType) and not part.type.size)
            return cast("Returned", rooted(part, given)) if alias else part

        if function.returned is None:
            raise self.source.refusal(node, f"{function.name} has no result")
        self._agree(node, function.results, rerooted(function.returned), None)
        return [Invoke(function, arguments, function.results), Return()]

    def _return_number(self, node: ast.Return, number: Expression) -> list[Statement]:
        self._agree(node, (), None, cast("Kind", number.type))
        return [Return(number)]

    def _agree(
        self, node: ast.Return, results: tuple[Name, ...], returned: Returned | None, value: Kind | None
    ) -> None:  # fmt: skip
        """Note the types of what is returned, which are the same at each return."""
        if self.returns not in {None, (results, returned, value)}:
            raise self.source.refusal(node, "results of different types")
        self.returns = results, returned, value

    def _returned(self, node: ast.Return, part: Value, kept: list[Value]) -> Returned:
        """Return how results belong together; those that are no fields of parameters are added to `kept`."""
        if isinstance(part, Record):
            return Group(part.name, tuple((name, self._returned(node, inner, kept)) for name, inner in part.parts))
        if isinstance(part, DType | Shape | Python | Known):
            raise self.source.refusal(node, "results are arrays and numbers")
        if isinstance(part.type, ArrayType) and not part.type.size:
            return Name(part.type, "none")
        if isinstance(part, Field) and not isinstance(part.type, Kind) and self.is_constant(part):
            return part
        if isinstance(part, Name) and isinstance(part.type, RecordType) and part in self.parameters:
            return part
        if not isinstance(part.type, Kind | ArrayType) or (
            part in self.parameters and isinstance(part.type, ArrayType)
        ):
            raise self.source.refusal(node, SAME)
        kept.append(part)
        return Name(part.type, f"result_{len(kept) - 1}")

    def _augmented(
        self, target: ast.Name | ast.Subscript | ast.Attribute, sign: ast.operator, value: ast.expr
    ) -> list[Statement]:  # fmt: skip
        whole = ast.copy_location(ast.BinOp(target, sign, value), target)
        if isinstance(target, ast.Name) and not is_number(self.read(target)):
            raise self.source.refusal(target, "this is not a number that changes")
        return self.assigned(target, whole)
