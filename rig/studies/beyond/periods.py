"""Whether an adaptive updating period pays, on any process: against fixed ones, under the same loads."""

from collections.abc import Sequence
from itertools import cycle
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from coldloop.process.loaded import PROCESS
from rig.figures.plot import COLOURS
from rig.studies.adaptive_gain import FIXED_S, over_best_fixed, pays
from rig.studies.drawing import legend_outside, panels
from rig.studies.loop_cost import ADAPTIVE
from rig.studies.request import Outcome, RunRequest
from rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads
from rig.text_tables import markdown_table

PERIODS_S: Final = (ADAPTIVE, *FIXED_S)
COLUMNS: Final = (
    "load", "tau_u (s)", "mean tau_u (s)", "J_BF", *(f"{one.name} outside (%)" for one in PROCESS.banded),
)  # fmt: skip


class PeriodsStudy:
    """Closed-loop cost against the updating period, fixed and adaptive."""

    name = "periods"
    title = "Cost against updating period of the process that is loaded, fixed and adaptive"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every period under every draw."""
        return [request for load in loads(options, *"abc") for request in _runs(load)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare the adaptive period with the best fixed one, chosen on the same loads, which favours that."""
        result, costs = StudyResult(COLUMNS, [], {}), []
        drawn = loads(options, *"abc")
        for load in drawn:
            found = [outcomes[request] for request in _runs(load)]
            result.rows += [_row(load.name, *one) for one in zip(PERIODS_S, found, strict=True)]
            costs.append([one.indicators.J_BF for one in found])
        by_period = np.array(costs).T
        best, ratio = over_best_fixed(by_period)
        result.note(f"J_BF of the adaptive period over fixed {PERIODS_S[best]:g} s", ratio.value)
        title = (
            f"J_BF of the adaptive period over that of {PERIODS_S[best]:g} s, the best fixed one: {ratio.text()}, "
            f"{pays(ratio)}."
        )
        result.remarks.append(markdown_table(COLUMNS, [tuple(map(_text, row)) for row in result.rows], title))
        result.figures["cost against period"] = _figure(drawn, by_period, [
            [outcomes[request].indicators.tau_u_mean for request in _runs(load)] for load in drawn
        ])  # fmt: skip
        return result


def _runs(load: Load) -> list[RunRequest]:
    return [load.request(period) for period in PERIODS_S]


def _row(name: str, period_s: float, outcome: Outcome) -> tuple[str | float, ...]:
    run = outcome.indicators
    outside = (getattr(run, f"{one.name}_outside_band_pct") for one in PROCESS.banded)
    return (name, "adaptive" if period_s == ADAPTIVE else period_s, run.tau_u_mean, run.J_BF, *outside)


def _text(cell: str | float) -> str:
    return cell if isinstance(cell, str) else f"{cell:.4g}"


def _figure(drawn: Sequence[Load], by_period: np.ndarray, means: Sequence[Sequence[float]]) -> Figure:
    with panels(1, 1, (7.0, 3.8)) as (figure, (place,)):
        for load, cost, mean, colour in zip(drawn, by_period.T, means, cycle(COLOURS)):
            place.plot(FIXED_S, cost[1:], ".-", color=colour, linewidth=1.2, label=load.name)
            place.plot(mean[0], cost[0], "*", color=colour, markersize=9)
        place.set_yscale("log")
        place.set_xlabel("updating period (s); stars: adaptive, at their mean")
        place.set_ylabel("$J^{BF}$ (1)")
        legend_outside(figure, place, columns=6)
    return figure
