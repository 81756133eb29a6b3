"""Efficiency E and degradation D against the updating period, measured (paper, section II, figure `compareSf`).

With J+ the cost of the shifted profile at the predicted state, J-hat that of the delivered one there and J that of the
one being played, E_k = J+_k - J-hat_{k+1} is what the solver wins in a period and D_k = J+_k - J_k what waiting for it
loses; the cost falls where E_k > D_k. Over a run, differences of J telescope to nothing, so only the first period after
each load step counts: there a solver has everything to win.
"""

from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop_rig.figures.plot import COLOURS, legend_above
from coldloop_rig.studies.drawing import panels, spread
from coldloop_rig.studies.paper.trajectories import follows_step
from coldloop_rig.studies.request import Outcome, RunRequest, Series
from coldloop_rig.studies.study import PROGRAM, Load, Outcomes, StudyOptions, StudyResult, loads

PERIODS_S: Final = (1.0, 2.0, 3.0, 4.0, 5.0)
SOLVERS: Final = {"ode": "ODE", "qpoases": "qpOASES", "fast-gradient": "fast gradient", "osqp": "OSQP"}


COLUMNS: Final = ("load", "solver", "tau_u (s)", "E", "D", "share of load steps with E > D")


class TradeOff:
    """E for each solver and D, against tau_u, in the first period after load steps."""

    name = "trade-off"
    title = "What a period wins and loses (figures compareSf and twocases)"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every solver at every period."""
        return [
            _request(load, solver, period)
            for load in loads(options, "c")
            for solver in SOLVERS
            for period in _periods(options)
        ]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Average E and D over the events of each run."""
        periods = _periods(options)
        result = StudyResult(COLUMNS, [], {})
        curves: dict[str, list[list[tuple[float, float]]]] = {solver: [] for solver in SOLVERS}
        for load in loads(options, "c"):
            for solver, label in SOLVERS.items():
                points = [won_and_lost(outcomes[_request(load, solver, period)], load) for period in periods]
                curves[solver].append(points)
                result.rows += [
                    (load.name, label, period, won, lost, share_falling(outcomes[_request(load, solver, period)], load))
                    for period, (won, lost) in zip(periods, points, strict=True)
                ]
            for what, value in _discriminating(load, periods, outcomes).items():
                result.note(what, value)
        result.figures["efficiency and degradation"] = _figure(periods, curves)
        return result


def _periods(options: StudyOptions) -> tuple[float, ...]:
    return (1.0, 2.5, 5.0) if options.quick else PERIODS_S


def _request(load: Load, solver: str, period_s: float) -> RunRequest:
    return load.request(period_s, f"{PROGRAM}solver={solver}")


def after_steps(run: Outcome, load: Load) -> tuple[Series, Series]:
    """Return E_k and D_k of the first updates after load steps."""
    played, hot_start, delivered = (run.column(name) for name in ("j_effective", "j_hot_start", "j_delivered"))
    event: NDArray[np.bool_] = follows_step(run, load)
    return (hot_start - delivered)[event], (hot_start - played)[event]


def won_and_lost(run: Outcome, load: Load) -> tuple[float, float]:
    """Return the mean of E_k and of D_k over the first updates after load steps."""
    won, lost = after_steps(run, load)
    return (float(won.mean()), float(lost.mean())) if len(won) else (float("nan"), float("nan"))


def share_falling(run: Outcome, load: Load) -> float:
    """Return after which share of the load steps E_k > D_k: the cost falls in the first period."""
    won, lost = after_steps(run, load)
    return float((won > lost).mean()) if len(won) else float("nan")


def _discriminating(load: Load, periods: tuple[float, ...], outcomes: Outcomes) -> dict[str, float]:
    """Return how solvers and periods differ in the share of load steps after which the cost falls at once."""
    share = {
        (solver, period): share_falling(outcomes[_request(load, solver, period)], load)
        for solver in ("ode", "qpoases")
        for period in (periods[0], periods[-1])
    }
    short, long = f"{periods[0]:g} s", f"{periods[-1]:g} s"
    return {
        f"share of load steps after which E > D at {short}: ODE less qpOASES":
            share["ode", periods[0]] - share["qpoases", periods[0]],
        f"share of load steps after which E > D at {long} less that at {short}: qpOASES":
            share["qpoases", periods[-1]] - share["qpoases", periods[0]],
    }  # fmt: skip


def _figure(periods: tuple[float, ...], curves: dict[str, list[list[tuple[float, float]]]]) -> Figure:
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
