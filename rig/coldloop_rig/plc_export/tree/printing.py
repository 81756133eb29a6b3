"""What printers of the typed tree have in common: the table of literals, and where an element is in an array."""

import numpy as np

from coldloop_rig.plc_export.tree.nodes import ArrayType, Element, Expression, Kind, Literal, View


class TreePrinter:
    """Prints expressions of the tree for one floating-point type.

    Numbers with a point are elements of a constant array, which the self-test sums up with the other constants.
    """

    table: str
    """Name of that array."""

    def __init__(self, real: type[np.floating]) -> None:
        self.single = real is np.float32
        self.literals: list[str] = []

    def number(self, value: float) -> str:
        """Return a number with a point such that it is read back with the same bits."""
        raise NotImplementedError

    def expression(self, expression: Expression) -> str:
        """Return an expression."""
        raise NotImplementedError

    def literal(self, value: float) -> str:
        """Return the element of the table that has this value."""
        text = self.number(value)
        if text not in self.literals:
            self.literals.append(text)
        return f"{self.table}[{self.literals.index(text)}]"

    def place(self, element: Element) -> str:
        """Return the index of an element in its array, which is stored row by row."""
        assert isinstance(element.array.type, ArrayType)  # noqa: S101 by construction
        place = ""
        for index, length in zip(element.indices, element.array.type.shape, strict=True):
            place = f"{place} * {length} + {self.expression(index)}" if place else self.expression(index)
            place = f"({place})" if index is not element.indices[-1] and place.count(" ") else place
        if isinstance(element.array, View) and element.array.offset != Literal(Kind.INT, 0):
            return f"{self.expression(element.array.offset)} + {place}"
        return place
