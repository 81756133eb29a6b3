"""Indicators of a finished run (paper, section V)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.lti_model import LtiModel
from coldloop.process import L1, T5, TICK_S, TICKS_PER_SAMPLE
from optimizer_plc.design import ControlDesign
from optimizer_plc.prediction import state_weights
from rig.recording import Recording


class Indicators(NamedTuple):
    """Costs are in the units of the predictive problem's J; sums run over the problems solved, as in the paper."""

    J_dev: float
    """Sum over the problems of the predicted deviation cost."""
    J_cst: float
    """Sum over the problems of the predicted violation cost."""
    J_open_mean: float
    """Mean of J_dev + J_cst per unit of time: comparable between updating periods. A problem weighs by the time since
    the last delivery, which counts the time lost by an interrupted one."""
    J_BF: float
    """Closed-loop cost: sum of the instantaneous cost over the sampling periods of 5 s."""
    c1: float
    """Largest predicted constraint violation, in the units of the row."""
    c2: float
    """Mean over the problems of the largest predicted violation."""
    tau_u_mean: float
    """Mean updating period, s."""
    iterations_total: int
    L1_outside_band_pct: float
    T5_outside_band_pct: float


def instantaneous_cost(recording: Recording, model: LtiModel, design: ControlDesign) -> NDArray[np.float64]:
    """Return the stage cost of each tick, shape (N,): deviations and violations of what was really reached."""
    x = recording.x.astype(float) - model.x0
    u = recording.u.astype(float) - model.u0
    constrained = recording.y[:, [L1, T5]].astype(float)
    violation = np.maximum(constrained - design.output_high, 0) + np.maximum(design.output_low - constrained, 0)
    cost: NDArray[np.float64] = (
        (x**2 * state_weights(model, design)).sum(axis=1)
        + (u**2 * design.input_weight).sum(axis=1)
        + (violation**2 * design.violation_weight).sum(axis=1)
    )
    return cost


def evaluate(recording: Recording, model: LtiModel, design: ControlDesign) -> Indicators:
    """Compute all indicators."""
    updates = recording.updates
    open_loop = np.array([[update.j_dev, update.j_cst] for update in updates], dtype=float).reshape(-1, 2)
    violations = np.array([update.violation for update in updates], dtype=float)
    tau = np.array([update.tau_u for update in updates], dtype=float)
    delivered = np.array([update.tick + update.tau_u for update in updates], dtype=float)
    since = np.diff(delivered, prepend=0.0)
    outside = _outside_pct(recording, design)
    return Indicators(
        J_dev=float(open_loop[:, 0].sum()),
        J_cst=float(open_loop[:, 1].sum()),
        J_open_mean=float(np.average(open_loop.sum(axis=1), weights=since)) if updates else 0.0,
        J_BF=float(instantaneous_cost(recording, model, design).sum() / TICKS_PER_SAMPLE),
        c1=float(violations.max(initial=0.0)),
        c2=float(violations.mean()) if updates else 0.0,
        tau_u_mean=float(tau.mean() * TICK_S) if updates else 0.0,
        iterations_total=sum(update.iterations for update in updates),
        L1_outside_band_pct=outside[0],
        T5_outside_band_pct=outside[1],
    )


def _outside_pct(recording: Recording, design: ControlDesign) -> tuple[float, float]:
    constrained = recording.y[:, [L1, T5]]
    outside = (constrained < design.output_low) | (constrained > design.output_high)
    level, temperature = 100.0 * outside.mean(axis=0)
    return float(level), float(temperature)
