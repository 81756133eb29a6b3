"""Time courses under throttled solvers: the paper's figures `working_mpc`, `not_working_mpc` and `mult_solv`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop_rig.studies.drawing import time_panels
from coldloop_rig.studies.request import Outcome, RunRequest, Series
from coldloop_rig.studies.solver_runs import UNLIMITED, throttled
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads

TRACE_TICKS = 4
AFTER_STEP_S = 30.0
"""A problem that follows a load step by less than this belongs to the load event."""
QUIET_S = 120.0
"""Without a load step for this long it is quiet."""
BANDS = tuple((band.low, band.high) for band in COLD_BOX.bands)

UNLIMITED_QPOASES = ("qpOASES, unlimited", "qpoases", UNLIMITED)
THROTTLED_QPOASES = ("qpOASES, 10 iterations", "qpoases", 1.0)
THROTTLED_ODE = ("ODE, 20 iterations", "ode", 1.0)


@dataclass(frozen=True)
class TrajectoryStudy:
    """Runs of several solvers under the same load, drawn over each other."""

    name: str
    title: str
    cases: tuple[tuple[str, str, float], ...]
    """Label, solver, power."""

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return a run of every case under every draw."""
        return [request for load in loads(options, "d") for request in self._runs(load)]

    def _runs(self, load: Load) -> list[RunRequest]:
        return [throttled(load, solver, power, TRACE_TICKS) for _, solver, power in self.cases]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare closed-loop costs, bands and iterations."""
        result = StudyResult(
            ("load", "case", "J_BF", "L1 outside (%)", "T5 outside (%)", "furthest outside", "iterations after a step",
             "iterations in quiet"), [], {},
        )  # fmt: skip
        for load in loads(options, "d"):
            runs = [outcomes[request] for request in self._runs(load)]
            labelled = [(label, run) for (label, _, _), run in zip(self.cases, runs, strict=True)]
            if not result.figures:
                result.figures["time courses"] = time_panels(labelled, BANDS)
            for label, run in labelled:
                after, quiet = iterations_by_event(run, load)
                result.rows.append(
                    (load.name, label, run.indicators.J_BF, *run.indicators.outside_band_pct.values(),
                     furthest_outside(run), after, quiet)
                )  # fmt: skip
            self._judge(result, load, runs)
        return result

    def _judge(self, result: StudyResult, load: Load, runs: Sequence[Outcome]) -> None:
        reference = runs[-1]
        outside = tuple(reference.indicators.outside_band_pct.values())
        after, quiet = iterations_by_event(reference, load)
        values: dict[str, float] = {}
        if len(runs) == 1:
            values["furthest outside"] = furthest_outside(reference)
            values["time outside"] = max(outside)
            values["iterations"] = after / quiet if quiet else float("nan")
        if len(runs) > 1:
            values["J_BF"] = runs[0].indicators.J_BF / reference.indicators.J_BF
        if len(runs) > 2:
            values["J_BF of qpOASES over ODE"] = runs[1].indicators.J_BF / runs[0].indicators.J_BF
        for what, value in values.items():
            result.note(f"{self.name}: {what}", value)


def furthest_outside(run: Outcome) -> float:
    """Return the largest violation of a band, in % of level or K."""
    outside = [
        float(np.max(np.maximum(low - run.series(name), run.series(name) - high), initial=0.0))
        for name, (low, high) in zip(("L1", "T5"), BANDS, strict=True)
    ]
    return max(outside)


def iterations_by_event(run: Outcome, load: Load) -> tuple[float, float]:
    """Return the mean number of iterations just after load steps, and in quiet."""
    since = seconds_since_step(run, load)
    iterations = run.column("iterations")
    after, quiet = iterations[since < AFTER_STEP_S], iterations[since >= QUIET_S]
    return (float(after.mean()) if len(after) else np.nan, float(quiet.mean()) if len(quiet) else np.nan)


def load_steps(load: Load) -> Series:
    """Return the ticks at which the load changes, after one before all time."""
    changes = [
        tick
        for tick, before, watts in zip(load.profile.times[1:], load.profile.watts, load.profile.watts[1:], strict=False)
        if watts != before
    ]
    return np.array([-np.inf, *changes])


def follows_step(run: Outcome, load: Load) -> "NDArray[np.bool_]":
    """Return for each update whether it is the first one after a load step."""
    seen = _steps_before(run.column("tick"), load)
    return np.diff(seen, prepend=0) > 0


def _steps_before(ticks: Series, load: Load) -> "NDArray[np.intp]":
    return np.searchsorted(load_steps(load), ticks, side="right") - 1


def seconds_since_step(run: Outcome, load: Load) -> Series:
    """Return for each update the plant time since the last load step, which begins at the first one."""
    ticks = run.column("tick")
    last = load_steps(load)[_steps_before(ticks, load)]
    since: Series = (ticks - last) * TICK_S
    return since


UNLIMITED_STUDY = TrajectoryStudy(
    "unlimited", "The scheme with qpOASES and no limit of iterations (figure working_mpc)", (UNLIMITED_QPOASES,)
)
LIMITED_STUDY = TrajectoryStudy(
    "limited", "qpOASES limited to 10 iterations (figure not_working_mpc)", (THROTTLED_QPOASES, UNLIMITED_QPOASES)
)
TRAJECTORIES_STUDY = TrajectoryStudy(
    "trajectories",
    "The ODE-based solver, limited qpOASES and unlimited qpOASES (figure mult_solv)",
    (THROTTLED_ODE, THROTTLED_QPOASES, UNLIMITED_QPOASES),
)
