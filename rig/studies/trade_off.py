"""Efficiency E and degradation D against the updating period, measured (paper, section II, figure `compareSf`).

With J+ the cost of the shifted profile at the predicted state, J-hat that of the delivered one there and J that of the
one being played, E_k = J+_k - J-hat_{k+1} is what the solver wins in a period and D_k = J+_k - J_k what waiting for it
loses; the cost falls where E_k > D_k. Over a run, differences of J telescope to nothing, so only the first period after
each load step counts: there a solver has everything to win.
"""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from rig.plot import COLOURS, legend_above
from rig.studies.drawing import panels, spread
from rig.studies.request import Outcome, RunRequest
from rig.studies.study import PROGRAM, Load, Outcomes, StudyOptions, StudyResult, loads
from rig.studies.trajectories import follows_step

PERIODS_S: Final = (1.0, 2.0, 3.0, 4.0, 5.0)
SOLVERS: Final = {"ode": "ODE", "qpoases": "qpOASES", "fast-gradient": "fast gradient", "osqp": "OSQP"}


class TradeOff:
    """E for each solver and D, against tau_u, in the first period after load steps."""

    name = "trade-off"
    title = "What a period wins and loses (figures compareSf and twocases)"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every solver at every period."""
        return [
            _request(load, solver, period)
            for load in _loads(options)
            for solver in SOLVERS
            for period in _periods(options)
        ]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Average E and D over the events of each run."""
        periods = _periods(options)
        result = StudyResult(("load", "solver", "tau_u (s)", "E", "D", "E > D"), [], {})
        curves: dict[str, list[list[tuple[float, float]]]] = {solver: [] for solver in SOLVERS}
        for load in _loads(options):
            for solver, label in SOLVERS.items():
                points = [won_and_lost(outcomes[_request(load, solver, period)], load) for period in periods]
                curves[solver].append(points)
                result.rows += [
                    (load.name, label, period, won, lost, int(won > lost))
                    for period, (won, lost) in zip(periods, points, strict=True)
                ]
                judged = [won > lost for won, lost in points if np.isfinite(won)]
                share = float(np.mean(judged)) if judged else float("nan")
                result.values.setdefault(f"share of the periods at which E > D: {label}", []).append(share)
        result.figures["efficiency and degradation"] = _figure(periods, curves)
        return result


def _loads(options: StudyOptions) -> list[Load]:
    return [draws[0] for draws in loads(options, "c").values()]


def _periods(options: StudyOptions) -> tuple[float, ...]:
    return (1.0, 2.5, 5.0) if options.quick else PERIODS_S


def _request(load: Load, solver: str, period_s: float) -> RunRequest:
    return load.request(period_s, f"{PROGRAM}solver={solver}")


def won_and_lost(run: Outcome, load: Load) -> tuple[float, float]:
    """Return the mean of E_k and of D_k over the first updates after load steps."""
    played, hot_start, delivered = (run.column(name) for name in ("j_effective", "j_hot_start", "j_delivered"))
    event = follows_step(run, load)
    won, lost = hot_start - delivered, hot_start - played
    return (float(won[event].mean()), float(lost[event].mean())) if event.any() else (float("nan"), float("nan"))


def _figure(periods: tuple[float, ...], curves: dict[str, list[list[tuple[float, float]]]]) -> Figure:
    with panels(2, 2, (9.0, 6.5), sharex=True) as (figure, axes):
        for place, (solver, draws), colour in zip(axes, curves.items(), COLOURS, strict=False):
            values = np.array(draws)
            spread(place, periods, values[:, :, 0], colour, "$E$: won by the solver")
            spread(place, periods, values[:, :, 1], "#888888", "$D$: lost by shift and mismatch")
            place.set_title(SOLVERS[solver], loc="left", pad=18)
            place.set_ylabel("cost a period (1)")
            legend_above(place)
        for place in axes[-2:]:
            place.set_xlabel("updating period (s)")
    return figure
