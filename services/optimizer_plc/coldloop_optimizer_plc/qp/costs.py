"""Costs of a profile: the augmented cost J that solvers decrease, its gradient, indicators (section V), residuals.

Gamma z - gamma and the gradient are computed here for all solvers, except by the interior-point method, which has its
variables in its own order.
"""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.qp.linear_algebra import Array, Columns, add_product, add_transposed_product, by_columns
from coldloop_optimizer_plc.qp.problem import OutputMaps, PredictiveProblem, QpParameters, QuadraticProblem


@kernel
def quadratic_cost(Phi: Array, phi: Array, z: Array) -> float:
    """Return z' Phi z + z' phi."""
    total = z.dtype.type(0.0)
    for i in range(z.shape[0]):
        row = phi[i]
        for j in range(z.shape[0]):
            row += Phi[i, j] * z[j]
        total += row * z[i]
    return total


@kernel
def augmented_cost(qp: QuadraticProblem, z: Array, alpha: float) -> float:
    """Return J(z) = J_0(z) + alpha sum max(Gamma z - gamma, 0)^2, without the constant, for z inside its box."""
    return quadratic_cost(qp.Phi, qp.phi, z) + alpha * positive_squares(row_excess(qp, z))


@kernel
def row_excess(qp: QuadraticProblem, z: Array) -> Array:
    """Return Gamma z - gamma, shape (m,)."""
    excess = -qp.gamma
    for r in range(excess.shape[0]):
        for j in range(z.shape[0]):
            excess[r] += qp.Gamma[r, j] * z[j]
    return excess


@kernel
def positive_squares(excess: Array) -> float:
    """Return sum max(excess, 0)^2 over `excess` (m,)."""
    zero = excess.dtype.type(0.0)
    total = zero
    for r in range(excess.shape[0]):
        if excess[r] > zero:
            total += excess[r] * excess[r]
    return total


class Matrices(NamedTuple):
    """The constant matrices of a problem, stored for products without the zeros at the ends of columns and rows.

    Phi (n, n), Gamma (m, n), and Gamma transposed: the rows of Gamma as columns.
    """

    Phi: Columns
    Gamma: Columns
    rows: Columns


def matrices_of(qp: QuadraticProblem) -> Matrices:
    """Return the matrices of a problem."""
    return Matrices(by_columns(qp.Phi), by_columns(qp.Gamma), by_columns(np.ascontiguousarray(qp.Gamma.T)))


@kernel
def cost_with_excess(constant: Matrices, qp: QuadraticProblem, z: Array, excess: Array, alpha: float) -> float:
    """Return what `augmented_cost` does, to the bit, for a problem with these matrices, from `excess_by_columns`."""
    slope = qp.phi.copy()
    add_product(constant.Phi, z, slope)
    total = z.dtype.type(0.0)
    for i in range(z.shape[0]):
        total += slope[i] * z[i]
    return total + alpha * positive_squares(excess)


@kernel
def excess_by_columns(constant: Matrices, qp: QuadraticProblem, z: Array) -> Array:
    """Return what `row_excess` does, to the bit, for a problem with these matrices."""
    excess = -qp.gamma
    add_product(constant.Gamma, z, excess)
    return excess


@kernel
def gradient(
    constant: Matrices, qp: QuadraticProblem, z: Array, excess: Array, alpha: float, result: Array, active: Array
) -> None:  # fmt: skip
    """Write dJ/dz into `result` (n,) and which rows push into `active` (m,) as 1.0 or 0.0.

    `excess` (m,) is Gamma z - gamma.
    """
    n = z.shape[0]
    zero, one, two = z.dtype.type(0.0), z.dtype.type(1.0), z.dtype.type(2.0)
    for i in range(n):
        result[i] = zero
    add_product(constant.Phi, z, result)
    for i in range(n):
        result[i] = two * result[i] + qp.phi[i]
    rows = constant.rows
    for r in range(excess.shape[0]):
        active[r] = zero
        if excess[r] > zero:
            active[r] = one
            factor = two * alpha * excess[r]
            for j in range(rows.first[r], rows.end[r]):
                result[j] += factor * rows.transposed[r, j]


class ProfileCosts(NamedTuple):
    """Predicted deviation and violation cost of a profile over the horizon, and its largest violated row.

    j_cst is that of the predicted outputs and never of the slacks, which may lie; the violation is
    max(Gamma p - gamma, 0), in the units of the row (%, K, or input units).
    """

    j_dev: float
    j_cst: float
    violation: float


def indicators(problem: PredictiveProblem, qp: QuadraticProblem, z: Array, parameters: QpParameters) -> ProfileCosts:
    """Return the indicators of profile z at the parameters (paper, section V); `qp` is the problem's instance there."""
    maps, real = problem.predicted, z.dtype.type
    return ProfileCosts(
        *map(float, predicted_indicators(maps, qp, z, parameters.x, real(parameters.w), problem.n_inputs))
    )


@kernel
def predicted_indicators(
    maps: OutputMaps, qp: QuadraticProblem, z: Array, x: Array, w: float, n_inputs: int
) -> ProfileCosts:
    """Return the indicators of profile z (n,) at the state x (n_x,) under the load w (W), both as deviations."""
    outputs = maps.resting.copy()
    add_transposed_product(maps.of_z, z, outputs)
    add_transposed_product(maps.of_x, x, outputs)
    zero, count, slackless = z.dtype.type(0.0), maps.bands.shape[1], z.copy()
    j_cst = zero
    for first in range(0, outputs.shape[0], count):
        for band in range(count):
            y = outputs[first + band] + maps.of_w[first + band] * w
            miss = max(y - maps.bands[1, band], zero) + max(maps.bands[0, band] - y, zero)
            j_cst += maps.bands[2, band] * miss * miss
    for i in range(n_inputs, z.shape[0]):
        slackless[i] = zero
    j_dev = quadratic_cost(qp.Phi, qp.phi, slackless) + qp.constant
    excess, violation = row_excess(qp, z), zero
    for r in range(excess.shape[0]):
        violation = max(violation, excess[r] / maps.row_gains[r])
    return ProfileCosts(j_dev, j_cst, violation)
