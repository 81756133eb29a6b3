"""Runs against time, and what happens after load steps: the paper's figures of time courses, and its section II.

Figures `working_mpc`, `not_working_mpc`, `mult_solv`, `scenario_exp`, `diff_upt`, `compareSf`. A mean of the updating
period over updates counts short periods too often: in the same time there are ten of 0.5 s for one of 5 s. Here every
tick has the period that is in force then, and counts once.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop.process.cold_box import COLD_BOX, SAMPLING_PERIOD_S, TICK_S
from coldloop_rig.figures.plot import COLOURS, DASHES, legend_above
from coldloop_rig.text_tables import markdown_table
from coldloop_studies import study
from coldloop_studies.drawing import legend_outside, panels, spread, time_panels
from coldloop_studies.request import Outcome, RunRequest, Series
from coldloop_studies.solver_comparison import UNLIMITED, throttled
from coldloop_studies.study import PROGRAM, Load, Outcomes, StudyOptions, StudyResult, loads

TRACE_TICKS = 4
BANDS = tuple((band.low, band.high) for band in COLD_BOX.bands)


def _course(name: str, title: str, *cases: tuple[str, str, float]) -> study.Study:
    """Return a study of solvers under the same load, drawn over each other; a case has label, solver and power."""

    def evaluate(found: study.Found[str]) -> StudyResult:
        result = StudyResult(
            ("load", "case", "J_BF", "L1 outside (%)", "T5 outside (%)", "furthest outside", "iterations after a step",
             "iterations in quiet"), [], {},
        )  # fmt: skip
        for load, runs in found:
            if not result.figures:
                result.figures["time courses"] = time_panels(list(runs.items()), BANDS)
            costs = []
            for label, run in runs.items():
                i, far = run.indicators, furthest_outside(run)
                after, quiet = iterations_by_event(run, load)
                result.rows.append((load.name, label, i.J_BF, *i.outside_band_pct.values(), far, after, quiet))
                costs.append(i.J_BF)
            if len(runs) == 1:
                result.note(f"{name}: furthest outside", far)
                result.note(f"{name}: time outside", max(i.outside_band_pct.values()))
                result.note(f"{name}: iterations", after / quiet if quiet else np.nan)
            else:
                result.note(f"{name}: J_BF", costs[0] / costs[-1])
            if len(runs) > 2:
                result.note(f"{name}: J_BF of qpOASES over ODE", costs[1] / costs[0])
        return result

    return study.study_of_loads(
        name, title, lambda options: loads(options, "d"),
        lambda load: {label: throttled(load, solver, power, TRACE_TICKS) for label, solver, power in cases}, evaluate,
    )  # fmt: skip


def furthest_outside(run: Outcome) -> float:
    """Return the largest violation of a band, in % of level or K."""
    return max(
        float(np.max(np.maximum(low - run.series(name), run.series(name) - high), initial=0.0))
        for name, (low, high) in zip(("L1", "T5"), BANDS, strict=True)
    )


def iterations_by_event(run: Outcome, load: Load) -> tuple[float, float]:
    """Return the mean number of iterations just after load steps, for 30 s, and in quiet, from 120 s on."""
    since = _seconds_since_step(run, load)
    iterations = run.column("iterations")
    return _mean(iterations[since < 30.0]), _mean(iterations[since >= 120.0])


def _mean(some: NDArray[Any]) -> float:
    return float(some.mean()) if len(some) else np.nan


def load_steps(load: Load) -> Series:
    """Return the ticks at which the load changes, after one before all time."""
    changes = [
        tick
        for tick, before, watts in zip(load.profile.times[1:], load.profile.watts, load.profile.watts[1:], strict=False)
        if watts != before
    ]
    return np.array([-np.inf, *changes])


def _steps_before(ticks: Series, load: Load) -> "NDArray[np.intp]":
    return np.searchsorted(load_steps(load), ticks, side="right") - 1


def _seconds_since_step(run: Outcome, load: Load) -> Series:
    """Return for each update the plant time since the last load step, which begins at the first one."""
    ticks = run.column("tick")
    since: Series = (ticks - load_steps(load)[_steps_before(ticks, load)]) * TICK_S
    return since


_UNLIMITED_QPOASES = ("qpOASES, unlimited", "qpoases", UNLIMITED)
_THROTTLED_QPOASES = ("qpOASES, 10 iterations", "qpoases", 1.0)
COURSES: Final = (
    _course("unlimited", "The scheme with qpOASES and no limit of iterations (figure working_mpc)", _UNLIMITED_QPOASES),
    _course("limited", "qpOASES limited to 10 iterations (figure not_working_mpc)", _THROTTLED_QPOASES,
            _UNLIMITED_QPOASES),
    _course("trajectories", "The ODE-based solver, limited qpOASES and unlimited qpOASES (figure mult_solv)",
            ("ODE, 20 iterations", "ode", 1.0), _THROTTLED_QPOASES, _UNLIMITED_QPOASES),
)  # fmt: skip
"""Studies of runs against time."""


SOON_S: Final = (0.0, 30.0)
"""The window after a load step by which the response is judged."""
QUIET_SPAN_S: Final = (60.0, np.inf)
EDGES_S: Final = np.array([0.0, 2.5, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, np.inf])
Run = tuple[Outcome, Load]


class HeldPeriods(NamedTuple):
    """Ticks that have an updating period and a load step before them, of several runs."""

    since_s: Series
    """Time since the last load step."""
    tau_u_s: Series
    """The period in force."""

    def _within(self, span: tuple[float, float]) -> Series:
        return self.tau_u_s[(span[0] <= self.since_s) & (self.since_s < span[1])]

    def mean(self, span: tuple[float, float]) -> float:
        """Return the mean period (s) in a window of time since the step; NaN if no tick is in it."""
        return _mean(self._within(span))

    def share_of_longest(self, span: tuple[float, float]) -> float:
        """Return the share of a window's time that has the longest period; NaN if no tick is in it."""
        return _mean(self._within(span) == SAMPLING_PERIOD_S)


