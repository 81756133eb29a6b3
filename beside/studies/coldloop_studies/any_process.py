"""Studies of any process: variants of one's own over a reference, and whether an adaptive updating period pays.

The best fixed period of a regime is chosen on the first draw of each load and judged on the others: chosen on the loads
that it is judged by, the best of several is too good by chance.
"""

from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop.process import cold_box, declaration
from coldloop_rig.figures.plot import COLOURS
from coldloop_rig.plc_sizing import intervals
from coldloop_rig.text_tables import Cell, markdown_table
from coldloop_studies import drawing, request, study
from coldloop_studies.settings import settings_of
from coldloop_studies.study import NOISE, PROGRAM, TUNED, Load, Outcomes, StudyOptions, StudyResult, Variant, loads

Array = NDArray[np.float64]

VARIANT_COLUMNS: Final = ("variant", "load", "mean tau_u (s)", "J_BF", "J_BF over the reference")


def _compare(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
    """Compare the cost of each variant with that of the first, draw by draw, and say what leaves its band."""
    drawn, variants = loads(options, *options.hours), options.variants
    shares = tuple(f"{one.name} outside (%)" for one in options.process.banded)
    result = StudyResult((*VARIANT_COLUMNS, *shares), [], {})
    found = [[outcomes[_variant_run(load, variant)].indicators for load in drawn] for variant in variants]
    costs = np.array([[run.J_BF for run in runs] for runs in found])
    intervals.require_costs(costs)
    ratios = [intervals.mean_ratio(row, costs[0]) for row in costs]  # paired by draw
    reference, summary = variants[0].name, []
    for variant, runs, over, ratio in zip(variants, found, costs / costs[0], ratios, strict=True):
        outside = np.array([[*run.outside_band_pct.values()] for run in runs])
        result.rows += [
            (variant.name, load.name, run.tau_u_mean, run.J_BF, float(one), *map(float, each))
            for load, run, one, each in zip(drawn, runs, over, outside, strict=True)
        ]
        means = (f"{share:.3g}" for share in outside.mean(axis=0))
        is_reference = variant is variants[0]
        words = ratio.in_words("costs less", "costs more", "one draw has no interval")
        said = ("1", "the reference") if is_reference else (ratio.text(), words)
        summary.append((variant.name, *said, *means))
        if not is_reference:
            what = f"J_BF of {variant.name} over that of {reference} {ratio.text()}, {words}; by draw"
            result.values[what] = over.tolist()
    header = ("variant", f"J_BF over that of {reference}", "in words", *shares)
    caption = (
        f"Geometric mean of {len(drawn)} paired runs with its 95 % interval; shares of the time outside, their mean"
    )
    changes = [(one.name, ", ".join(f"`{each}`" for each in one.assignments[1:]) or "defaults") for one in variants]
    result.remarks += [
        markdown_table(header, summary, caption),
        markdown_table(("variant", "settings"), changes, "What each variant changes of the defaults"),
    ]
    result.figures["variants over the reference"] = _variants_figure(variants, ratios, costs / costs[0])
    return result


COMPARE: Final = study.Study(
    "compare",
    "Variants of one's own (--variants FILE), paired over draws",
    lambda options: [
        _variant_run(load, variant) for variant in options.variants for load in loads(options, *options.hours)
    ],
    _compare,
)
"""Variants of a file under the same draws; the first is the reference."""


def _variant_run(load: Load, variant: Variant) -> request.RunRequest:
    period_s = settings_of((*load.settings, *variant.assignments)).optimizer_plc.program.updating_period_s
    return load.request(period_s, *variant.assignments)


def _variants_figure(variants: tuple[Variant, ...], ratios: list[intervals.Interval], by_draw: Array) -> Figure:
    label = "geometric mean, 95 % interval"
    rows = {variant.name: ratio for variant, ratio in zip(variants[1:], ratios[1:], strict=True)}
    height_in = 1.2 + 0.35 * len(rows)
    figure = drawing.ratio_rows(
        {label: rows}, f"J_BF over that of {variants[0].name} (1); a mark for each draw", height_in, 0.25, 1
    )
    place = figure.axes[0]
    if not drawing.spans_decade(by_draw):
        place.set_xscale("linear")
    for number, over in enumerate(by_draw[1:]):
        place.plot(over, np.full(len(over), number + 0.2), "|", color="#888888", markersize=5)
    return figure


NOMINAL: Final = "as its model"
OF_COLD_BOX: Final = {
    "noisy sensors": NOISE,
    "near the capacity": ("plant.mismatch.heat_transfer=0.9",),
    "rate limits by elapsed time": ("limits.rate_reference=elapsed",),
}
"""Settings of each regime; with exchangers 10 % worse the plant holds 513 W, and the hours d to f have up to 585 W."""
COLUMNS: Final = ("regime", "load", "tau_u (s)", "mean tau_u (s)", "J_BF")
SUMMARY: Final = ("regime", "mean of adaptive (s)", "best fixed (s)", "adaptive over it", "in words")


def _regimes(process: declaration.Process) -> dict[str, tuple[str, ...]]:
    return {NOMINAL: (), **(OF_COLD_BOX if process == cold_box.COLD_BOX else {})}


def _other_rule(process: declaration.Process) -> tuple[str, str]:
    """Return the rule that is not the default: its name in the settings, and in words."""
    return ("algorithm-1", "Algorithm 1") if process.tuned.get("adaptive") else ("contraction", "contraction rule")


def periods(process: declaration.Process) -> tuple[float, ...]:
    """Return the updating periods that are compared, s, the adaptive one first."""
    return (intervals.ADAPTIVE, *intervals.fixed_periods(process))


def _periods(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
    """Compare the adaptive period, in each regime, with the best fixed one of other draws, if there are any."""
    process, drawn, summary = options.process, loads(options, *"abcdef"), []
    result = StudyResult((*COLUMNS, *(f"{one.name} outside (%)" for one in process.banded)), [], {})
    tried, named = periods(process), _other_rule(process)[1]
    costs, means, training = {}, {}, np.array([load.draw == 1 for load in drawn])
    labels: list[Cell] = ["adaptive", *tried[1:], named]
    for regime, settings in _regimes(process).items():
        found = [[outcomes[run].indicators for run in _runs(load, process, settings)] for load in drawn]
        rows = [
            [(regime, load.name, label, run.tau_u_mean, run.J_BF, *run.outside_band_pct.values())
             for label, run in zip(labels, runs, strict=True)]
            for load, runs in zip(drawn, found, strict=True)
        ]  # fmt: skip
        result.rows += [row for of_load in rows for row in of_load[:-1]] + [of_load[-1] for of_load in rows]
        every = np.array([[run.J_BF for run in runs] for runs in found]).T
        costs[regime] = every[:-1]
        means[regime] = float(np.mean([runs[0].tau_u_mean for runs in found]))
        best, ratio = judged(costs[regime], training)
        _, of_other = judged(np.vstack((every[-1], every[1:-1])), training)
        result.note(f"{regime}: J_BF of the adaptive period over fixed {tried[best]:g} s", ratio.value)
        cells = f"{means[regime]:.2f}", f"{tried[best]:g}", ratio.text(), intervals.pays(ratio), of_other.text()
        summary.append((regime, *cells))
    fresh = training.any() and not training.all()
    chosen = "on the first draws, judged on the others" if fresh else "on the same, which favours it"
    title = f"J_BF of the adaptive period over the best fixed one, chosen {chosen}"
    result.remarks.append(markdown_table((*SUMMARY, f"{named} over it"), summary, title))
    texts = [tuple(cell if isinstance(cell, str) else f"{cell:.4g}" for cell in row) for row in result.rows]
    result.remarks.append(markdown_table(result.columns, texts, "All runs"))
    result.figures["cost against period"] = _periods_figure(costs, means, tried[1:])
    return result


PERIODS: Final = study.Study(
    "periods",
    "Cost against updating period of any process, fixed and adaptive",
    lambda options: [
        run
        for regime in _regimes(options.process).values()
        for load in loads(options, *"abcdef")
        for run in _runs(load, options.process, regime)
    ],
    _periods,
)
"""Closed-loop cost against the updating period, fixed and adaptive."""


def judged(costs: Array, training: NDArray[np.bool_]) -> tuple[int, intervals.Interval]:
    """Return which fixed period is the best, and the cost of the adaptive one over its.

    Args:
        costs: A row for each of `periods`, a column for each load.
        training: Which loads it is chosen on; judged on the others, or on the same where there are no others.

    Raises:
        StudyError: A loop costs nothing.
    """
    intervals.require_costs(costs)
    if training.all() or not training.any():
        return intervals.over_best_fixed(costs)
    best, _ = intervals.over_best_fixed(costs[:, training])
    return best, intervals.mean_ratio(costs[0, ~training], costs[best, ~training])


def _runs(load: Load, process: declaration.Process, settings: tuple[str, ...]) -> list[request.RunRequest]:
    """Return the run of each of `periods`, and that of the rule that is not the default."""
    other = load.request(intervals.ADAPTIVE, TUNED, f"{PROGRAM}adaptive.rule={_other_rule(process)[0]}", *settings)
    return [*(load.request(period, TUNED, *settings) for period in periods(process)), other]


def _periods_figure(costs: dict[str, Array], means: dict[str, float], fixed_s: tuple[float, ...]) -> Figure:
    """Draw, for each regime, each fixed period's cost over that of the adaptive one, and their geometric mean."""
    beside = min(2, len(costs))
    with drawing.panels(len(costs) // beside, beside, 2.6 if beside == 1 else 4.4) as (figure, places):
        for place, (regime, by_period) in zip(places, costs.items(), strict=True):
            over = by_period[1:] / by_period[0]
            place.plot(fixed_s, over, "-", color=COLOURS[0], alpha=0.25, linewidth=0.8)
            place.plot(
                fixed_s, [intervals.geometric_mean(one) for one in over], ".-", color=COLOURS[0], label="geometric mean"
            )
            place.plot(means[regime], 1.0, "*", color=COLOURS[1], markersize=9, label="adaptive, at its mean period")
            place.axhline(1.0, color=COLOURS[1], linewidth=0.8)
            drawing.ratio_scale(place, "y", over)
            place.set_title(regime)
        figure.supxlabel("fixed period (s)", fontsize=8)
        figure.supylabel("$J^{BF}$ over that of the adaptive period (1)", fontsize=8)
        drawing.legend_outside(figure, places[0])
    return figure
