"""Assignments in a kernel: to variables, elements, parts of arrays and numbers of records; results of calls."""

import ast
from collections.abc import Sequence
from typing import Any, Final, cast

from coldloop_rig.plc_export.tree.calls import CallReader, Returned
from coldloop_rig.plc_export.tree.expressions import ZERO, element_of
from coldloop_rig.plc_export.tree.nodes import (
    ArrayType,
    Assign,
    Copy,
    Declare,
    Element,
    Expression,
    Field,
    For,
    If,
    Invocation,
    Invoke,
    Item,
    Kind,
    Literal,
    Member,
    Name,
    Point,
    RecordType,
    Statement,
    Target,
    Type,
    View,
    walk,
)
from coldloop_rig.plc_export.tree.subset import Kernel
from coldloop_rig.plc_export.tree.values import (
    DType,
    Elementwise,
    Known,
    Python,
    Record,
    Shape,
    Value,
    array_type,
    is_aggregate,
    is_number,
)

SAME: Final = "an array has one name and one type: copy() makes another"


class AssignmentReader(CallReader):
    """Reads assignments."""

    parameters: tuple[Name, ...]

    def assigned(self, target: ast.expr, value: ast.expr) -> list[Statement]:
        """Return what an assignment is."""
        self.alone.add(id(value))
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            return self._side_by_side(target, value)
        if isinstance(value, ast.Call) and (kernel := self.kernel(value)):
            return self._several(target, value, kernel)
        if isinstance(target, ast.Tuple):
            raise self.source.refusal(target, "several values come from as many, or from the call of a kernel")
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
            case Member(kind):
                pass
            case Field(Kind() as kind, record) if isinstance(record.type, RecordType) and record.type.mutable:
                pass
            case _:
                raise self.source.refusal(target, "records are constant")
        self.write_to(target, place)
        return [Assign(place, self.of_type(target, kind, value, node))]

    def into_all(self, targets: Sequence[ast.expr], node: ast.expr) -> list[Statement]:
        """Return the assignments of one value to several places, none of which it reads."""
        if set(map(root_of, targets)) & names_in(node):
            raise self.source.refusal(node, "a value is read behind its assignment: two statements say the order")
        value = self.read(node)
        return [each for one in targets for each in self.into(one, value, node)]

    def of_type(self, target: ast.expr, kind: Kind, value: Value, node: ast.expr) -> Expression:
        """Return a number for a place of this type; a number with a point that is known takes it."""
        if isinstance(value, Known) and kind is Kind.REAL and isinstance(value.value, float):
            return Literal(kind, value.value)
        typed = self.typed(node, value)
        if not is_number(typed) or cast("Expression", typed).type is not kind:
            raise self.source.refusal(target, f"an element of type {kind.value} gets a value of another")
        return cast("Expression", typed)

    def _side_by_side(self, target: ast.Tuple, value: ast.Tuple) -> list[Statement]:
        """Return assignments of as many values, none of which reads what one before it has written."""
        if len(target.elts) != len(value.elts):
            raise self.source.refusal(target, "several values come from as many, or from the call of a kernel")
        written: set[str] = set()
        members: set[tuple[Type, str] | None] = set()
        statements: list[Statement] = []
        for one, part in zip(target.elts, value.elts, strict=True):
            if written & names_in(part):
                raise self.source.refusal(target, "a value is read behind its assignment: two statements say the order")
            written.add(root_of(one))
            before = len(self.before)
            new = self.assigned(one, part)
            if statements and len(self.before) > before:
                raise self.source.refusal(target, "a call behind another assignment: two statements say the order")
            values = walk(tuple(each.value for each in new if isinstance(each, Assign)))
            if members & set(map(number_of, values)):
                raise self.source.refusal(target, "a number of a record is read behind its assignment")
            places = [each.target for each in new if isinstance(each, Assign)]
            members |= set(map(number_of, places)) - {None}
            statements += new
        return statements

    # -- results of calls ----------------------------------------------------------------------------------------------

    def _several(self, target: ast.expr, value: ast.Call, kernel: Kernel) -> list[Statement]:
        """Return the call of a kernel whose results go where they are to."""
        function, arguments = self.call(value, kernel)
        if function.value:
            if isinstance(target, ast.Tuple):
                raise self.source.refusal(target, f"{function.name} has one result")
            return self.into(target, Invocation(function.value, function, arguments), value)
        targets, returned = self._paired(target, value, function.name, function.returned)
        taken: dict[Name, Name] = {}
        declared: list[Statement] = []
        behind: list[tuple[ast.expr, Value]] = []
        for one, part in zip(targets, returned, strict=True):
            if isinstance(one, ast.Name) and part in function.results:
                variable, new = self.variable(one, part.type)
                if is_number(variable) or variable not in arguments:
                    declared += new
                    taken[part] = variable
                    continue
            name = one.id if isinstance(one, ast.Name) else ""
            behind.append((one, self._taken(value, function, arguments, part, name, taken)))
        self.before += [*declared, Invoke(function, arguments, tuple(taken[each] for each in function.results))]
        for one, got in behind:
            self.before += self.into(one, got, value)
        return []

    def _paired(
        self, target: ast.expr, value: ast.Call, name: str, returned: Returned | None
    ) -> tuple[list[ast.expr], list[Returned]]:  # fmt: skip
        """Return targets, and what is returned for each of them."""
        if returned is None:
            raise self.source.refusal(value, f"{name} has no result")
        if not isinstance(target, ast.Tuple):
            return [target], [returned]
        parts = [part for _, part in getattr(returned, "parts", ())]
        if len(parts) != len(target.elts):
            raise self.source.refusal(value, f"{name} has {max(len(parts), 1)} results")
        return target.elts, parts

    # -- variables -----------------------------------------------------------------------------------------------------

    def _choice(self, target: ast.Name, value: ast.IfExp) -> list[Statement]:
        """Return the decision between two new arrays; nothing where it is between numbers."""
        other = self.read(value.orelse) if isinstance(value.orelse, ast.Call) else None
        if not isinstance(other, Elementwise):
            return []
        condition = self.of_kind(value.test, Kind.BOOL)
        _, declared = self.variable(target, other.type)
        both = [self.block([ast.copy_location(ast.Assign([target], one), one)]) for one in (value.body, value.orelse)]
        return [*declared, If(condition, *both)]

    def block(self, nodes: list[ast.stmt], *, new_scope: bool = True) -> tuple[Statement, ...]:
        """Return the statements of a block."""
        raise NotImplementedError

    def variable(self, node: ast.Name, kind: Type) -> tuple[Name, list[Statement]]:
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

    def _into_name(self, target: ast.Name, value: Value, node: ast.expr) -> list[Statement]:
        once = target.id in self.source.assigned_once
        if isinstance(value, Record):
            if not (once and value.name):
                raise self.source.refusal(target, "a record is made once, and has a type with a name")
            self.scopes[-1][target.id] = self.recorded(node, value, target.id)
            return []
        if isinstance(value, View | Item) and once:
            variable = Name(value.type, target.id)
            self.scopes[-1][target.id] = variable
            self.pointers[target.id] = value
            return [Point(variable, value, self.is_constant(value))]
        fixed = isinstance(value, Known | DType | Shape | Python) or is_aggregate(value.type)
        if once and (fixed or (isinstance(value, Field) and isinstance(value.type, ArrayType))):
            self.scopes[-1][target.id] = value
            return []
        return self._into_variable(target, self.typed(node, value))

    def _into_variable(self, node: ast.Name, value: Value) -> list[Statement]:
        if isinstance(value, Known | DType | Shape | Python | Record) or is_aggregate(value.type):
            raise self.source.refusal(node, "this is not a number")
        if isinstance(value, Name | Field | View) and isinstance(value.type, ArrayType):
            if not (isinstance(value, Name) and value.name.startswith("new_")):
                raise self.source.refusal(node, SAME)
            value = self.copied(node, value)
        variable, new = self.variable(node, value.type)
        if new and not isinstance(value, Elementwise):
            return [Declare(variable, value)]
        if new and isinstance(value, Elementwise) and isinstance(value.at(first_of(value)), Literal):
            return new
        return [*new, *self.store(variable, value)]

    def store(self, target: Target, value: Value) -> list[Statement]:
        """Return the assignment of a number, or of an array element by element."""
        if isinstance(value, Name | Field | View) and isinstance(value.type, ArrayType):
            value = self.copied(ast.Pass(), value)
        if isinstance(value, Elementwise):
            return self._elementwise(value, lambda indices: Element(value.type.kind, cast("Name", target), indices))
        return [Assign(target, cast("Expression", value))]

    def _elementwise(self, value: Elementwise, target: Any) -> list[Statement]:  # noqa: ANN401 element of indices
        """Return the loops over the elements of an array."""
        if not value.type.size:
            return []
        self.intermediate += 1
        variables = [Name(Kind.INT, f"at_{self.intermediate}_{place}") for place in range(len(value.type.shape))]
        inner: Statement = Assign(target(tuple(variables)), value.at(tuple(variables)))
        for variable, length in zip(reversed(variables), reversed(value.type.shape), strict=True):
            inner = For(variable, ZERO, Literal(Kind.INT, length), 1, (inner,))
        return [inner]

    # -- elements ------------------------------------------------------------------------------------------------------

    def _into_part(self, target: ast.Subscript, value: Value, node: ast.expr) -> list[Statement]:
        """Return the assignment to an element, to a part of an array, or to a record in an array."""
        place = self.read(target)
        self.write_to(target, place)
        if isinstance(place, Element):
            return [Assign(place, self.of_type(target, place.type, value, node))]
        if isinstance(place, Item):
            if not isinstance(value, Item) or value.type != place.type:
                raise self.source.refusal(target, "a record of numbers gets one of its type")
            return [Copy(place, value)]
        if not isinstance(place, View):
            raise self.source.refusal(target, "this cannot be written to")
        kind = place.type
        if array_type(value) is None:
            number = self.of_type(target, kind.kind, value, node)
            value = Elementwise(kind, lambda _indices: number)
        if array_type(value) != kind:
            raise self.source.refusal(target, "a row gets an array of its type and length")
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
        return lambda indices: Element(place.type.kind, cast("Name", array), fixed + indices)

    def named_array(self, node: ast.AST, value: Elementwise) -> Name:
        """Return a new variable that has the elements of an array."""
        variable = self.new_name(node, value.type)
        if not isinstance(value.at(first_of(value)), Literal):
            self.before += self.store(variable, value)
        return variable


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
    if isinstance(node, Member):
        return node.struct.type, node.name
    return (node.record.type, node.name) if isinstance(node, Field) and is_number(node) else None


def first_of(value: Elementwise) -> tuple[Expression, ...]:
    """Return the indices of the first element."""
    return tuple(ZERO for _ in value.type.shape)