def held_periods(runs: Sequence[Run]) -> HeldPeriods:
    """Return the periods of runs, tick by tick; a period is held until the next update whose sequence is played."""
    since, held = [np.empty(0)], [np.empty(0)]
    for run, load in runs:
        start, tau = run.column("tick"), run.column("tau_u")
        if not len(start):
            continue
        ticks = np.arange(start[0], start[-1] + tau[-1])
        after = ticks - load_steps(load)[_steps_before(ticks, load)]
        known = np.isfinite(after)
        since.append(after[known] * TICK_S)
        held.append(tau[np.searchsorted(start, ticks, side="right") - 1][known] * TICK_S)
    return HeldPeriods(np.concatenate(since), np.concatenate(held))


def response(runs: Sequence[Run], policy: str) -> dict[str, float]:
    """Return what is claimed of the response of a policy, and the quantities that explain it."""
    held = held_periods(runs)
    # K = J_{k+1} / J_k of all updates but the first of each run, and the time since the load step (s)
    effective = [run.column("j_effective") for run, _ in runs]
    K = np.concatenate([np.empty(0), *(cost[1:] / cost[:-1] for cost in effective)])
    since = np.concatenate([np.empty(0), *(_seconds_since_step(run, load)[1:] for run, load in runs)])
    quiet = held.mean(QUIET_SPAN_S)
    return {
        f"tau_u 0 to 30 s after a load step over that in quiet, by time, {policy}": held.mean(SOON_S) / quiet,
        f"tau_u in quiet (s), by time, {policy}": quiet,
        f"tau_u 0 to 30 s after a load step (s), by time, {policy}": held.mean(SOON_S),
        f"share of the quiet time at the longest period, {policy}": held.share_of_longest(QUIET_SPAN_S),
        f"median of |K - 1| in quiet, {policy}": _median_distance(K[since >= QUIET_SPAN_S[0]]),
        f"median of |K - 1| 0 to 30 s after a load step, {policy}": _median_distance(K[since < SOON_S[1]]),
    }


def _median_distance(K: Series) -> float:
    return float(np.median(np.abs(K - 1.0))) if len(K) else np.nan


