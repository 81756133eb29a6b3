"""Compares the condensed problem of the process that is loaded with a direct build of it: `COLDLOOP_PROCESS=MODEL ...`.

The direct one knows the paper's equations, the process and its linear model only: profiles are interpolated, states
simulated sample by sample, and what is summed is written out. Prints, for random situations, by how much the cost of
the one's optimum differs from that of the other's, and by how much it leaves the other's constraints.
"""

import numpy as np
from numpy.typing import NDArray

from coldloop.process.limits import InputLimits
from coldloop.process.loaded import PROCESS
from coldloop.process.lti_model import load
from coldloop.process.model_settings import DEFAULT_MODEL_FILE
from optimizer_plc.qp.design import ControlDesign
from optimizer_plc.qp.prediction import PredictionModel
from optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from tests.harness.reference_qp import solved_by_daqp

Array = NDArray[np.float64]

SITUATIONS = 20
MODEL = load(DEFAULT_MODEL_FILE)
KNOTS = np.array(PROCESS.decision_instants)
INSTANTS = np.array(PROCESS.constraint_instants)
SAMPLES = int(KNOTS[-1])
M, BANDS = len(PROCESS.inputs), len(PROCESS.bands)
SCALE = np.array([one.scale for one in PROCESS.inputs])
BANDED = [PROCESS.outputs.index(one) for one in PROCESS.banded]
SAMPLED = MODEL.discretised(PROCESS.tick_s * PROCESS.ticks_per_sample)


def profiles(z: Array) -> tuple[Array, Array]:
    """Return inputs (SAMPLES, M) and slacks (SAMPLES, BANDS, 2) of decisions."""
    at_knots = z[: M * len(KNOTS)].reshape(-1, M) * SCALE, z[M * len(KNOTS) :].reshape(len(KNOTS), -1)
    times = np.arange(1, SAMPLES + 1)
    u, v = (np.array([np.interp(times, KNOTS, column) for column in each.T]).T for each in at_knots)
    return u, v.reshape(SAMPLES, BANDS, 2)


def outputs(u: Array, at: QpParameters) -> Array:
    """Return the deviations of all outputs from the operating point, shape (SAMPLES, p)."""
    x, y = at.x, []
    for inputs in u:
        x = SAMPLED.A @ x + SAMPLED.B @ inputs + SAMPLED.F * at.w
        y.append(MODEL.C @ x + MODEL.D @ inputs + MODEL.G * at.w)
    return np.array(y)


def residuals(z: Array, at: QpParameters) -> Array:
    """Return what is squared and summed: weighted inputs, slacks, outputs."""
    u, v = profiles(z)
    weigh = np.sqrt([one.weight for one in PROCESS.outputs])
    inputs, slacks = np.sqrt([one.weight for one in PROCESS.inputs]), np.sqrt([band.weight for band in PROCESS.bands])
    states = (outputs(u, at) - MODEL.G * at.w - u @ MODEL.D.T) * weigh  # C x, without what acts at once
    return np.concatenate([(u * inputs).ravel(), (v * slacks[:, None]).ravel(), states.ravel()])


def rows(z: Array, at: QpParameters) -> Array:
    """Return what must not be above 0."""
    u, v = profiles(z)
    y = (MODEL.y0 + outputs(u, at))[np.ix_(INSTANTS - 1, BANDED)]
    v = v[INSTANTS - 1]
    low, high = (np.array([getattr(band, end) for band in PROCESS.bands]) for end in ("low", "high"))
    margin = np.array([band.margin for band in PROCESS.bands])
    knots = np.vstack([at.u_before, z[: M * len(KNOTS)].reshape(-1, M) * SCALE])
    longest = np.diff(KNOTS, prepend=0)[:, None] * [one.rate for one in PROCESS.inputs]
    bounds = [(one.low, one.high) for one in PROCESS.inputs]
    u_low, u_high = np.array(bounds).T - MODEL.u0
    parts = [
        y - (high - margin) - v[:, :, 1], low + margin - y - v[:, :, 0],
        np.diff(knots, axis=0) - longest, -np.diff(knots, axis=0) - longest,
        knots[1:] - u_high, u_low - knots[1:], -z[M * len(KNOTS) :],
    ]  # fmt: skip
    return np.concatenate([part.ravel() for part in parts])


def direct_optimum(at: QpParameters) -> Array:
    """Return the decisions of least cost: residuals and rows are affine in them, columns follow from unit vectors."""
    unit = np.eye((M + 2 * BANDS) * len(KNOTS))
    nothing = np.zeros(len(unit))
    r0, g0 = residuals(nothing, at), rows(nothing, at)
    R = np.array([residuals(column, at) - r0 for column in unit]).T
    G = np.array([rows(column, at) - g0 for column in unit]).T
    return solved_by_daqp(2.0 * R.T @ R, 2.0 * R.T @ r0, G, np.full(len(g0), -np.inf), -g0)


def main() -> None:
    """Print the worst of all situations."""
    problem = PredictiveProblem(PredictionModel(MODEL), ControlDesign(), InputLimits())
    random = np.random.default_rng(2026)
    reach = np.abs(SAMPLED.B) @ SCALE
    cost_error = violation = 0.0
    for _ in range(SITUATIONS):
        inputs = [random.uniform(one.low, one.high) for one in PROCESS.inputs]
        span = PROCESS.load.span[1] - PROCESS.load.span[0]
        w = 0.1 * span * random.uniform(-1.0, 1.0) if PROCESS.has_load else 0.0
        at = QpParameters(3.0 * reach * random.normal(size=len(reach)), w, np.array(inputs) - MODEL.u0)
        qp = problem.at(at)
        low, high = np.append(qp.low, np.full(len(qp.gamma), -np.inf)), np.append(qp.high, qp.gamma)
        condensed = solved_by_daqp(2.0 * qp.Phi, qp.phi, qp.Gamma, low, high)
        direct = direct_optimum(at)
        ours, theirs = (float(np.sum(residuals(z, at) ** 2)) for z in (condensed, direct))
        cost_error = max(cost_error, abs(ours - theirs) / theirs)
        violation = max(violation, float(rows(condensed, at).max()))
    print(f"{cost_error} {violation}")  # noqa: T201 what the test reads


if __name__ == "__main__":
    main()
