"""What variants of the loop cost, settings or a solver or rule of one's own, over a reference under the same draws."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop_rig.studies.drawing import ratio_rows, spans_decade
from coldloop_rig.studies.intervals import Interval, mean_ratio
from coldloop_rig.studies.loop_cost import require_costs
from coldloop_rig.studies.request import RunRequest
from coldloop_rig.studies.settings import settings_of
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, Variant, loads
from coldloop_rig.text_tables import markdown_table

Array = NDArray[np.float64]

COLUMNS: Final = ("variant", "load", "mean tau_u (s)", "J_BF", "J_BF over the reference")


class CompareStudy:
    """Variants of a file under the same draws; the first is the reference."""

    name = "compare"
    title = "Variants of one's own (--variants FILE), paired over draws"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every variant under every draw."""
        drawn = loads(options, *options.hours)
        return [_run(load, variant) for variant in options.variants for load in drawn]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare the cost of each variant with that of the first, draw by draw, and say what leaves its band."""
        drawn, variants = loads(options, *options.hours), options.variants
        shares = tuple(f"{one.name} outside (%)" for one in options.process.banded)
        result = StudyResult((*COLUMNS, *shares), [], {})
        found = [[outcomes[_run(load, variant)].indicators for load in drawn] for variant in variants]
        costs = np.array([[run.J_BF for run in runs] for runs in found])
        ratios = over_reference(costs)
        reference, summary = variants[0].name, []
        for variant, runs, over, ratio in zip(variants, found, costs / costs[0], ratios, strict=True):
            outside = np.array([[*run.outside_band_pct.values()] for run in runs])
            result.rows += [
                (variant.name, load.name, run.tau_u_mean, run.J_BF, float(one), *map(float, each))
                for load, run, one, each in zip(drawn, runs, over, outside, strict=True)
            ]
            means = (f"{share:.3g}" for share in outside.mean(axis=0))
            is_reference = variant is variants[0]
            said = ("1", "the reference") if is_reference else (ratio.text(), in_words(ratio))
            summary.append((variant.name, *said, *means))
            if not is_reference:
                what = f"J_BF of {variant.name} over that of {reference} {ratio.text()}, {in_words(ratio)}; by draw"
                result.values[what] = over.tolist()
        header = ("variant", f"J_BF over that of {reference}", "in words", *shares)
        caption = (
            f"Geometric mean of {len(drawn)} paired runs with its 95 % interval; shares of the time outside, their mean"
        )
        result.remarks += [markdown_table(header, summary, caption), _settings_table(variants)]
        result.figures["variants over the reference"] = _figure(variants, ratios, costs / costs[0])
        return result


def over_reference(costs: Array) -> list[Interval]:
    """Return the geometric mean of the costs of each row over those of the first, paired by column, with its interval.

    Args:
        costs: J_BF; a row for each variant, a column for each draw.

    Raises:
        StudyError: A loop costs nothing.
    """
    require_costs(costs)
    return [mean_ratio(row, costs[0]) for row in costs]


def in_words(ratio: Interval) -> str:
    """Return what an interval of a ratio of costs shows."""
    return ratio.in_words("costs less", "costs more", "one draw has no interval")


def _run(load: Load, variant: Variant) -> RunRequest:
    period_s = settings_of((*load.settings, *variant.assignments)).optimizer_plc.program.updating_period_s
    return load.request(period_s, *variant.assignments)


def _settings_table(variants: tuple[Variant, ...]) -> str:
    rows = [(variant.name, ", ".join(f"`{one}`" for one in variant.assignments[1:]) or "defaults")
            for variant in variants]  # fmt: skip
    return markdown_table(("variant", "settings"), rows, "What each variant changes of the defaults")


def _figure(variants: tuple[Variant, ...], ratios: list[Interval], by_draw: Array) -> Figure:
    """Draw a row for each variant: its mean with the interval, and each draw."""
    label = "geometric mean, 95 % interval"
    rows = {variant.name: ratio for variant, ratio in zip(variants[1:], ratios[1:], strict=True)}
    height_in = 1.2 + 0.35 * len(rows)
    figure = ratio_rows(
        {label: rows}, f"J_BF over that of {variants[0].name} (1); a mark for each draw", height_in, 0.25, 1
    )
    place = figure.axes[0]
    if not spans_decade(by_draw):
        place.set_xscale("linear")
    for number, over in enumerate(by_draw[1:]):
        place.plot(over, np.full(len(over), number + 0.2), "|", color="#888888", markersize=5)
    return figure
