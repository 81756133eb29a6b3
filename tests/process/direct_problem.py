"""Compares the condensed problem of a process with a direct build of it.

The direct one knows the paper's equations, the process and its linear model only: profiles are interpolated, states
simulated sample by sample, and what is summed is written out.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coldloop.process.lti_model import load
from coldloop.process.settings import InputLimits, settings_of
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.settings import ControlDesign
from tests.harness.reference_qp import solved_by_daqp

Array = NDArray[np.float64]

SITUATIONS = 20


class DirectProblem:
    """The problem of a process, written out; z and situations are those of `PredictiveProblem`."""

    def __init__(self, file: Path) -> None:
        self.model = load(file)
        self.process = process = self.model.declared
        self.knots, self.instants = np.array(process.decision_instants), np.array(process.constraint_instants)
        self.samples = int(self.knots[-1])
        self.inputs, self.bands = len(process.inputs), len(process.bands)
        self.scale = np.array([one.scale for one in process.inputs])
        self.banded = list(process.controlled)
        self.sampled = self.model.discretised(process.sampling_period_s)

    def profiles(self, z: Array) -> tuple[Array, Array]:
        """Return inputs (samples, inputs) and slacks (samples, bands, 2) of decisions."""
        at_knots = (
            z[: self.inputs * len(self.knots)].reshape(-1, self.inputs) * self.scale,
            z[self.inputs * len(self.knots) :].reshape(len(self.knots), -1),
        )
        times = np.arange(1, self.samples + 1)
        u, v = (np.array([np.interp(times, self.knots, column) for column in each.T]).T for each in at_knots)
        return u, v.reshape(self.samples, self.bands, 2)

    def outputs(self, u: Array, at: QpParameters) -> Array:
        """Return the deviations of all outputs from the operating point, shape (samples, p)."""
        x, y = at.x, []
        for inputs in u:
            x = self.sampled.A @ x + self.sampled.B @ inputs + self.sampled.F * at.w
            y.append(self.model.C @ x + self.model.D @ inputs + self.model.G * at.w)
        return np.array(y)

    def residuals(self, z: Array, at: QpParameters) -> Array:
        """Return what is squared and summed: weighted inputs, slacks, outputs."""
        u, v = self.profiles(z)
        weigh = np.sqrt([one.weight for one in self.process.outputs])
        inputs, slacks = (
            np.sqrt([one.weight for one in self.process.inputs]),
            np.sqrt([band.weight for band in self.process.bands]),
        )
        states = (
            self.outputs(u, at) - self.model.G * at.w - u @ self.model.D.T
        ) * weigh  # C x, without what acts at once
        return np.concatenate([(u * inputs).ravel(), (v * slacks[:, None]).ravel(), states.ravel()])

    def rows(self, z: Array, at: QpParameters) -> Array:
        """Return what must not be above 0."""
        u, v = self.profiles(z)
        y = (self.model.y0 + self.outputs(u, at))[np.ix_(self.instants - 1, self.banded)]
        v = v[self.instants - 1]
        low, high = (np.array([getattr(band, end) for band in self.process.bands]) for end in ("low", "high"))
        margin = np.array([band.margin for band in self.process.bands])
        knots = np.vstack([at.u_before, z[: self.inputs * len(self.knots)].reshape(-1, self.inputs) * self.scale])
        longest = np.diff(self.knots, prepend=0)[:, None] * [one.rate for one in self.process.inputs]
        bounds = [(one.low, one.high) for one in self.process.inputs]
        u_low, u_high = np.array(bounds).T - self.model.u0
        parts = [
            y - (high - margin) - v[:, :, 1], low + margin - y - v[:, :, 0],
            np.diff(knots, axis=0) - longest, -np.diff(knots, axis=0) - longest,
            knots[1:] - u_high, u_low - knots[1:], -z[self.inputs * len(self.knots) :],
        ]  # fmt: skip
        return np.concatenate([part.ravel() for part in parts])

    def direct_optimum(self, at: QpParameters) -> Array:
        """Return the decisions of least cost: residuals and rows are affine in them."""
        unit = np.eye((self.inputs + 2 * self.bands) * len(self.knots))
        nothing = np.zeros(len(unit))
        r0, g0 = self.residuals(nothing, at), self.rows(nothing, at)
        R = np.array([self.residuals(column, at) - r0 for column in unit]).T
        G = np.array([self.rows(column, at) - g0 for column in unit]).T
        return solved_by_daqp(2.0 * R.T @ R, 2.0 * R.T @ r0, G, np.full(len(g0), -np.inf), -g0)


def worst(file: Path) -> tuple[float, float]:
    """Return, of random situations, by how much costs of both optima differ, and constraints are left."""
    direct = DirectProblem(file)
    process, model = direct.process, direct.model
    with settings_of(process):
        problem = PredictiveProblem(PredictionModel(model), ControlDesign(), InputLimits())
    random = np.random.default_rng(2026)
    reach = np.abs(direct.sampled.B) @ direct.scale
    cost_error = violation = 0.0
    for _ in range(SITUATIONS):
        inputs = [random.uniform(one.low, one.high) for one in process.inputs]
        span = process.load.span[1] - process.load.span[0]
        w = 0.1 * span * random.uniform(-1.0, 1.0) if process.has_load else 0.0
        at = QpParameters(3.0 * reach * random.normal(size=len(reach)), w, np.array(inputs) - model.u0)
        qp = problem.at(at)
        low, high = np.append(qp.low, np.full(len(qp.gamma), -np.inf)), np.append(qp.high, qp.gamma)
        condensed = solved_by_daqp(2.0 * qp.Phi, qp.phi, qp.Gamma, low, high)
        ours, theirs = (float(np.sum(direct.residuals(z, at) ** 2)) for z in (condensed, direct.direct_optimum(at)))
        cost_error = max(cost_error, abs(ours - theirs) / theirs)
        violation = max(violation, float(direct.rows(condensed, at).max()))
    return cost_error, violation
