"""Kernels as functions of the typed tree, one for each set of argument types, callees first."""

import ast
from collections import Counter
from collections.abc import Callable
from types import MappingProxyType
from typing import Any, Final, cast

from coldloop_export import expressions, tree
from coldloop_export.calls import CallReader, Generic, Returned, rooted
from coldloop_export.expressions import Elementwise, Kernel, Known, Record, Source, Value, element_of, named
from coldloop_export.tree import ArrayType, Assign, Expression, Field, Kind, Literal, Name, Statement, Type, View

SAME: Final = "an array has one name and one type: copy() makes another"
RECORDS: Final = (tree.RecordType, tree.StructType, tree.RowsType)


class KernelReader(CallReader):
    """Reads one kernel."""

    def __init__(self, source: Source, program: "Program", types: tuple[Type, ...]) -> None:
        super().__init__(source, program)
        arguments = source.definition.args
        if arguments.vararg or arguments.kwarg or arguments.kwonlyargs or arguments.defaults or arguments.posonlyargs:
            raise source.refusal(source.definition, "parameters are given by their places, without defaults")
        if len(arguments.args) != len(types):
            raise source.refusal(source.definition, f"{source.name} takes {len(arguments.args)} arguments")
        self.parameters = tuple(Name(kind, each.arg) for each, kind in zip(arguments.args, types, strict=True))
        self.scopes[0].update({each.name: each for each in self.parameters})
        self.returns: tuple[tuple[Name, ...], Returned | None, Kind | None] | None = None

    def function(self, name: str) -> tree.Function:
        """Return the whole kernel."""
        definition = self.source.definition
        body = self.block(definition.body, new_scope=False)
        written = self.written & {each.name for each in self.parameters}
        where = f"{self.source.file}:{definition.lineno}"
        results, returned, value = self.returns or ((), None, None)
        summary = (ast.get_docstring(definition) or "").partition("\n")[0]
        return tree.Function(name, where, summary, self.parameters, written, self.used, results, returned, value, body)

    def assigned(self, target: ast.expr, value: ast.expr) -> list[Statement]:
        """Return what an assignment is."""
        self.alone.add(id(value))
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            return self._side_by_side(target, value)
        if isinstance(value, ast.Call) and (kernel := self.kernel(value)):
            return self._several(target, value, kernel)
        if isinstance(target, ast.Tuple):
            raise self.refusal(target, "several values come from as many, or from the call of a kernel")
        if isinstance(target, ast.Name) and isinstance(value, ast.IfExp) and (choice := self._choice(target, value)):
            return choice
        return self.into(target, self.read(value), value)

    def into(self, target: ast.expr, value: Value, node: ast.expr) -> list[Statement]:
        """Return the assignment of a value, which `node` is."""
        if isinstance(target, ast.Name):
            return self._into_name(target, value, node)
        if isinstance(target, ast.Subscript):
            return self._into_part(target, value, node)
        match place := self.read(target):
            case tree.Member(kind):
                pass
            case Field(Kind() as kind, record) if isinstance(record.type, tree.RecordType) and record.type.mutable:
                pass
            case _:
                raise self.refusal(target, "records are constant")
        self.write_to(target, place)
        return [Assign(place, self.of_type(target, kind, value, node))]

    def of_type(self, target: ast.expr, kind: Kind, value: Value, node: ast.expr) -> Expression:
        """Return a number for a place of this type; a number with a point that is known takes it."""
        if isinstance(value, Known) and kind is Kind.REAL and isinstance(value.value, float):
            return Literal(kind, value.value)
        typed = self.typed(node, value)
        self.refuse_if(typed.type is not kind, target, f"an element of type {kind.value} gets a value of another")
        return cast("Expression", typed)

    def _side_by_side(self, target: ast.Tuple, value: ast.Tuple) -> list[Statement]:
        """Return assignments of as many values, none of which reads what one before it has written."""
        if len(target.elts) != len(value.elts):
            raise self.refusal(target, "several values come from as many, or from the call of a kernel")
        written: set[str] = set()
        members: set[tuple[Type, str] | None] = set()
        statements: list[Statement] = []
        for one, part in zip(target.elts, value.elts, strict=True):
            if written & names_in(part):
                raise self.refusal(target, "a value is read behind its assignment: two statements say the order")
            written.add(root_of(one))
            before = len(self.before)
            new = self.assigned(one, part)
            if statements and len(self.before) > before:
                raise self.refusal(target, "a call behind another assignment: two statements say the order")
            values = tree.walk(tuple(each.value for each in new if isinstance(each, Assign)))
            if members & set(map(number_of, values)):
                raise self.refusal(target, "a number of a record is read behind its assignment")
            places = [each.target for each in new if isinstance(each, Assign)]
            members |= set(map(number_of, places)) - {None}
            statements += new
        return statements

    def _several(self, target: ast.expr, value: ast.Call, kernel: Kernel) -> list[Statement]:
        function, arguments = self.call(value, kernel)
        if function.value:
            if isinstance(target, ast.Tuple):
                raise self.refusal(target, f"{function.name} has one result")
            return self.into(target, tree.Invocation(function.value, function, arguments), value)
        if function.returned is None:
            raise self.refusal(value, f"{function.name} has no result")
        targets, returned = [target], [function.returned]
        if isinstance(target, ast.Tuple):
            targets, returned = target.elts, [part for _, part in getattr(function.returned, "parts", ())]
        self.refuse_if(len(targets) != len(returned), value, f"{function.name} has {max(len(returned), 1)} results")
        taken: dict[Name, Name] = {}
        declared: list[Statement] = []
        behind: list[tuple[ast.expr, Value]] = []
        for one, part in zip(targets, returned, strict=True):
            if isinstance(one, ast.Name) and part in function.results:
                variable, new = self.variable(one, part.type)
                if isinstance(variable.type, Kind) or variable not in arguments:
                    declared += new
                    taken[part] = variable
                    continue
            name = one.id if isinstance(one, ast.Name) else ""
            behind.append((one, self._taken(value, function, arguments, part, name, taken)))
        self.before += [*declared, tree.Invoke(function, arguments, tuple(taken[each] for each in function.results))]
        for one, got in behind:
            self.before += self.into(one, got, value)
        return []

    def _choice(self, target: ast.Name, value: ast.IfExp) -> list[Statement]:
        other = self.read(value.orelse) if isinstance(value.orelse, ast.Call) else None
        if not isinstance(other, Elementwise):
            return []
        condition = self.of_kind(value.test, Kind.BOOL)
        _, declared = self.variable(target, other.type)
        both = [self.block([ast.copy_location(ast.Assign([target], one), one)]) for one in (value.body, value.orelse)]
        return [*declared, tree.If(condition, *both)]

    def variable(self, node: ast.Name, kind: Type) -> tuple[Name, list[Statement]]:
        """Return the variable of a name and its declaration, where it is new."""
        found = next((scope[node.id] for scope in reversed(self.scopes) if node.id in scope), None)
        if found is not None:
            if not isinstance(found, Name) or found.type != kind:
                raise self.refusal(node, f"{node.id} has another type already")
            self.refuse_if(node.id in self.loop_variables, node, f"{node.id} counts a loop")
            if found in self.parameters and not isinstance(kind, Kind):
                raise self.refusal(node, SAME)
            return found, []
        variable = Name(kind, node.id)
        self.scopes[-1][node.id] = variable
        return variable, [tree.Declare(variable)]

    def _into_name(self, target: ast.Name, value: Value, node: ast.expr) -> list[Statement]:
        once = target.id in self.source.assigned_once
        if isinstance(value, Record):
            self.refuse_if(not (once and value.name), target, "a record is made once, and has a type with a name")
            self.scopes[-1][target.id] = self.recorded(node, value, target.id)
            return []
        if isinstance(value, View | tree.Item) and once:
            variable = Name(value.type, target.id)
            self.scopes[-1][target.id] = variable
            self.pointers[target.id] = value
            return [tree.Point(variable, value, self.is_constant(value))]
        fixed = isinstance(value, expressions.Untyped) or isinstance(value.type, RECORDS)
        if once and (fixed or (isinstance(value, Field) and isinstance(value.type, ArrayType))):
            self.scopes[-1][target.id] = value
            return []
        return self._into_variable(target, self.typed(node, value))

    def _into_variable(self, node: ast.Name, value: Value) -> list[Statement]:
        if isinstance(value, expressions.Untyped) or isinstance(value.type, RECORDS):
            raise self.refusal(node, "this is not a number")
        if isinstance(value, Name | Field | View) and isinstance(value.type, ArrayType):
            if not (isinstance(value, Name) and value.name.startswith("new_")):
                raise self.refusal(node, SAME)
            value = self.copied(node, value)
        variable, new = self.variable(node, value.type)
        if new and not isinstance(value, Elementwise):
            return [tree.Declare(variable, value)]
        if new and isinstance(value, Elementwise) and isinstance(value.at(first_of(value)), Literal):
            return new
        return [*new, *self.store(variable, value)]

    def store(self, target: tree.Target, value: Value) -> list[Statement]:
        """Return the assignment of a number, or of an array element by element."""
        if isinstance(value, Name | Field | View) and isinstance(value.type, ArrayType):
            value = self.copied(ast.Pass(), value)
        if isinstance(value, Elementwise):
            kind, array = value.type.kind, cast("Name", target)
            return self._elementwise(value, lambda indices: tree.Element(kind, array, indices))
        return [Assign(target, cast("Expression", value))]

    def _elementwise(self, value: Elementwise, target: Any) -> list[Statement]:  # noqa: ANN401 element of indices
        """Return the loops over the elements of an array."""
        if not value.type.size:
            return []
        self.intermediate += 1
        variables = [Name(Kind.INT, f"at_{self.intermediate}_{place}") for place in range(len(value.type.shape))]
        inner: Statement = Assign(target(tuple(variables)), value.at(tuple(variables)))
        for variable, length in zip(reversed(variables), reversed(value.type.shape), strict=True):
            inner = tree.For(variable, expressions.ZERO, Literal(Kind.INT, length), 1, (inner,))
        return [inner]

    def _into_part(self, target: ast.Subscript, value: Value, node: ast.expr) -> list[Statement]:
        """Return the assignment to an element, to a part of an array, or to a record in an array."""
        place = self.read(target)
        self.write_to(target, place)
        if isinstance(place, tree.Element):
            return [Assign(place, self.of_type(target, place.type, value, node))]
        if isinstance(place, tree.Item):
            if not isinstance(value, tree.Item) or value.type != place.type:
                raise self.refusal(target, "a record of numbers gets one of its type")
            return [tree.Copy(place, value)]
        if not isinstance(place, View):
            raise self.refusal(target, "this cannot be written to")
        kind = place.type
        if not isinstance(value.type, ArrayType):
            number = self.of_type(target, kind.kind, value, node)
            value = Elementwise(kind, lambda _indices: number)
        self.refuse_if(value.type != kind, target, "a row gets an array of its type and length")
        whole = value
        row = self._row(target, place)
        return self._elementwise(Elementwise(kind, lambda indices: element_of(whole, indices)), row)

    def _row(self, target: ast.Subscript, place: View) -> Any:  # noqa: ANN401
        """Return what gives the element of a part of an array: by all indices of the array, where it is a row."""
        array = self.storage(target.value)
        if isinstance(target.slice, ast.Slice):
            whole = array if place.type == array.type else place
            return lambda indices: element_of(whole, indices)
        if isinstance(array, View) or not isinstance(array.type, ArrayType):
            return lambda indices: element_of(place, indices)
        places = target.slice.elts if isinstance(target.slice, ast.Tuple) else [target.slice]
        fixed = tuple(self.index(each, length) for each, length in zip(places, array.type.shape, strict=False))
        return lambda indices: tree.Element(place.type.kind, cast("Name", array), fixed + indices)

    def named_array(self, node: ast.AST, value: Elementwise) -> Name:
        """Return a new variable that has the elements of an array."""
        variable = self.new_name(node, value.type)
        if not isinstance(value.at(first_of(value)), Literal):
            self.before += self.store(variable, value)
        return variable

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

    def statement(self, node: ast.stmt) -> list[Statement]:  # noqa: C901, PLR0911 one case a statement
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
                if set(map(root_of, targets)) & names_in(value):
                    raise self.refusal(value, "a value is read behind its assignment: two statements say the order")
                read = self.read(value)
                return [each for one in targets for each in self.into(one, read, value)]
            case ast.AugAssign(target=ast.Name() | ast.Subscript() | ast.Attribute() as target, op=sign, value=value):
                if isinstance(target, ast.Name) and not isinstance(self.read(target).type, Kind):
                    raise self.refusal(target, "this is not a number that changes")
                return self.assigned(target, ast.copy_location(ast.BinOp(target, sign, value), target))
            case ast.For(target=ast.Name(id=name), iter=ast.Call() as counted, orelse=[]):
                return self._for(node, name, counted)
            case ast.While(test=test, orelse=[]):
                self.conditional += 1
                condition = self.of_kind(test, Kind.BOOL)
                self.conditional -= 1
                return [tree.While(condition, self.block(node.body))]
            case ast.If(test=test):
                condition = self.of_kind(test, Kind.BOOL)
                return [tree.If(condition, self.block(node.body), self.block(node.orelse))]
            case ast.Return(value=value):
                return self._return(node, value)
        raise self.refusal(node, f"the statement {type(node).__name__} is not in the subset in this form")

    def _called(self, node: ast.Call) -> list[Statement]:
        kernel = self.kernel(node)
        if not kernel:
            raise self.refusal(node, "a call for what it writes is a call of a kernel")
        function, arguments = self.call(node, kernel)
        if function.value:
            raise self.refusal(node, f"the result of {function.name} is not used")
        if function.returned:  # for what it writes alone
            self.received(node, function, arguments, function.returned, "")
            return []
        return [tree.Invoke(function, arguments, ())]

    def _for(self, node: ast.For, name: str, counted: ast.Call) -> list[Statement]:
        if not (isinstance(counted.func, ast.Name) and counted.func.id == "range") or counted.keywords:
            raise self.refusal(node, "a loop counts: for ... in range(...)")
        bounds = [self.scalar(each) for each in counted.args]
        step = self.known_integer(counted.args[2]) if len(bounds) == 3 else 1
        start, stop = (Literal(Kind.INT, 0), bounds[0]) if len(bounds) == 1 else bounds[:2]
        if start.type is Kind.INT and stop.type is Kind.UNSIGNED and len(bounds) == 1:
            start = Literal(Kind.UNSIGNED, 0)
        if start.type is not stop.type or start.type not in {Kind.INT, Kind.UNSIGNED} or not step:
            raise self.refusal(node, f"a loop from {named(start.type)} to {named(stop.type)}")
        self.refuse_if(any(name in scope for scope in self.scopes), node, f"{name} is a variable already")
        variable = Name(start.type, name)
        self.loop_variables.append(name)
        self.scopes.append({name: variable})
        body = self.block(node.body)
        self.scopes.pop()
        self.loop_variables.pop()
        return [tree.For(variable, start, stop, step, body)]

    def _return(self, node: ast.Return, value: ast.expr | None) -> list[Statement]:
        if value is None:
            return [tree.Return()]
        if isinstance(value, ast.Call) and (kernel := self.kernel(value)):
            return self._return_call(node, value, kernel)
        read = self.typed(value, self.read(value))
        if isinstance(read.type, Kind):
            self._agree(node, (), None, read.type)
            return [tree.Return(cast("Expression", read))]
        kept: list[Value] = []
        returned = self._returned(node, read, kept)
        results = tuple(Name(part.type, f"result_{place}")  # type: ignore[arg-type]
                        for place, part in enumerate(kept))  # fmt: skip
        self._agree(node, results, returned, None)
        stored = [each for target, part in zip(results, kept, strict=True) for each in self.store(target, part)]
        return [*stored, tree.Return()]

    def _return_call(self, node: ast.Return, value: ast.Call, kernel: Kernel) -> list[Statement]:
        function, arguments = self.call(value, kernel)
        if function.value:
            self._agree(node, (), None, function.value)
            return [tree.Return(tree.Invocation(function.value, function, arguments))]
        given = dict(zip(function.parameters, arguments, strict=True))

        def rerooted(part: Returned) -> Returned:
            if isinstance(part, tree.Group):
                return tree.Group(part.name, tuple((name, rerooted(inner)) for name, inner in part.parts))
            alias = part not in function.results and not (isinstance(part.type, ArrayType) and not part.type.size)
            return cast("Returned", rooted(part, given)) if alias else part

        if function.returned is None:
            raise self.refusal(node, f"{function.name} has no result")
        self._agree(node, function.results, rerooted(function.returned), None)
        return [tree.Invoke(function, arguments, function.results), tree.Return()]

    def _agree(
        self, node: ast.Return, results: tuple[Name, ...], returned: Returned | None, value: Kind | None
    ) -> None:
        """Note the types of what is returned, which are the same at each return."""
        self.refuse_if(self.returns not in {None, (results, returned, value)}, node, "results of different types")
        self.returns = results, returned, value

    def _returned(self, node: ast.Return, part: Value, kept: list[Value]) -> Returned:
        """Return how results belong together; those that are no fields of parameters are added to `kept`."""
        if isinstance(part, Record):
            return tree.Group(part.name, tuple((name, self._returned(node, inner, kept)) for name, inner in part.parts))
        if isinstance(part, expressions.Untyped):
            raise self.refusal(node, "results are arrays and numbers")
        if isinstance(part.type, ArrayType) and not part.type.size:
            return Name(part.type, "none")
        if isinstance(part, Field) and not isinstance(part.type, Kind) and self.is_constant(part):
            return part
        if isinstance(part, Name) and isinstance(part.type, tree.RecordType) and part in self.parameters:
            return part
        if not isinstance(part.type, Kind | ArrayType) or (
            part in self.parameters and isinstance(part.type, ArrayType)
        ):
            raise self.refusal(node, SAME)
        kept.append(part)
        return Name(part.type, f"result_{len(kept) - 1}")


