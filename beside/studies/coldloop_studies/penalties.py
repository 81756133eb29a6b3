"""Effect of penalties, start and devices of the ODE-based solver on costs, violations and the best period.

The solver tuned and as printed, and each with one thing changed at a time.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coldloop_optimizer_plc.settings import Preset
from coldloop_plant.load import HOUR_TICKS
from coldloop_rig.figures.plot import ACCENT, DASHES, INK, THIRD
from coldloop_rig.plc_sizing.intervals import Interval, crossing, interval_of_share, jackknife, mean_ratio
from coldloop_rig.text_tables import Cell, markdown_table
from coldloop_studies import drawing, updating_period
from coldloop_studies.drawing import above_lowest, hour_panels, legend_outside, panels, paper
from coldloop_studies.request import RunRequest, Series
from coldloop_studies.solver_comparison import PairedSums, paired_loads, paired_request, throttled
from coldloop_studies.study import PROGRAM, Load, Outcomes, Study, StudyOptions, StudyResult, first_and_fresh, loads

TUNED: Final = "tuned"
AS_PRINTED: Final = Preset.AS_PRINTED.value


class PenaltyVariant(NamedTuple):
    """Penalties and start of the solver, tuned or as printed, or these with one thing changed."""

    preset: str
    change: str
    """Empty for the preset itself."""
    assignments: tuple[str, ...]

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return f"{self.preset}, {self.change}" if self.change else self.preset

    @property
    def is_start(self) -> bool:
        """Whether it changes the size of the first step only."""
        return self.change.startswith(COST_SCALE)

    @property
    def is_timed(self) -> bool:
        """Whether its periods are compared, too."""
        return not self.change or self.change in TIMED


Paired = PairedSums[PenaltyVariant | None]

QPOASES: Final = "qpOASES"
COLOURS: Final = {QPOASES: "#000000", TUNED: INK, AS_PRINTED: ACCENT}
COST_SCALE: Final = "cost_scale"
TIMED: Final = (f"{COST_SCALE} 0.0001", f"{COST_SCALE} 1e-08")
"""Starts whose best periods are looked for: that of the other preset."""
RATES: Final = {"x 16": (16, 16, 16), "x 160": (160, 160, 160), "in % and W": (100, 2500, 100)}
CHANGES: Final = {
    **{f"alpha = {factor:g} rho": f"penalties.output_rows={factor}" for factor in (0.3, 1.0, 3.0, 10.0, 30.0)},
    **{f"rate rows {name}": f"penalties.rate_rows={list(weights)}" for name, weights in RATES.items()},
    **{f"{COST_SCALE} {scale:g}": f"ode.cost_scale={scale}" for scale in (1.0, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10)},
    "with look-ahead rows": "ode.look_ahead_rows=true", "without look-ahead rows": "ode.look_ahead_rows=false",
    "held at bounds": "ode.hold_at_bounds=true", "not held at bounds": "ode.hold_at_bounds=false",
    "first knot as a box": "penalties.first_knot_in_box=true",
    "first knot as rows": "penalties.first_knot_in_box=false",
    "box penalty": "penalties.box=1", "no box penalty": "penalties.box=0",
}  # fmt: skip
OWN: Final = {
    TUNED: ("alpha = 30 rho", "rate rows x 16", f"{COST_SCALE} 0.0001", "with look-ahead rows",
                   "held at bounds", "first knot as a box", "no box penalty"),
    AS_PRINTED: ("alpha = 1 rho", "rate rows in % and W", f"{COST_SCALE} 1e-08", "without look-ahead rows",
                        "not held at bounds", "first knot as rows", "box penalty"),
}  # fmt: skip
"""Changes that each preset contains itself. A test compares them with the presets."""


def _variants_of(preset: str) -> Iterator[PenaltyVariant]:
    """Yield a preset, then its changes; studies set out from the tuned one."""
    asked = () if preset == TUNED else (f"{PROGRAM}preset={preset}",)
    yield PenaltyVariant(preset, "", asked)
    for change, assignment in CHANGES.items():
        if change not in OWN[preset]:
            yield PenaltyVariant(preset, change, (*asked, PROGRAM + assignment))


PRESETS: Final = {preset: next(_variants_of(preset)) for preset in OWN}
VARIANTS: Final = tuple(variant for preset in OWN for variant in _variants_of(preset))
NOMINAL: Final = 1.0
SETTLED: Final = 10.0
"""Computing power, over that of the reference PLC, at which a solver has converged."""
START_POWERS: Final = (0.2, 0.4, 0.6, 1.0)
"""Computing powers at which other starts are compared: a start matters only with few iterations."""


def variants(options: StudyOptions) -> tuple[PenaltyVariant, ...]:
    """Return those of a study; a quick one has the presets only."""
    return tuple(PRESETS.values()) if options.quick else VARIANTS


def powers_of(variant: PenaltyVariant | None, options: StudyOptions) -> tuple[float, ...]:
    """Return the powers of a variant, or of qpOASES."""
    if options.quick:
        return (0.2, 1.0, SETTLED, 25.0)
    if variant is None or not variant.change:
        return (0.2, 0.4, 0.6, 1.0, 2.0, 3.2, 4.0, 5.0, 7.0, SETTLED, 15.0, 25.0)  # some of the paper's
    if variant.is_start:
        return START_POWERS
    if variant.change.startswith(("alpha", "rate rows")):
        return (1.0, SETTLED)  # other weights have another optimum
    return (1.0,)  # all else has an effect on few iterations, and none on the optimum


def paired(load: Load, variant: PenaltyVariant | None, power: float) -> RunRequest:
    """Return the request for a variant, or for qpOASES, on the problems of a load."""
    if variant is None:
        return paired_request(load, "qpoases", power)
    request = paired_request(load, "ode", power)
    return replace(request, assignments=(*request.assignments, *variant.assignments))


def paired_sums(options: StudyOptions, outcomes: Outcomes) -> Paired:
    """Gather what presets, variants and qpOASES, which is no variant, gave on the same problems.

    Raises StudyError if a profile costs less than the optimum.
    """
    powers = {variant: sorted(powers_of(variant, options)) for variant in (None, *variants(options))}
    return PairedSums(
        paired_loads(options), powers, paired, lambda variant: variant.label if variant else QPOASES, outcomes
    )


def _closed_loads(options: StudyOptions) -> list[Load]:
    return loads(options, "8h", usual=6, longest_ticks=HOUR_TICKS)


def closed(load: Load, variant: PenaltyVariant) -> RunRequest:
    """Return the request for the closed loop of a variant at 5 s and P = 1."""
    request = throttled(load, "ode", NOMINAL)
    return replace(request, assignments=(*request.assignments, *variant.assignments))


def hours(options: StudyOptions) -> list[Load]:
    """Return the hours that periods are compared in."""
    return loads(options, *options.hours, usual=3)  # draws from the second on are fresh


def periods(options: StudyOptions) -> tuple[float, ...]:
    """Return the updating periods, s."""
    return updating_period.FEW if options.quick else updating_period.NINE


def _timed_variants(load: Load, options: StudyOptions) -> list[PenaltyVariant]:
    return [one for one in variants(options) if one.is_timed and (not one.change or load.draw == 1)]


def _period_runs(load: Load, variant: PenaltyVariant, options: StudyOptions) -> list[RunRequest]:
    return [load.request(period, *variant.assignments) for period in periods(options)]


FIRST: Final = "hours of the first draw"
COSTS: Final = {"J_open_mean": "open loop", "J_BF": "J_BF"}
PeriodCosts = dict[Load, Mapping[str, Series]]
"""Costs of the periods, by hour and kind of cost."""


def _hours_by_title(costs: PeriodCosts, cost: str) -> dict[str, Series]:
    """Return the costs of the periods in first and in fresh hours, shape (hours, periods) each."""
    groups = first_and_fresh(costs, FIRST).items()
    return {title: np.array([costs[load][cost] for load in some]) for title, some in groups}


def share_inside(table: Series) -> Interval:
    """Return the share of hours, rows of `table`, whose best period is inside, with its interval over the hours."""
    return interval_of_share(sum(map(updating_period.is_inside, table)), len(table))


def end_over_best(table: Series, end: int) -> Interval:
    """Return by how much the first (0) or the last (-1) period costs more than the best, geometric mean of hours."""
    return mean_ratio(table[:, end], table.min(axis=1))


def _period_remarks(timed: Mapping[PenaltyVariant, PeriodCosts], periods: Sequence[float]) -> list[str]:
    theirs = np.array([hour["cost_fixed_pct"] for hour in drawing.published_periods().values()])
    remarks = []
    for cost, name in COSTS.items():
        rows: list[tuple[Cell, ...]] = []
        for setting, costs in timed.items():
            for title, table in _hours_by_title(costs, cost).items():
                rows.append((setting.label, title, *_period_row(table, periods)))
        if cost == "J_open_mean" and theirs.shape[1] == len(periods):
            rows.insert(0, ("the paper's points", "hours a to f", *_period_row(theirs, periods)))
        caption = (
            f"**Best of the fixed periods, {name}**: in how many hours it is neither the shortest nor the longest, "
            "which it is in each (s), and what the shortest and the longest cost over it, geometric mean of the hours; "
            "in brackets 95 % intervals over the hours."
        )
        header = ("setting", "hours", "inside, share", "best in each hour (s)", f"{periods[0]:g} s over the best",
                  f"{periods[-1]:g} s over the best")  # fmt: skip
        remarks.append(markdown_table(header, rows, caption))
    return remarks


def _period_row(table: Series, periods: Sequence[float]) -> tuple[Cell, ...]:
    best = " ".join(f"{periods[place]:g}" for place in table.argmin(axis=1))
    ends = (end_over_best(table, end).brief() for end in (0, -1))
    return share_inside(table).brief(2), best, *ends


def _period_figure(timed: Mapping[PenaltyVariant, PeriodCosts], periods: Sequence[float]) -> Figure:
    """Draw the first draw of each hour over its best period, both presets and the paper's points."""
    presets = {setting: costs for setting, costs in timed.items() if not setting.change}
    names = [load.name for load in next(iter(presets.values())) if load.draw == 1]

    def draw(name: str, place: Axes) -> None:
        for setting, costs in presets.items():
            of_hour = next(of_load for load, of_load in costs.items() if load.name == name)["J_open_mean"]
            colour = COLOURS[setting.preset]
            place.plot(periods, of_hour / of_hour.min(), color=colour, linestyle=DASHES[colour], marker=".",
                       label=setting.label)  # fmt: skip
        theirs = drawing.published_periods().get(name)
        if theirs:
            fixed = theirs["cost_fixed_pct"]
            paper(place, theirs["tau_u_s"], fixed / fixed.min(), THIRD, "paper")

    return hour_panels(names, draw, "cost over that of the best (1)", (1, 2, 5, 10, 20, 50))


