"""Kernels as functions of the typed tree, one for each set of argument types, callees first."""

import ast
from typing import Final, cast

from numba.core.dispatcher import Dispatcher

from rig.plc_export.expressions import DType, Elementwise, ExpressionReader, Known, Python, Shape, Value, named
from rig.plc_export.subset import Source
from rig.plc_export.tree import (
    ArrayType,
    Assign,
    Declare,
    Element,
    Expression,
    Field,
    For,
    Function,
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


class Program:
    """Functions of kernels and of all that they call.

    Args:
        platform: Operators whose bits are the platform's library's and that are accepted all the same.
    """

    def __init__(self, platform: frozenset[str] = frozenset()) -> None:
        self.platform = platform
        self.functions: list[Function] = []
        """Callees before their callers."""
        self._known: dict[tuple[Dispatcher, tuple[Type, ...]], Function | None] = {}

    def function(self, kernel: Dispatcher, types: tuple[Type, ...]) -> Function:
        """Return the function of a kernel for arguments of these types.

        Raises:
            UnfitKernelError: The kernel, or one that it calls, is not in the subset.
        """
        key = (kernel, types)
        if key not in self._known:
            self._known[key] = None
            source = Source(kernel)
            name = source.name
            taken = sum(each.name == name or each.name.startswith(f"{name}__") for each in self.functions)
            found = KernelReader(source, self, types).function(f"{name}__{taken + 1}" if taken else name)
            self.functions.append(found)
            self._known[key] = found
        function = self._known[key]
        if function is None:
            source = Source(kernel)
            raise source.refusal(source.definition, f"{source.name} calls itself")
        return function


SAME: Final = "an array has one name and one type: copy() makes another"


class KernelReader(ExpressionReader):
    """Reads one kernel."""

    def __init__(self, source: Source, program: Program, types: tuple[Type, ...]) -> None:
        super().__init__(source, program.function, program.platform)
        arguments = source.definition.args
        if arguments.vararg or arguments.kwarg or arguments.kwonlyargs or arguments.defaults or arguments.posonlyargs:
            raise source.refusal(source.definition, "parameters are given by their places, without defaults")
        if len(arguments.args) != len(types):
            raise source.refusal(source.definition, f"{source.name} takes {len(arguments.args)} arguments")
        self.parameters = tuple(Name(kind, each.arg) for each, kind in zip(arguments.args, types, strict=True))
        self.scopes[0].update({each.name: each for each in self.parameters})
        self.returns: tuple[tuple[Name, ...] | None, Kind | None] | None = None
        self.intermediate = 0
        self.loop_variables: list[str] = []

    def function(self, name: str) -> Function:
        """Return the whole kernel."""
        definition = self.source.definition
        body = self.block(definition.body, new_scope=False)
        written = self.written & {each.name for each in self.parameters}
        where = f"{self.source.file}:{definition.lineno}"
        results, value = self.returns or (None, None)
        summary = (ast.get_docstring(definition) or "").partition("\n")[0]
        return Function(name, where, summary, self.parameters, written, self.used, results or (), value, body)

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
                return [self._called(call)]
            case ast.Assign(targets=[target], value=value):
                return self._assign(target, value)
            case ast.AugAssign(target=ast.Name() | ast.Subscript() as target, op=sign, value=value):
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

    def _called(self, node: ast.Call) -> Statement:
        called = self.read(node.func)
        if not isinstance(called, Python) or not isinstance(called.value, Dispatcher):
            raise self.source.refusal(node, "a call for what it writes is a call of a kernel")
        function, arguments = self.call(node, called.value)
        if function.results or function.value:
            raise self.source.refusal(node, f"the result of {function.name} is not used")
        return Invoke(function, arguments, ())

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
        nodes = value.elts if isinstance(value, ast.Tuple) else [value]
        if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
            if kernel := self._kernel(value.func):
                return self._return_call(node, value, kernel)
            called = self.read(value.func)
            if isinstance(called, Python) and hasattr(called.value, "_fields"):  # a record of results
                nodes = value.args
        parts = [self.typed(each, self.read(each)) for each in nodes]
        if len(parts) == 1 and nodes[0] is value and is_number(parts[0]):
            return self._return_number(node, cast("Expression", parts[0]))
        return [*self._results(node, parts), Return()]

    def _return_call(self, node: ast.Return, value: ast.Call, kernel: Dispatcher) -> list[Statement]:
        function, arguments = self.call(value, kernel)
        if function.value:
            return self._return_number(node, Invocation(function.value, function, arguments))
        self._agree(node, function.results, None)
        return [Invoke(function, arguments, function.results), Return()]

    def _return_number(self, node: ast.Return, number: Expression) -> list[Statement]:
        self._agree(node, None, cast("Kind", number.type))
        return [Return(number)]

    def _agree(self, node: ast.Return, results: tuple[Name, ...] | None, value: Kind | None) -> None:
        """Note the types of what is returned, which are the same at each return."""
        if self.returns not in {None, (results, value)}:
            raise self.source.refusal(node, "results of different types")
        self.returns = results, value

    def _results(self, node: ast.Return, parts: list[Value]) -> list[Statement]:
        """Return the assignments to the results; arrays without elements are none."""
        for part in parts:
            if isinstance(part, DType | Shape | Python | Known) or isinstance(part.type, RecordType):
                raise self.source.refusal(node, "results are arrays and numbers")
            if part in self.parameters and isinstance(part.type, ArrayType):
                raise self.source.refusal(node, SAME)
        kept = [part for part in cast("list[Expression | Elementwise]", parts)
                if not isinstance(part.type, ArrayType) or part.type.size]  # fmt: skip
        results = tuple(Name(part.type, f"result_{place}") for place, part in enumerate(kept))
        self._agree(node, results, None)
        return [each for target, part in zip(results, kept, strict=True) for each in self._store(target, part)]

    # -- assignments ---------------------------------------------------------------------------------------------------

    def _assign(self, target: ast.expr, value: ast.expr) -> list[Statement]:  # noqa: PLR0911 one case a form
        if isinstance(target, ast.Tuple):
            if isinstance(value, ast.Tuple) and len(value.elts) == len(target.elts):
                self._refuse_order(target, value)
                return [each for one, part in zip(target.elts, value.elts, strict=True)
                        for each in self._assign(one, part)]  # fmt: skip
            if isinstance(value, ast.Call):
                return self._several(target, value)
            raise self.source.refusal(target, "several values come from as many, or from the call of a kernel")
        if isinstance(target, ast.Subscript):
            return self._into_element(target, self.typed(value, self.read(value)))
        if not isinstance(target, ast.Name):
            raise self.source.refusal(target, "records are constant")
        if isinstance(value, ast.IfExp) and (choice := self._choice(target, value)):
            return choice
        if isinstance(value, ast.Call) and self._kernel(value.func):
            return self._several(ast.Tuple([target]), value)
        read = self.read(value)
        if isinstance(read, Known | DType | Shape | Python) or isinstance(read.type, RecordType):
            if target.id in self.source.assigned_once:
                self.scopes[-1][target.id] = read
                return []
            read = self.typed(value, read)
        return self._into_variable(target, read)

    def _choice(self, target: ast.Name, value: ast.IfExp) -> list[Statement]:
        """Return the decision between two new arrays; nothing where it is between numbers."""
        other = self.read(value.orelse) if isinstance(value.orelse, ast.Call) else None
        if not isinstance(other, Elementwise):
            return []
        condition = self.of_kind(value.test, Kind.BOOL)
        _, declared = self._variable(target, other.type)
        both = [self.block([ast.copy_location(ast.Assign([target], one), one)]) for one in (value.body, value.orelse)]
        return [*declared, If(condition, *both)]

    def _refuse_order(self, target: ast.Tuple, value: ast.Tuple) -> None:
        """Refuse assignments side by side where a later one reads what an earlier one has written."""
        written: set[str] = set()
        for one, part in zip(target.elts, value.elts, strict=True):
            if written & {node.id for node in ast.walk(part) if isinstance(node, ast.Name)}:
                raise self.source.refusal(target, "a value is read behind its assignment: two statements say the order")
            root = one.value if isinstance(one, ast.Subscript) else one
            written |= {root.id} if isinstance(root, ast.Name) else set()

    def _kernel(self, node: ast.expr) -> Dispatcher | None:
        called = self.read(node) if isinstance(node, ast.Name) else None
        return called.value if isinstance(called, Python) and isinstance(called.value, Dispatcher) else None

    def _several(self, target: ast.Tuple, value: ast.Call) -> list[Statement]:
        """Return the call of a kernel whose results go to variables."""
        kernel = self._kernel(value.func)
        if not kernel:
            raise self.source.refusal(value, "several values come from the call of a kernel")
        function, arguments = self.call(value, kernel)
        types = [function.value] if function.value else [result.type for result in function.results]
        if len(types) != len(target.elts):
            raise self.source.refusal(value, f"{function.name} has {len(types)} results")
        declared: list[Statement] = []
        names: list[Name] = []
        for one, kind in zip(target.elts, types, strict=True):
            if not isinstance(one, ast.Name):
                raise self.source.refusal(one, "results go to variables")
            variable, new = self._variable(one, kind)
            if isinstance(kind, ArrayType) and variable in arguments:
                raise self.source.refusal(one, "an array is argument and result at once")
            declared += new
            names.append(variable)
        if function.value:
            result = Invocation(function.value, function, arguments)
            return [Declare(names[0], result)] if declared else [Assign(names[0], result)]
        return [*declared, Invoke(function, arguments, tuple(names))]

    def _variable(self, node: ast.Name, kind: Type) -> tuple[Name, list[Statement]]:
        """Return the variable of a name and its declaration, where it is new."""
        for scope in reversed(self.scopes):
            if node.id in scope:
                found = scope[node.id]
                if not isinstance(found, Name) or found.type != kind:
                    raise self.source.refusal(node, f"{node.id} has another type already")
                if node.id in self.loop_variables:
                    raise self.source.refusal(node, f"{node.id} counts a loop")
                if found in self.parameters and not isinstance(kind, Kind):
                    raise self.source.refusal(node, SAME)
                return found, []
        variable = Name(kind, node.id)
        self.scopes[-1][node.id] = variable
        return variable, [Declare(variable)]

    def _into_variable(self, node: ast.Name, value: Value) -> list[Statement]:
        if isinstance(value, Known | DType | Shape | Python):
            raise self.source.refusal(node, "this is not a number")
        if isinstance(value, Name | Field) and isinstance(value.type, ArrayType):
            if not (isinstance(value, Name) and value.name.startswith("new_")):
                raise self.source.refusal(node, SAME)
            value = self._copy(node, value)
        kind = cast("Elementwise", value).type
        variable, new = self._variable(node, kind)
        if new and not isinstance(value, Elementwise):
            return [Declare(variable, cast("Expression", value))]
        if new and isinstance(value, Elementwise) and isinstance(value.at(self._first(value)), Literal):
            return new
        return [*new, *self._store(variable, value)]

    @staticmethod
    def _first(value: Elementwise) -> tuple[Expression, ...]:
        return tuple(Literal(Kind.INT, 0) for _ in value.type.shape)

    def _store(self, target: Name | Element, value: Value) -> list[Statement]:
        """Return the assignment of a number, or of an array element by element."""
        if isinstance(value, Name | Field) and isinstance(value.type, ArrayType):
            value = self._copy(ast.Pass(), value)  # type: ignore[arg-type]
        if isinstance(value, Elementwise):
            return self._elementwise(value, lambda indices: Element(value.type.kind, cast("Name", target), indices))
        return [Assign(target, cast("Expression", value))]

    def _elementwise(self, value: Elementwise, target: object) -> list[Statement]:
        """Return the loops over the elements of an array."""
        if not value.type.size:
            return []
        self.intermediate += 1
        variables = [Name(Kind.INT, f"at_{self.intermediate}_{place}") for place in range(len(value.type.shape))]
        inner: Statement = Assign(target(tuple(variables)), value.at(tuple(variables)))  # type: ignore[operator]
        for variable, length in zip(reversed(variables), reversed(value.type.shape), strict=True):
            inner = For(variable, Literal(Kind.INT, 0), Literal(Kind.INT, length), 1, (inner,))
        return [inner]

    def _into_element(self, target: ast.Subscript, value: Value) -> list[Statement]:
        element = self.element(target)
        array = self.storage(target.value)
        self.write_to(target, array)
        if isinstance(element, Element):
            if isinstance(value, Elementwise | DType | Shape | Python | Known) or value.type is not element.type:
                raise self.source.refusal(target, f"an element of type {element.type.value} gets a value of another")
            return [Assign(element, value)]
        if isinstance(value, Name | Field) and isinstance(value.type, ArrayType):
            value = self._copy(target, value)
        if not isinstance(value, Elementwise) or value.type != element.type:
            raise self.source.refusal(target, "a row gets an array of its type and length")
        return self._elementwise(value, element.at)

    def _augmented(self, target: ast.Name | ast.Subscript, sign: ast.operator, value: ast.expr) -> list[Statement]:
        whole = ast.copy_location(ast.BinOp(target, sign, value), target)
        if isinstance(target, ast.Name) and not is_number(self.read(target)):
            raise self.source.refusal(target, "this is not a number that changes")
        return self._assign(target, whole)

    # -- intermediate arrays -------------------------------------------------------------------------------------------

    def new_name(self, node: ast.AST, kind: Type) -> Name:
        """Return a new variable, declared before the statement."""
        if self.conditional:
            raise self.source.refusal(node, "an array that is made under a condition needs a statement of its own")
        self.intermediate += 1
        variable = Name(kind, f"new_{self.intermediate}")
        self.before.append(Declare(variable))
        return variable

    def named_array(self, node: ast.AST, value: Elementwise) -> Name:
        """Return a new variable that has the elements of an array."""
        variable = self.new_name(node, value.type)
        if not isinstance(value.at(self._first(value)), Literal):
            self.before += self._store(variable, value)
        return variable


def is_number(value: Value) -> bool:
    """Return whether a value is a typed scalar."""
    return not isinstance(value, Known | DType | Shape | Python | Elementwise) and isinstance(value.type, Kind)
