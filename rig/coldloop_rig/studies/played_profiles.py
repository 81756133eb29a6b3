"""Profiles as the control PLC plays them: what they cost, and the lowest cost that any of them has.

A solver that is cut off, or one with penalties, hands out profiles that break the rates of the inputs, and so seem to
cost less than is possible. The control PLC does not play them: `played` moves each knot to within the rate of the knot
before it. In the first ten seconds, all that is ever played of a sequence, that is what the optimiser sends; beyond,
the profile stays one of the problem's own, so that no profile that is judged can cost less than `optimum`.
"""

from typing import Final, NamedTuple

import daqp
import numpy as np
from numpy.typing import NDArray

from coldloop.errors import StudyError
from coldloop_optimizer_plc.qp.costs import indicators
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem

Array = NDArray[np.float64]

MOST_STEPS: Final = 200
ROUNDING: Final = 1e-13
"""Share of the cost below which a step has won nothing."""
SUFFICIENT: Final = 1e-4
"""Share of the decrease that the slope promises, with which a step is taken (Armijo)."""
UNBOUNDED: Final = 1e30


class PlayedCost(NamedTuple):
    """Predicted costs of a profile as it is played."""

    j_dev: float
    j_cst: float

    @property
    def total(self) -> float:
        """What profiles are compared by."""
        return self.j_dev + self.j_cst


class PlayedProfiles:
    """Judges profiles of one predictive problem, in double precision."""

    def __init__(self, problem: PredictiveProblem) -> None:
        design = problem.design
        n = self._n = problem.n_inputs
        self._problem = problem
        self._hessian = 2.0 * problem.Phi[:n, :n]
        self._rates = np.ascontiguousarray(problem.Gamma[design.n_slacks * len(design.constraint_instants) :, :n])
        self._outputs = np.ascontiguousarray(problem.stacked_outputs_z[:n].T)
        self._low, self._high, self._weights = (np.tile(row, design.horizon) for row in problem.bands)
        rate = np.asarray(problem.limits.rate) / np.asarray(design.input_scale)
        self._reach = np.outer(np.diff(design.decision_instants), rate)

    def played(self, qp: QuadraticProblem, z: Array) -> Array:
        """Return a profile z (n,) within the rates, without slacks."""
        knots = z[: self._n].reshape(-1, self._problem.design.n_inputs).copy()
        knots[0] = np.clip(knots[0], qp.low[: knots.shape[1]], qp.high[: knots.shape[1]])
        for knot, reach in enumerate(self._reach, start=1):
            knots[knot] = np.clip(knots[knot], knots[knot - 1] - reach, knots[knot - 1] + reach)
        return self._with_slacks(knots.ravel())

    def cost(self, qp: QuadraticProblem, z: Array, parameters: QpParameters) -> PlayedCost:
        """Return what a profile costs as it is played; violations are those of the predicted outputs."""
        found = indicators(self._problem, qp, self.played(qp, z), parameters)
        return PlayedCost(float(found.j_dev), float(found.j_cst))

    def optimum(self, qp: QuadraticProblem, parameters: QpParameters) -> Array:
        """Return the profile of lowest cost among those that can be played.

        The cost is quadratic wherever the same outputs are outside their bands: Newton's method on these pieces, each
        solved exactly under bounds and rates by DAQP, ends when a piece has its own optimum in it.

        Raises:
            StudyError: It does not end.
        """
        outputs = self._problem.outputs(np.zeros(self._problem.size), parameters).ravel()
        p = np.clip(self._problem.hold(parameters.u_before), qp.low, qp.high)[: self._n]
        for _ in range(MOST_STEPS):
            outside = self._outside(outputs + self._outputs @ p)
            hessian, slope = self._piece(qp, outputs, outside)
            best = self._solved(qp, hessian, slope)
            if (self._outside(outputs + self._outputs @ best) == outside).all():
                return self._with_slacks(best)
            step = self._step(qp, outputs, p, best, float((hessian @ p + slope) @ (best - p)))
            if step == 0.0:
                return self._with_slacks(p)
            p = p + step * (best - p)
        raise StudyError("the lowest cost of a problem was not found; its data are of another scale than a cold box's")

    def _with_slacks(self, p: Array) -> Array:
        return np.concatenate([p, np.zeros(self._problem.size - self._n)])

    def _outside(self, y: Array) -> Array:
        """Return 1 for outputs above their band, -1 below, 0 inside."""
        return np.where(y > self._high, 1.0, np.where(y < self._low, -1.0, 0.0))

    def _piece(self, qp: QuadraticProblem, outputs: Array, outside: Array) -> tuple[Array, Array]:
        """Return Hessian and linear term of the cost where these outputs are outside."""
        rows = outside != 0.0
        Y, weights = self._outputs[rows], 2.0 * self._weights[rows]
        edges = np.where(outside > 0, self._high, self._low)[rows]
        return self._hessian + Y.T @ (weights[:, None] * Y), qp.phi[: self._n] + Y.T @ (
            weights * (outputs[rows] - edges)
        )

    def _solved(self, qp: QuadraticProblem, hessian: Array, slope: Array) -> Array:
        high = np.concatenate([qp.high[: self._n], qp.gamma[-len(self._rates) :]])
        low = np.concatenate([qp.low[: self._n], np.full(len(self._rates), -UNBOUNDED)])
        sense = np.zeros(len(high), np.int32)
        p, _, flag, _ = daqp.solve(
            np.ascontiguousarray(hessian), slope, self._rates, high, low, sense, primal_tol=1e-11
        )
        if flag != 1:
            raise StudyError(f"a problem has no profile that can be played (DAQP: {flag})")
        return np.array(p)

    def _total(self, qp: QuadraticProblem, outputs: Array, p: Array) -> float:
        y = outputs + self._outputs @ p
        miss = np.maximum(y - self._high, 0.0) + np.maximum(self._low - y, 0.0)
        return float(0.5 * p @ self._hessian @ p + qp.phi[: self._n] @ p + self._weights @ miss**2)

    def _step(self, qp: QuadraticProblem, outputs: Array, p: Array, best: Array, slope: float) -> float:
        """Return the share of the way to `best` that lowers the cost enough; 0 if there is nothing to be won."""
        at_p, share = self._total(qp, outputs, p), 1.0
        while slope * share < -ROUNDING * abs(at_p):
            if self._total(qp, outputs, p + share * (best - p)) <= at_p + SUFFICIENT * share * slope:
                return share
            share *= 0.5
        return 0.0
