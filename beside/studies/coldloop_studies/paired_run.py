"""Solvers on the same problems, those of a converged closed loop, and the lowest cost that can be played of each.

A solver that is cut off, or one with penalties, hands out profiles that break the rates of the inputs, and so seem to
cost less than is possible. The control PLC does not play them: each knot is moved to within the rate of the one before.
In the first ten seconds, all that is ever played of a sequence, that is what the optimiser sends; beyond, the profile
stays one of the problem's own, so that no profile that is judged can cost less than the optimum.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import daqp
import numpy as np
from numpy.typing import NDArray

from coldloop.errors import StudyError
from coldloop.process.lti_model import load as load_model
from coldloop.process.settings import InputLimits
from coldloop.safety.writers import InputSequence
from coldloop_optimizer_plc import computing_settings, rules, solvers
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.costs import indicators
from coldloop_optimizer_plc.qp.prediction import PredictionModel, prediction_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Indicators, Recorder
from coldloop_studies.settings import settings_of

Array = NDArray[np.float64]

MOST_STEPS: Final = 200
ROUNDING: Final = 1e-13
"""Share of the cost below which a step has won nothing."""
UNBOUNDED: Final = 1e30


class PlayedCost(NamedTuple):
    """Predicted costs of a profile as it is played."""

    j_dev: float
    j_cst: float

    @property
    def total(self) -> float:
        """Cost by which profiles are compared: J_dev + J_cst."""
        return self.j_dev + self.j_cst


class PlayedProfiles:
    """Judges profiles of one predictive problem, in double precision."""

    def __init__(self, problem: PredictiveProblem) -> None:
        design = problem.design
        n = self._n = problem.n_inputs
        self._problem = problem
        self._hessian = 2.0 * problem.Phi[:n, :n]
        self._rates = np.ascontiguousarray(problem.Gamma[design.n_slacks * len(design.constraint_instants) :, :n])
        self._outputs = np.ascontiguousarray(problem.predicted.of_z[:n].T)
        self._low, self._high, self._weights = (np.tile(row, design.horizon) for row in problem.predicted.bands)
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
            rows = outside != 0.0
            Y, weights = self._outputs[rows], 2.0 * self._weights[rows]
            edges = np.where(outside > 0, self._high, self._low)[rows]
            hessian = self._hessian + Y.T @ (weights[:, None] * Y)
            slope = qp.phi[: self._n] + Y.T @ (weights * (outputs[rows] - edges))
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
            if self._total(qp, outputs, p + share * (best - p)) <= at_p + 1e-4 * share * slope:  # Armijo
                return share
            share *= 0.5
        return 0.0


OF_THE_SOLVER: Final = (
    "optimizer_plc.program.solver=", "optimizer_plc.program.budget.", "optimizer_plc.program.preset=",
    "optimizer_plc.program.penalties.", *(f"optimizer_plc.program.{name.replace('-', '_')}." for name in SolverName),
)  # fmt: skip
"""Settings that differ between the requests that one sequence serves. The loop that it is recorded in solves exactly,
so that no penalty has an effect there."""
CONVERGED: Final = ("optimizer_plc.program.solver=daqp", "optimizer_plc.program.budget.preparation_slots=0")


class LoopProblem(NamedTuple):
    """A problem of the converged loop."""

    parameters: QpParameters
    z: Array
    """The profile that the loop delivered: the optimum of the quadratic problem."""


class ProblemSequence(NamedTuple):
    """Problems in their order."""

    prediction: PredictionModel
    limits: InputLimits
    problem: PredictiveProblem
    """Problem with the default penalties, by whose cost profiles are judged."""
    profiles: PlayedProfiles
    recorded: Sequence[LoopProblem]
    lowest: Array
    """The lowest cost of a profile that can be played, for each problem."""

    def solved_with(self, program: ProgramSettings) -> PredictiveProblem:
        """Return the same problems with the penalties of a program, for its solver."""
        return PredictiveProblem(self.prediction, program.design, self.limits, penalties=program.penalties)


class _ListeningOptimizer(OptimizerProgram):
    """Keeps parameters and profile of every problem."""

    def restart(self, updating_period_s: float, rule: rules.UpdatingRule | None = None) -> None:
        """Reset."""
        self.heard: list[LoopProblem] = []
        super().restart(updating_period_s, rule)

    def solve(self) -> InputSequence:
        """Solve, and keep what was solved."""
        sequence = super().solve()
        sent = self.state.sent
        w, ticks = float(sent.numbers[0]["w"]), int(sent.numbers[0]["ticks"])
        parameters = QpParameters(sent.x.copy(), w, sent.u_before.copy(), ticks, self.state.target.copy())
        self.heard.append(LoopProblem(parameters, sent.z.copy()))
        return sequence


def problem_sequence(scenario: Scenario, assignments: tuple[str, ...]) -> ProblemSequence:
    """Return the problems of a scenario, whichever solver is asked for; a worker keeps those of its last two."""
    return _recorded(scenario, tuple(one for one in assignments if not one.startswith(OF_THE_SOLVER)))


@lru_cache(maxsize=2)
def _recorded(scenario: Scenario, assignments: tuple[str, ...]) -> ProblemSequence:
    settings = settings_of((*assignments, *CONVERGED))
    program = settings.optimizer_plc.program
    model = load_model(settings.model.file)
    rig = OneProcessRig(settings, compiled=False)
    listening = rig.optimizer = _ListeningOptimizer(model, program, settings.limits)
    rig.run(scenario, Recorder(scenario.ticks, []))
    prediction = prediction_of(model, program.estimator.disturbed, program.design)
    problem = PredictiveProblem(prediction, program.design, settings.limits)
    profiles = PlayedProfiles(problem)
    lowest = []
    for parameters, _ in listening.heard:
        qp = problem.at(parameters)
        lowest.append(profiles.cost(qp, profiles.optimum(qp, parameters), parameters).total)
    return ProblemSequence(prediction, settings.limits, problem, profiles, listening.heard, np.array(lowest))


Columns = dict[str, list[float]]

INTERIOR_POINT_ITERATIONS: Final = (2, 4, 6, 8)
"""Counts of the interior-point solver whose PLC time every solver gets on a harsh problem."""
HARSH: Final = 10.0
"""A problem is harsh when its guess costs more than this times the lowest cost."""
FLOOR: Final = 1.0
"""Cost added to both, as the program adds it: in quiet a ratio of nearly nothing to nearly nothing says nothing."""
SETTLING: Final = {SolverName.QPOASES: 500, SolverName.OSQP: 400}
"""Iterations after each problem for solvers that keep something of it, so that harsh problems find them settled."""


def paired_run(sequence: ProblemSequence, program: ProgramSettings) -> Columns:
    """Let a solver go through all problems with its own hot starts; return costs as played, a row a problem."""
    solver, problem, penalised = solvers.make_solver(program), sequence.problem, sequence.solved_with(program)
    z = problem.hold(np.zeros(len(problem.design.input_scale)))
    columns: Columns = {name: [] for name in ("iterations", "j_dev", "j_cst", "violation", "lowest")}
    for (parameters, _), lowest in zip(sequence.recorded, sequence.lowest.tolist(), strict=True):
        qp, ticks = problem.at(parameters), parameters.elapsed_ticks
        iterations = computing_settings.PlcBudget(program.budget, solver.tau_1_s).iterations(ticks)
        answer = solver.solve(penalised.at(parameters), problem.shifted(z, ticks), (iterations,))
        z = penalised.within_first_rate(answer.z, parameters)
        cost = sequence.profiles.cost(qp, z, parameters)
        violation = float(indicators(problem, qp, z, parameters).violation)
        for name, value in zip(columns, (answer.iterations[-1], *cost, violation, lowest), strict=True):
            columns[name].append(float(value))
    return columns


def harsh_run(sequence: ProblemSequence, program: ProgramSettings) -> Columns:
    """Let a solver begin each harsh problem at the same guess; return its costs after equal PLC times.

    The guess is the shifted profile that the converged loop played; `count_2` ... say how many iterations the time of
    2, 4, 6 and 8 of the interior-point solver holds, `after_2` ... what the profile then costs.
    """
    solver, problem, penalised = solvers.make_solver(program), sequence.problem, sequence.solved_with(program)
    counts = equal_counts(program, solver)
    names = ("lowest", "guess", *(f"{what}_{k}" for k in counts for what in ("count", "after")))
    columns: Columns = {name: [] for name in names}
    before = problem.hold(np.zeros(len(problem.design.input_scale)))
    for (parameters, z), lowest in zip(sequence.recorded, sequence.lowest.tolist(), strict=True):
        qp = problem.at(parameters)
        guess = problem.shifted(before, parameters.elapsed_ticks)
        at_guess = sequence.profiles.cost(qp, guess, parameters).total
        before, settling = z, SETTLING.get(program.solver, 0)
        harsh = at_guess + FLOOR > HARSH * (lowest + FLOOR)
        if not harsh and not settling:
            continue
        looked_at = tuple(counts.values()) if harsh else ()
        last = looked_at[-1] if harsh else 0
        answer = solver.solve(penalised.at(parameters), guess, (*looked_at, last + settling))
        if harsh:
            row = [lowest, at_guess]
            for count, point in zip(looked_at, answer.points, strict=False):
                row += [count, sequence.profiles.cost(qp, point, parameters).total]
            for name, value in zip(columns, row, strict=True):
                columns[name].append(float(value))
    return columns


def equal_counts(program: ProgramSettings, solver: solvers.Solver) -> dict[int, int]:
    """Return the iterations of a solver that take as long as 2, 4, 6 and 8 of the interior-point solver."""
    iteration_s = program.interior_point.tau_1_s
    return {k: math.floor(k * iteration_s / solver.tau_1_s + 1e-9) for k in INTERIOR_POINT_ITERATIONS}


def paired_indicators(columns: Columns, period_s: float) -> Indicators:
    """Return the indicators that problems without a loop have; the others are not numbers."""
    none: dict[str, Any] = {**dict.fromkeys(Indicators._fields, math.nan), "outside_band_pct": {}}
    if not columns.get("j_dev"):
        return Indicators(**none)
    j_dev, j_cst, violation = (np.array(columns[name]) for name in ("j_dev", "j_cst", "violation"))
    return Indicators(**none | {
        "J_dev": float(j_dev.sum()), "J_cst": float(j_cst.sum()), "J_open_mean": float((j_dev + j_cst).mean()),
        "c1": float(violation.max()), "c2": float(violation.mean()), "tau_u_mean": period_s,
        "tau_u_mean_per_update": period_s, "iterations_total": round(sum(columns["iterations"])),
    })  # fmt: skip
