"""Piecewise-cubic tables on uniform grids.

The tables hold, at each node, the value and the slopes of a twice differentiable cubic spline, the slopes multiplied
by the grid's step. Reading one is then the cubic Hermite formula between two nodes (or its tensor product between
four). Arguments outside the grid are held at its edge.

A table may have nodes before its start: it was made longer, and what is read of its first part keeps its bits.
"""

from math import floor
from typing import NamedTuple

from coldloop.kernels.compiled import inlined
from coldloop_plant.numeric import RealArray

# Weights of (left value, left slope, right value, right slope).
Weights = tuple[float, float, float, float]


class Curves(NamedTuple):
    """Several functions of one variable, tabulated on the same grid."""

    start: float
    """Argument at the node of index `before`."""
    step: float
    """Distance between nodes."""
    before: int
    """Nodes before the start."""
    nodes: RealArray
    """Shape (nodes, functions, 2): value, slope times step."""


class Surface(NamedTuple):
    """One function of two variables, tabulated."""

    row_start: float
    """First argument at the row of nodes of index `rows_before`."""
    row_step: float
    """Distance between rows."""
    rows_before: int
    """Rows before the start."""
    column_start: float
    """Second argument at the column of nodes of index `columns_before`."""
    column_step: float
    """Distance between columns."""
    columns_before: int
    """Columns before the start."""
    nodes: RealArray
    """Shape (rows, columns, 4): value, slope along the columns, slope along the rows, mixed slope."""


@inlined
def locate(position: float, start: float, step: float, before: int, count: int) -> tuple[int, float]:
    """Return the index of the node to the left of `position` and the fraction of the way to the next."""
    scaled = (position - start) / step
    index = max(min(floor(scaled.real), count - 2 - before), -before)
    fraction = scaled - index
    if fraction.real < 0.0:
        fraction = 0.0 * fraction
    elif fraction.real > 1.0:
        fraction = 0.0 * fraction + 1.0
    return index + before, fraction


@inlined
def hermite_weights(t: float) -> Weights:
    """Return the cubic Hermite weights at the fraction `t` of a step."""
    rest = 1.0 - t
    return (1.0 + 2.0 * t) * rest * rest, t * rest * rest, t * t * (3.0 - 2.0 * t), -t * t * rest


@inlined
def hermite_slope_weights(t: float) -> Weights:
    """Return the derivatives of the cubic Hermite weights with respect to `t`."""
    rest = 1.0 - t
    return -6.0 * t * rest, rest * (1.0 - 3.0 * t), 6.0 * t * rest, t * (3.0 * t - 2.0)


@inlined
def read_curve(nodes: RealArray, index: int, function: int, weights: Weights) -> float:
    """Return one function of a `Curves`, given the interval and the weights within it."""
    left: float = weights[0] * nodes[index, function, 0] + weights[1] * nodes[index, function, 1]
    right: float = weights[2] * nodes[index + 1, function, 0] + weights[3] * nodes[index + 1, function, 1]
    return left + right


@inlined
def read_surface(table: Surface, row: float, column: float) -> tuple[float, float]:
    """Return the function's value and its derivative along the columns."""
    i, t = locate(row, table.row_start, table.row_step, table.rows_before, table.nodes.shape[0])
    value, slope = _read_across(table, i, hermite_weights(t), column)
    return value, slope


@inlined
def read_surface_slopes(table: Surface, row: float, column: float) -> tuple[float, float, float]:
    """Return the function's value, its derivative along the columns, and that along the rows."""
    i, t = locate(row, table.row_start, table.row_step, table.rows_before, table.nodes.shape[0])
    value, slope = _read_across(table, i, hermite_weights(t), column)
    across, _ = _read_across(table, i, hermite_slope_weights(t), column)
    return value, slope, across / table.row_step


@inlined
def _read_across(table: Surface, i: int, across: Weights, column: float) -> tuple[float, float]:
    """Return value and derivative along the columns between the rows `i` and `i + 1`, weighted by `across`."""
    nodes = table.nodes
    j, s = locate(column, table.column_start, table.column_step, table.columns_before, nodes.shape[1])
    left, left_slope = _between_rows(nodes, i, j, across)
    right, right_slope = _between_rows(nodes, i, j + 1, across)
    w, d = hermite_weights(s), hermite_slope_weights(s)
    value = w[0] * left + w[1] * left_slope + w[2] * right + w[3] * right_slope
    slope = d[0] * left + d[1] * left_slope + d[2] * right + d[3] * right_slope
    return value, slope / table.column_step


@inlined
def _between_rows(nodes: RealArray, row: int, column: int, across: Weights) -> tuple[float, float]:
    """Return the value and the slope along the columns, at a column of nodes and between two rows."""
    value = across[0] * nodes[row, column, 0] + across[1] * nodes[row, column, 2]
    value += across[2] * nodes[row + 1, column, 0] + across[3] * nodes[row + 1, column, 2]
    slope = across[0] * nodes[row, column, 1] + across[1] * nodes[row, column, 3]
    slope += across[2] * nodes[row + 1, column, 1] + across[3] * nodes[row + 1, column, 3]
    return value, slope