COLUMNS: Final = (
    "part", "load", "preset", "change", "power or period", "J_dev", "J_cst", "c1", "c2", "lowest", "J per time", "J_BF",
)  # fmt: skip


def _penalties_requests(options: StudyOptions) -> list[RunRequest]:
    found = [
        paired(load, variant, power)
        for load in paired_loads(options)  # a worker has the problems of a load at hand
        for variant in (None, *variants(options))
        for power in powers_of(variant, options)
    ]
    found += [closed(load, variant) for variant in variants(options) for load in _closed_loads(options)]
    for load in hours(options):
        for variant in _timed_variants(load, options):
            found += _period_runs(load, variant, options)
    return found


def _penalties(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
    found = paired_sums(options, outcomes)
    loops = {
        variant: np.array([outcomes[closed(load, variant)].indicators.J_BF for load in _closed_loads(options)])
        for variant in variants(options)
    }
    timed: dict[PenaltyVariant, PeriodCosts] = {}
    for load in hours(options):
        for variant in _timed_variants(load, options):
            runs = [outcomes[request].indicators for request in _period_runs(load, variant, options)]
            timed.setdefault(variant, {})[load] = {
                cost: np.array([getattr(run, cost) for run in runs]) for cost in COSTS
            }
    figures = {"total cost": _figure(found), "periods": _period_figure(timed, periods(options))}
    result = StudyResult(COLUMNS, _rows(options, found, loops, timed), figures)
    for preset, variant in PRESETS.items():
        result.values |= {
            f"{preset}: crossing in total cost": found.crossings(None, variant),
            f"{preset}: c1 at P = 1": [one.c1 for one in found.sums[variant, NOMINAL]],
            f"{preset}: c2 at P = 1": [one.c2 for one in found.sums[variant, NOMINAL]],
        }
        tables = {cost: _hours_by_title(timed[variant], cost) for cost in COSTS}
        for title in tables["J_BF"]:
            for cost, kind in COSTS.items():
                name = f"{preset}: interior optimum, share of {title}, {kind}"
                result.values[name] = [share_inside(tables[cost][title]).value]
    result.remarks += [
        _crossing_text(found),
        *(_table(preset, options, found, loops) for preset in PRESETS),
        *_start_table(options, found),
        *_period_remarks(timed, periods(options)),
    ]
    return result


PENALTIES: Final = Study(
    "penalties", "Penalties, start and devices of the ODE-based solver: two presets", _penalties_requests, _penalties
)
"""Both presets, and each with one thing changed at a time."""


def _rows(
    options: StudyOptions, found: Paired, loops: Mapping[PenaltyVariant, Series],
    timed: Mapping[PenaltyVariant, PeriodCosts],
) -> list[tuple[Cell, ...]]:  # fmt: skip
    def names(variant: PenaltyVariant | None) -> tuple[str, str]:
        return (variant.preset, variant.change) if variant else ("", QPOASES)

    nothing = (np.nan,) * 5
    return [
        *(("paired", load.name, *names(variant), power, *sums, np.nan, np.nan)
          for (variant, power), draws in found.sums.items()
          for load, sums in zip(found.loads, draws, strict=True)),
        *(("closed", load.name, *names(variant), NOMINAL, *nothing, np.nan, float(cost))
          for variant, costs in loops.items()
          for load, cost in zip(_closed_loads(options), costs, strict=True)),
        *(("period", load.name, *names(variant), period, *nothing, float(of_load["J_open_mean"][i]),
           float(of_load["J_BF"][i]))
          for variant, costs in timed.items() for load, of_load in costs.items()
          for i, period in enumerate(periods(options))),
    ]  # fmt: skip


def _crossing_text(found: Paired) -> str:
    def said(variant: PenaltyVariant) -> str:
        power = found.crossing(None, variant)
        where = f"from P = {power.brief()} on" if np.isfinite(power.value) else "at no power"
        return f"{variant.preset}: {where}"

    profiles = sum(len(draws) for draws in found.sums.values())
    return (
        f"**Paired, open loop** ({len(found.loads)} draws; {profiles} runs through their problems, and no profile "
        "costs less than the lowest cost of its problem). qpOASES costs no more than the ODE-based solver, "
        f"{'; '.join(said(variant) for variant in PRESETS.values())}; the paper's curves cross at "
        f"P = {_of_paper('crossing'):.3g}."
    )


def _of_paper(what: str) -> float:
    """Return a value of the paper's points at P = 1, relative to its converged qpOASES where that is meant."""
    points = drawing.published_comparison()
    ode, qpoases = points["ode"], points["qpoases"]
    powers = ode["normalized_power"]
    if what == "crossing":
        return crossing(powers, qpoases["J_total"], ode["J_total"])
    value = float(ode[what][int(np.argmin(np.abs(powers - NOMINAL)))])
    return value / float(qpoases[what][-1]) if what.startswith("J") else value


def _table(preset: str, options: StudyOptions, found: Paired, loops: Mapping[PenaltyVariant, Series]) -> str:
    """Return what one change at a time does to a preset, and the paper's points."""
    rows: list[tuple[Cell, ...]] = [(
        "the paper's points", f"{_of_paper('J_total'):.3f}", "", f"{_of_paper('J_dev'):.3f}",
        f"{_of_paper('J_cst'):.3f}", f"{_of_paper('c1'):.2f}", f"{_of_paper('c2'):.2f}", "",
    )]  # fmt: skip
    for variant in variants(options):
        if variant.preset != preset:
            continue
        closed_loop = mean_ratio(loops[variant], loops[PRESETS[TUNED]])
        settled: tuple[str, ...] = ("", "", "")  # total, J_dev and J_cst, if it was run until it has converged
        if (variant, SETTLED) in found.sums:
            parts = (found.over_converged(part, variant, SETTLED, None).brief() for part in ("J_dev", "J_cst"))
            settled = found.interval(variant, SETTLED).brief(4), *parts
        rows.append((
            variant.change or f"**{preset}**",
            found.interval(variant, NOMINAL).brief(4), *settled,
            found.mean("c1", variant, NOMINAL).brief(), found.mean("c2", variant, NOMINAL).brief(),
            closed_loop.brief(4),
        ))  # fmt: skip
    caption = (
        f"**{preset}** and one change at a time. Total cost over the lowest at P = 1 and 10; J_dev and J_cst at P = 10 "
        f"over those of converged qpOASES; c1 and c2 at P = 1, means over {len(found.loads)} draws; J_BF at 5 s and "
        f"P = 1 over that of `tuned`, geometric mean of {len(_closed_loads(options))} draws. In brackets 95 % "
        "intervals over the draws. The paper's total is over its converged qpOASES, its J_dev and J_cst "
        "at P = 1."
    )
    header = ("change", "total, P = 1", "total, P = 10", "J_dev", "J_cst", "c1", "c2", "J_BF")
    return markdown_table(header, rows, caption)


def misfit(ours: Series, theirs: Series) -> float:
    """Return the root mean square of ln(ours / theirs)."""
    return float(np.sqrt(np.mean(np.log(ours / theirs) ** 2)))


def _start_table(options: StudyOptions, found: Paired) -> list[str]:
    """Return how the cost comes down with P for each start, beside the paper's; nothing if only one start was run."""
    starts = [one for one in variants(options) if one.is_start or not one.change]
    if not any(one.is_start for one in starts):
        return []
    points = drawing.published_comparison()["ode"]
    theirs = points["J_total"] / points["J_total"][-1]
    some = list(START_POWERS)
    places = [int(np.argmin(np.abs(points["normalized_power"] - power))) for power in some]
    rows: list[tuple[Cell, ...]] = [("the paper's points", *(f"{theirs[place]:.3f}" for place in places), "")]
    for variant in starts:
        every = list(range(len(found.loads)))

        def curve(which: Sequence[int], variant: PenaltyVariant = variant) -> Series:
            base = found.over_lowest(PRESETS[variant.preset], SETTLED, which)
            return np.array([found.over_lowest(variant, power, which) / base for power in some])

        def off(which: Sequence[int], curve: Callable[[Sequence[int]], Series] = curve) -> float:
            return misfit(curve(which), theirs[places])

        distance = jackknife(off, len(found.loads), above=0.0)
        rows.append((variant.label, *(f"{value:.3f}" for value in curve(every)), distance.brief()))
    caption = (
        "**Starts**: total cost at few iterations over that of the same preset at P = 10, all draws together, and how "
        "far that is from the paper's points, over theirs at P = 25: root mean square of the logarithm of the ratio."
    )
    return [markdown_table(("start", *(f"P = {p:g}" for p in some), "misfit"), rows, caption)]


def _figure(found: Paired) -> Figure:
    """Draw by which share total costs are above the lowest, against power, and the paper's above its converged one."""
    points = drawing.published_comparison()
    converged = points["qpoases"]["J_total"][-1]
    with panels(1, 1, 3.2) as (figure, (place,)):
        for variant in (None, *PRESETS.values()):
            label = variant.label if variant else QPOASES
            powers = found.powers[variant]
            above_lowest(place, powers, [found.interval(variant, power) for power in powers], COLOURS[label], label)
        for solver, label in (("qpoases", QPOASES), ("ode", AS_PRINTED)):
            total = np.maximum(points[solver]["J_total"] / converged - 1.0, drawing.LEAST_DRAWN)
            name = "qpOASES" if solver == "qpoases" else "ODE"
            paper(place, points[solver]["normalized_power"], total, COLOURS[label], f"{name}, paper")
        legend_outside(figure, place, 5)
    return figure