def response_table(runs_of: Mapping[str, Sequence[Run]]) -> str:
    """Return the mean period of each policy in each window, as Markdown."""
    spans = list(pairwise(EDGES_S.tolist()))
    names = [f"{low:g}-{high:g} s" if np.isfinite(high) else f"from {low:g} s on" for low, high in spans]
    caption = "**Mean updating period (s) against the time since the load step**, weighted by time, all hours together."
    rows = []
    for policy, runs in runs_of.items():
        means = [held_periods(runs).mean(span) for span in spans]
        rows.append((policy, *("" if np.isnan(mean) else f"{mean:.2f}" for mean in means)))
    return markdown_table(("policy", *names), rows, caption)


def response_figure(runs_of: Mapping[str, Sequence[Run]]) -> Figure:
    """Draw the mean period of each policy in each window."""
    edges = np.where(np.isfinite(EDGES_S), EDGES_S, 400.0)  # the last window has no end
    with panels(1, 1, 2.8) as (figure, (place,)):
        for (policy, runs), colour in zip(runs_of.items(), COLOURS, strict=False):
            means = [held_periods(runs).mean(span) for span in pairwise(EDGES_S.tolist())]
            place.stairs(means, edges, color=colour, linestyle=DASHES[colour], baseline=None, label=policy)
        place.set_xlabel(f"time since the load step (s); the last is from {EDGES_S[-2]:g} s on")
        place.set(ylabel="mean updating period (s), by time", ylim=(0, None))
        legend_outside(figure, place)
    return figure


RIGS: Final = {"networked": True, "one process": False}


def _experiment(name: str, title: str, periods_s: Mapping[str, float]) -> study.Study:
    """Return a study of runs on the bus, three services and Modbus/TCP, each repeated in one process.

    `periods_s` has the updating period (s) of each case; 0 is adaptive.
    """

    def runs(load: Load) -> dict[tuple[str, str], RunRequest]:
        return {
            (case, rig): load.request(period_s, networked=networked, trace_ticks=TRACE_TICKS)
            for case, period_s in periods_s.items()
            for rig, networked in RIGS.items()
        }

    def evaluate(found: study.Found[tuple[str, str]]) -> StudyResult:
        result = StudyResult(
            ("load", "case", "rig", "J_BF", "L1 outside (%)", "T5 outside (%)", "tau_u mean (s)",
             "tau_u mean per update (s)", "trace"), [], {},
        )  # fmt: skip
        for load, done in found:
            for (case, rig), run in done.items():
                i = run.indicators
                result.rows.append(
                    (
                        load.name,
                        case,
                        rig,
                        i.J_BF,
                        *i.outside_band_pct.values(),
                        i.tau_u_mean,
                        i.tau_u_mean_per_update,
                        run.trace_sha256,
                    )
                )
            for case, period_s in periods_s.items():
                networked, alone = (done[case, rig] for rig in RIGS)
                result.note(f"{name}: same trace, {case}", networked.trace_sha256 == alone.trace_sha256)
                outside = max(networked.indicators.outside_band_pct.values())
                result.note(f"{name}: time outside the bands, {case}", outside)
                if not period_s:
                    responses = response([(networked, load)], case)
                    result.note_all({f"{name}: {what}": value for what, value in responses.items()})
            if not result.figures:
                result.figures["time courses"] = time_panels(
                    [(case, done[case, "networked"]) for case in periods_s], BANDS
                )
        return result

    def drawn(options: StudyOptions) -> list[Load]:
        return [load for load in loads(options, "2h") if load.draw == 1]

    return study.study_of_loads(name, title, drawn, runs, evaluate)


BUS: Final = (
    _experiment("plc-2h", "Two hours on the bus at tau_u = 5 s (figure scenario_exp)", {"5 s": 5.0}),
    _experiment("adaptive-2h", "Two hours on the bus, 2.5 s against adaptive (figure diff_upt)",
                {"2.5 s": 2.5, "adaptive": 0.0}),
)  # fmt: skip
"""Studies of runs on the bus."""
SOLVERS: Final = {"ode": "ODE", "qpoases": "qpOASES", "fast-gradient": "fast gradient", "osqp": "OSQP"}


