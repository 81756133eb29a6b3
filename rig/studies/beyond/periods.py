"""Whether an adaptive updating period pays, on any process and in which regime: against fixed ones, by fresh loads.

The best fixed period of a regime is chosen on the first draw of each load and judged on the others: chosen on the loads
that it is judged by, the best of several is too good by chance.
"""

from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.loaded import PROCESS
from rig.figures.plot import COLOURS
from rig.studies.adaptive_gain import FIXED_S, over_best_fixed, pays
from rig.studies.drawing import legend_outside, panels, ratio_scale
from rig.studies.intervals import Interval, geometric_mean, mean_ratio
from rig.studies.loop_cost import ADAPTIVE, require_costs
from rig.studies.request import Outcome, RunRequest
from rig.studies.study import NOISE, PROGRAM, TUNED, Load, Outcomes, StudyOptions, StudyResult, loads
from rig.text_tables import markdown_table

Array = NDArray[np.float64]

PERIODS_S: Final = (ADAPTIVE, *FIXED_S)
NOMINAL: Final = "as its model"
OF_COLD_BOX: Final = {
    "noisy sensors": NOISE,
    "near the capacity": ("plant.mismatch.heat_transfer=0.9",),
    "rate limits by elapsed time": ("limits.rate_reference=elapsed",),
}
"""What differs; with exchangers 10 % worse the plant holds 513 W, and the hours d to f have up to 585 W."""
OTHER_RULE: Final = "algorithm-1" if PROCESS.tuned.get("adaptive") else "contraction"
OTHER: Final = "Algorithm 1" if PROCESS.tuned.get("adaptive") else "contraction rule"
"""The rule that is not the default."""
REGIMES: Final[dict[str, tuple[str, ...]]] = {NOMINAL: (), **(OF_COLD_BOX if PROCESS is COLD_BOX else {})}
COLUMNS: Final = (
    "regime", "load", "tau_u (s)", "mean tau_u (s)", "J_BF", *(f"{one.name} outside (%)" for one in PROCESS.banded),
)  # fmt: skip
SUMMARY: Final = (
    "regime",
    "mean of adaptive (s)",
    "best fixed (s)",
    "adaptive over it",
    "in words",
    f"{OTHER} over it",
)


class PeriodsStudy:
    """Closed-loop cost against the updating period, fixed and adaptive."""

    name = "periods"
    title = "Cost against updating period of the process that is loaded, fixed and adaptive"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every period under every draw, in each regime, and the rule that is not the default."""
        drawn = loads(options, *"abcdef")
        return [run for regime in REGIMES for load in drawn for run in (*_runs(load, regime), _other(load, regime))]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare the adaptive period, in each regime, with the best fixed one of other draws, if there are any."""
        drawn, result, summary = loads(options, *"abcdef"), StudyResult(COLUMNS, [], {}), []
        costs, means, training = {}, {}, np.array([load.draw == 1 for load in drawn])
        for regime in REGIMES:
            found = [[outcomes[run] for run in _runs(load, regime)] for load in drawn]
            for load, some in zip(drawn, found, strict=True):
                result.rows += [_row(regime, load.name, *one) for one in zip(PERIODS_S, some, strict=True)]
            other = [outcomes[_other(load, regime)] for load in drawn]
            result.rows += [_row(regime, load.name, OTHER, run) for load, run in zip(drawn, other, strict=True)]
            costs[regime] = np.array([[one.indicators.J_BF for one in some] for some in found]).T
            means[regime] = float(np.mean([some[0].indicators.tau_u_mean for some in found]))
            best, ratio = judged(costs[regime], training)
            of_other = judged(np.vstack(([run.indicators.J_BF for run in other], costs[regime][1:])), training)[1]
            result.note(f"{regime}: J_BF of the adaptive period over fixed {PERIODS_S[best]:g} s", ratio.value)
            cells = f"{means[regime]:.2f}", f"{PERIODS_S[best]:g}", ratio.text(), pays(ratio), of_other.text()
            summary.append((regime, *cells))
        fresh = _has_others(training)
        chosen = "on the first draws, judged on the others" if fresh else "on the same, which favours it"
        title = f"J_BF of the adaptive period over the best fixed one, chosen {chosen}"
        result.remarks.append(markdown_table(SUMMARY, summary, title))
        result.remarks.append(markdown_table(COLUMNS, [tuple(map(_text, row)) for row in result.rows], "All runs"))
        result.figures["cost against period"] = _figure(costs, means)
        return result


def judged(costs: Array, training: NDArray[np.bool_]) -> tuple[int, Interval]:
    """Return which fixed period is the best, and the cost of the adaptive one over its.

    Args:
        costs: A row for each of `PERIODS_S`, a column for each load.
        training: Which loads it is chosen on; judged on the others, or on the same where there are no others.

    Raises:
        StudyError: A loop costs nothing.
    """
    require_costs(costs)
    if not _has_others(training):
        return over_best_fixed(costs)
    best, _ = over_best_fixed(costs[:, training])
    return best, mean_ratio(costs[0, ~training], costs[best, ~training])


def _has_others(training: NDArray[np.bool_]) -> bool:
    return bool(training.any() and not training.all())


def _runs(load: Load, regime: str) -> list[RunRequest]:
    return [load.request(period, TUNED, *REGIMES[regime]) for period in PERIODS_S]


def _other(load: Load, regime: str) -> RunRequest:
    return load.request(ADAPTIVE, TUNED, f"{PROGRAM}adaptive.rule={OTHER_RULE}", *REGIMES[regime])


def _row(regime: str, name: str, period_s: float | str, outcome: Outcome) -> tuple[str | float, ...]:
    run = outcome.indicators
    outside = (getattr(run, f"{one.name}_outside_band_pct") for one in PROCESS.banded)
    return (regime, name, "adaptive" if period_s == ADAPTIVE else period_s, run.tau_u_mean, run.J_BF, *outside)


def _text(cell: str | float) -> str:
    return cell if isinstance(cell, str) else f"{cell:.4g}"


def _figure(costs: dict[str, Array], means: dict[str, float]) -> Figure:
    """Draw, for each regime, each fixed period's cost over that of the adaptive one, and their geometric mean."""
    beside = min(2, len(costs))
    with panels(len(costs) // beside, beside, 2.6 if beside == 1 else 4.4) as (figure, places):
        for place, (regime, by_period) in zip(places, costs.items(), strict=True):
            over = by_period[1:] / by_period[0]
            place.plot(FIXED_S, over, "-", color=COLOURS[0], alpha=0.25, linewidth=0.8)
            place.plot(FIXED_S, [geometric_mean(one) for one in over], ".-", color=COLOURS[0], label="geometric mean")
            place.plot(means[regime], 1.0, "*", color=COLOURS[1], markersize=9, label="adaptive, at its mean period")
            place.axhline(1.0, color=COLOURS[1], linewidth=0.8)
            ratio_scale(place, "y", over)
            place.set_title(regime)
        figure.supxlabel("fixed period (s)", fontsize=8)
        figure.supylabel("$J^{BF}$ over that of the adaptive period (1)", fontsize=8)
        legend_outside(figure, places[0])
    return figure