def root_of(target: ast.expr) -> str:
    """Return the array, variable or number of a record that is written to, as it is spelt."""
    while isinstance(target, ast.Subscript):
        target = target.value
    return ast.unparse(target)


def names_in(node: ast.expr) -> set[str]:
    """Return all that an expression reads, as it is spelt."""
    return {ast.unparse(each) for each in ast.walk(node) if isinstance(each, ast.Name | ast.Attribute)}


def number_of(node: object) -> tuple[Type, str] | None:
    """Return the type of record that a number belongs to, and its name there; None of anything else."""
    if isinstance(node, tree.Member):
        return node.struct.type, node.name
    return (node.record.type, node.name) if isinstance(node, Field) and isinstance(node.type, Kind) else None


def first_of(value: Elementwise) -> tuple[Expression, ...]:
    """Return the indices of the first element."""
    return tuple(expressions.ZERO for _ in value.type.shape)


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
        self.functions: list[tree.Function] = []
        """Callees before their callers."""
        self._names: Counter[str] = Counter()
        self._known: dict[tuple[Kernel, tuple[Type, ...]], tree.Function | None] = {}

    def function(self, kernel: Kernel, types: tuple[Type, ...]) -> tree.Function:
        """Return the function of a kernel for arguments of these types.

        Raises UnfitKernelError if the kernel, or one that it calls, is not in the subset.
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