COLUMNS: Final = ("load", "solver", "tau_u (s)", "E", "D", "share of load steps with E > D")


def _trade_off(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
    periods = _periods(options)
    result = StudyResult(COLUMNS, [], {})
    curves: dict[str, list[list[tuple[float, float]]]] = {solver: [] for solver in SOLVERS}
    for load in loads(options, "c"):
        for solver, label in SOLVERS.items():
            runs = [outcomes[_request(load, solver, period)] for period in periods]
            points = [won_and_lost(run, load) for run in runs]
            curves[solver].append(points)
            result.rows += [
                (load.name, label, period, *point, share_falling(run, load))
                for period, point, run in zip(periods, points, runs, strict=True)
            ]
        for what, value in _discriminating(load, periods, outcomes).items():
            result.note(what, value)
    result.figures["efficiency and degradation"] = _trade_off_figure(periods, curves)
    return result


TRADE_OFF: Final = study.Study(
    "trade-off",
    "What a period wins and loses (figures compareSf and twocases)",
    lambda options: [
        _request(load, solver, period)
        for load in loads(options, "c")
        for solver in SOLVERS
        for period in _periods(options)
    ],
    _trade_off,
)
"""E for each solver and D, against tau_u, in the first period after load steps."""


def _periods(options: StudyOptions) -> tuple[float, ...]:
    return (1.0, 2.5, 5.0) if options.quick else (1.0, 2.0, 3.0, 4.0, 5.0)


def _request(load: Load, solver: str, period_s: float) -> RunRequest:
    return load.request(period_s, f"{PROGRAM}solver={solver}")


def _after_steps(run: Outcome, load: Load) -> tuple[Series, Series]:
    played, hot_start, delivered = (run.column(name) for name in ("j_effective", "j_hot_start", "j_delivered"))
    event = np.diff(_steps_before(run.column("tick"), load), prepend=0) > 0  # the first one after a load step
    return (hot_start - delivered)[event], (hot_start - played)[event]


def won_and_lost(run: Outcome, load: Load) -> tuple[float, float]:
    """Return the mean of E_k and of D_k over the first updates after load steps."""
    won, lost = _after_steps(run, load)
    return _mean(won), _mean(lost)


def share_falling(run: Outcome, load: Load) -> float:
    """Return after which share of the load steps E_k > D_k: the cost falls in the first period."""
    won, lost = _after_steps(run, load)
    return _mean(won > lost)


def _discriminating(load: Load, periods: tuple[float, ...], outcomes: Outcomes) -> dict[str, float]:
    """Return how solvers and periods differ in the share of load steps after which the cost falls at once."""
    share = {
        (solver, period): share_falling(outcomes[_request(load, solver, period)], load)
        for solver in ("ode", "qpoases")
        for period in (periods[0], periods[-1])
    }
    short, long = f"{periods[0]:g} s", f"{periods[-1]:g} s"
    return {
        f"share of load steps after which E > D at {short}: ODE less qpOASES": share["ode", periods[0]]
        - share["qpoases", periods[0]],
        f"share of load steps after which E > D at {long} less that at {short}: qpOASES": share["qpoases", periods[-1]]
        - share["qpoases", periods[0]],
    }


def _trade_off_figure(periods: tuple[float, ...], curves: dict[str, list[list[tuple[float, float]]]]) -> Figure:
    with panels(2, 2, 5.0, sharex=True) as (figure, axes):
        for place, (solver, draws), colour in zip(axes, curves.items(), COLOURS, strict=False):
            values = np.array(draws)
            spread(place, periods, values[:, :, 0], colour, "$E$: won by the solver")
            spread(place, periods, values[:, :, 1], "#888888", "$D$: lost by shift and mismatch")
            place.set_title(SOLVERS[solver], loc="left", pad=18)
            place.set_ylabel("cost a period (1)")
            place.yaxis.set_major_formatter(lambda value, _: f"{value:g}")  # the power of ten at each mark
            legend_above(place)
        for place in axes[-2:]:
            place.set_xlabel("updating period (s)")
    return figure
