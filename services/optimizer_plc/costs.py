"""What a profile costs: the augmented cost J that solvers decrease, and the indicators of section V."""

from typing import NamedTuple

import numpy as np
from coldloop.compiled import kernel
from numpy.typing import NDArray

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
    """Return the indicators of profile z in a situation (paper, section V)."""
    design = problem.design
    slackless = z.copy()
    slackless[problem.n_inputs :] = 0.0
    deviation = quadratic_cost(qp.Phi, qp.phi, slackless) + qp.constant
    samples = problem.outputs_z.shape[0]
    outputs = np.zeros(2 * samples)
    apply(problem.stacked_outputs_z, z, outputs)
    apply(problem.stacked_outputs_s, np.append(situation.x, situation.w), outputs)
    y = outputs.reshape(samples, 2) + problem.y0
    v = np.maximum(y - design.output_high, 0.0) + np.maximum(design.output_low - y, 0.0)
    violated = float(np.sum(np.sum(v * v, axis=0) * design.violation_weight))
    rows = -qp.gamma
    apply(problem.Gamma_transposed, z, rows)
    return Indicators(deviation, violated, max(0.0, float(np.max(rows / problem.row_gains))))

