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
    total = 0.0
    for i in range(z.shape[0]):
        row = phi[i]
        for j in range(z.shape[0]):
            row += Phi[i, j] * z[j]
        total += row * z[i]
    return total


@kernel
def augmented_cost(qp: QuadraticProblem, z: Array, alpha: float) -> float:
    """Return J(z) = J_0(z) + alpha sum max(Gamma z - gamma, 0)^2, without the constant, for z inside its box."""
    penalty = 0.0
    for i in range(qp.Gamma.shape[0]):
        excess = -qp.gamma[i]
        for j in range(z.shape[0]):
            excess += qp.Gamma[i, j] * z[j]
        if excess > 0.0:
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
    slackless = z.copy()
    slackless[problem.n_inputs :] = 0.0
    j_dev = float(quadratic_cost(qp.Phi, qp.phi, slackless)) + qp.constant
    outputs = np.tile(problem.y0, problem.outputs_z.shape[0])
    apply(problem.stacked_outputs_z, z, outputs)
    apply(problem.stacked_outputs_s, np.append(situation.x, situation.w), outputs)
    rows = -qp.gamma
    apply(problem.Gamma_transposed, z, rows)
    return Indicators(j_dev, _violation_cost(outputs, problem.bands), _largest(rows, problem.row_gains))


@kernel
def _violation_cost(outputs: Array, bands: Array) -> float:
    """Return the weighted squares of what outputs (2 N, L1 and T5 in turn) miss bands (3, 2: low, high, weight) by."""
    total = 0.0
    for i in range(outputs.shape[0]):
        low, high, weight = bands[0, i % 2], bands[1, i % 2], bands[2, i % 2]
        miss = max(outputs[i] - high, 0.0) + max(low - outputs[i], 0.0)
        total += weight * miss * miss
    return total


@kernel
def _largest(rows: Array, gains: Array) -> float:
    largest = 0.0
    for i in range(rows.shape[0]):
        largest = max(largest, rows[i] / gains[i])
    return largest
