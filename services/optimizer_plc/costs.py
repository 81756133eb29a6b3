"""What a profile costs: the augmented cost J that solvers decrease, and the indicators of section V."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.compiled import kernel
from optimizer_plc.linear_algebra import apply
from optimizer_plc.problem import PredictiveProblem, QuadraticProblem, Situation

Array = NDArray[np.float64]


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
    zero = z.dtype.type(0.0)
    penalty = zero
    for i in range(qp.Gamma.shape[0]):
        excess = -qp.gamma[i]
        for j in range(z.shape[0]):
            excess += qp.Gamma[i, j] * z[j]
        if excess > zero:
            penalty += excess * excess
    return quadratic_cost(qp.Phi, qp.phi, z) + alpha * penalty


class Indicators(NamedTuple):
    """Predicted costs and violation of a profile."""

    j_dev: float
    """Deviation cost over the horizon."""
    j_cst: float
    """Violation cost over the horizon, from the predicted outputs and never from the slacks, which may lie."""
    violation: float
    """Largest violated row, max(Gamma p - gamma, 0), in the units of the row (%, K, or input units)."""


def indicators(problem: PredictiveProblem, qp: QuadraticProblem, z: Array, situation: Situation) -> Indicators:
    """Return the indicators of profile z in a situation (paper, section V); `qp` is the problem's instance there."""
    outputs = problem.resting_outputs.copy()
    apply(problem.stacked_outputs_z, z, outputs)
    apply(problem.stacked_outputs_x, situation.x, outputs)
    j_cst = violation_cost(outputs, problem.stacked_outputs_w, situation.w, problem.bands)
    j_dev = deviation_cost(qp, z, problem.n_inputs) + qp.constant
    return Indicators(j_dev, j_cst, largest_violation(qp, z, problem.row_gains))


@kernel
def deviation_cost(qp: QuadraticProblem, z: Array, n_inputs: int) -> float:
    """Return J_0 of the inputs alone, without slacks and without the constant."""
    slackless = z.copy()
    slackless[n_inputs:] = z.dtype.type(0.0)
    return quadratic_cost(qp.Phi, qp.phi, slackless)


@kernel
def violation_cost(outputs: Array, through_w: Array, w: float, bands: Array) -> float:
    """Return the weighted squares of what outputs + through_w w miss their bands by.

    Outputs (2 N) are L1 and T5 in turn; bands (3, 2) are low, high and weight.
    """
    zero = outputs.dtype.type(0.0)
    total = zero
    for i in range(outputs.shape[0]):
        y = outputs[i] + through_w[i] * w
        miss = max(y - bands[1, i % 2], zero) + max(bands[0, i % 2] - y, zero)
        total += bands[2, i % 2] * miss * miss
    return total


@kernel
def largest_violation(qp: QuadraticProblem, z: Array, gains: Array) -> float:
    """Return max(Gamma z - gamma, 0) over the rows, each divided by its gain."""
    largest = z.dtype.type(0.0)
    for r in range(qp.Gamma.shape[0]):
        excess = -qp.gamma[r]
        for j in range(z.shape[0]):
            excess += qp.Gamma[r, j] * z[j]
        largest = max(largest, excess / gains[r])
    return largest
