"""What penalties, start and devices of the ODE-based solver do to costs, to violations and to the best period."""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from coldloop_rig.figures.plot import ACCENT, INK
from coldloop_rig.studies import published
from coldloop_rig.studies.beyond.penalty_variants import (
    AS_PRINTED,
    PRESETS,
    QPOASES,
    SETTLED,
    START_POWERS,
    TUNED,
    Paired,
    PenaltyVariant,
    closed,
    closed_loads,
    hours,
    of_period,
    paired_sums,
    periods,
    requests,
    timed_variants,
    variants,
)
from coldloop_rig.studies.crossing import crossing
from coldloop_rig.studies.drawing import LEAST_DRAWN, above_lowest, legend_outside, panels, paper
from coldloop_rig.studies.intervals import jackknife, mean_ratio
from coldloop_rig.studies.paper.best_periods import PeriodCosts, period_figure, period_remarks, period_values
from coldloop_rig.studies.request import RunRequest, Series
from coldloop_rig.studies.study import Outcomes, StudyOptions, StudyResult
from coldloop_rig.text_tables import Cell, markdown_table

COLOURS: Final = {QPOASES: "#000000", TUNED: INK, AS_PRINTED: ACCENT}
NOMINAL: Final = 1.0
COLUMNS: Final = (
    "part", "load", "preset", "change", "power or period", "J_dev", "J_cst", "c1", "c2", "lowest", "J per time", "J_BF",
)  # fmt: skip


class PenaltiesStudy:
    """Both presets, and each with one thing changed at a time."""

    name = "penalties"
    title = "Penalties, start and devices of the ODE-based solver: two presets"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return all runs: paired problems, the closed loop at 5 s, fixed periods."""
        return list(requests(options))

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare the variants with the lowest cost, with converged qpOASES and with the paper's points."""
        found = paired_sums(options, outcomes)
        loops = {
            variant: np.array([outcomes[closed(load, variant)].indicators.J_BF for load in closed_loads(options)])
            for variant in variants(options)
        }
        timed = period_costs(options, outcomes)
        result = StudyResult(COLUMNS, _rows(options, found, loops, timed), {
            "total cost": _figure(found),
            "periods": period_figure(timed, list(periods(options))),
        })  # fmt: skip
        for preset, variant in PRESETS.items():
            result.values |= {
                f"{preset}: crossing in total cost": found.crossings(None, variant),
                f"{preset}: c1 at P = 1": [one.c1 for one in found.sums[variant, NOMINAL]],
                f"{preset}: c2 at P = 1": [one.c2 for one in found.sums[variant, NOMINAL]],
                **period_values(preset, timed[variant]),
            }
        result.remarks += [
            _crossing_text(found),
            *(_table(preset, options, found, loops) for preset in PRESETS),
            *_start_table(options, found),
            *period_remarks(timed, list(periods(options))),
        ]
        return result


def period_costs(options: StudyOptions, outcomes: Outcomes) -> dict[PenaltyVariant, PeriodCosts]:
    """Return the costs of fixed periods, by variant."""
    costs: dict[PenaltyVariant, PeriodCosts] = {}
    for load in hours(options):
        for variant in timed_variants(load, options):
            runs = [outcomes[of_period(load, variant, period)].indicators for period in periods(options)]
            costs.setdefault(variant, {})[load] = {
                cost: np.array([getattr(run, cost) for run in runs]) for cost in ("J_open_mean", "J_BF")
            }
    return costs


def _rows(
    options: StudyOptions,
    found: Paired,
    loops: Mapping[PenaltyVariant, Series],
    timed: Mapping[PenaltyVariant, PeriodCosts],
) -> list[tuple[Cell, ...]]:
    def names(variant: PenaltyVariant | None) -> tuple[str, str]:
        return (variant.preset, variant.change) if variant else ("", QPOASES)

    nothing = (np.nan,) * 5
    rows: list[tuple[Cell, ...]] = [
        ("paired", load.name, *names(variant), power, *sums, np.nan, np.nan)
        for (variant, power), draws in found.sums.items()
        for load, sums in zip(found.loads, draws, strict=True)
    ]
    rows += [
        ("closed", load.name, *names(variant), NOMINAL, *nothing, np.nan, float(cost))
        for variant, costs in loops.items()
        for load, cost in zip(closed_loads(options), costs, strict=True)
    ]
    rows += [
        ("period", load.name, *names(variant), period, *nothing, float(of_load["J_open_mean"][i]),
         float(of_load["J_BF"][i]))
        for variant, costs in timed.items() for load, of_load in costs.items()
        for i, period in enumerate(periods(options))
    ]  # fmt: skip
    return rows


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
    points = published.solver_comparison()
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
        rows.append((
            variant.change or f"**{preset}**",
            found.interval(variant, NOMINAL).brief(4), *_settled(found, variant),
            found.mean("c1", variant, NOMINAL).brief(), found.mean("c2", variant, NOMINAL).brief(),
            closed_loop.brief(4),
        ))  # fmt: skip
    caption = (
        f"**{preset}** and one change at a time. Total cost over the lowest at P = 1 and 10; J_dev and J_cst at P = 10 "
        f"over those of converged qpOASES; c1 and c2 at P = 1, means over {len(found.loads)} draws; J_BF at 5 s and "
        f"P = 1 over that of `tuned`, geometric mean of {len(closed_loads(options))} draws. In brackets 95 % "
        "intervals over the draws. The paper's total is over its converged qpOASES, its J_dev and J_cst "
        "at P = 1."
    )
    header = ("change", "total, P = 1", "total, P = 10", "J_dev", "J_cst", "c1", "c2", "J_BF")
    return markdown_table(header, rows, caption)


def _settled(found: Paired, variant: PenaltyVariant) -> tuple[str, str, str]:
    """Return total, J_dev and J_cst of a solver that has converged, if it was run to there."""
    if (variant, SETTLED) not in found.sums:
        return "", "", ""
    total = found.interval(variant, SETTLED).brief(4)
    dev, cst = (found.over_converged(part, variant, SETTLED, None).brief() for part in ("J_dev", "J_cst"))
    return total, dev, cst


def misfit(ours: Series, theirs: Series) -> float:
    """Return the root mean square of ln(ours / theirs)."""
    return float(np.sqrt(np.mean(np.log(ours / theirs) ** 2)))


def _start_table(options: StudyOptions, found: Paired) -> list[str]:
    """Return how the cost comes down with P for each start, beside the paper's; nothing if only one start was run."""
    starts = [one for one in variants(options) if one.is_start or not one.change]
    if not any(one.is_start for one in starts):
        return []
    points = published.solver_comparison()["ode"]
    theirs = points["J_total"] / points["J_total"][-1]
    some = list(START_POWERS)
    places = [int(np.argmin(np.abs(points["normalized_power"] - power))) for power in some]
    rows: list[tuple[Cell, ...]] = [("the paper's points", *(f"{theirs[place]:.3f}" for place in places), "")]
    for variant in starts:
        every = list(range(len(found.loads)))

        def curve(which: Sequence[int], variant: PenaltyVariant = variant) -> Series:
            base = found.over_lowest(PRESETS[variant.preset], SETTLED, which)
            return np.array([found.over_lowest(variant, power, which) / base for power in some])

        distance = jackknife(_misfit_of(curve, theirs[places]), len(found.loads), above=0.0)
        rows.append((variant.label, *(f"{value:.3f}" for value in curve(every)), distance.brief()))
    caption = (
        "**Starts**: total cost at few iterations over that of the same preset at P = 10, all draws together, and how "
        "far that is from the paper's points, over theirs at P = 25: root mean square of the logarithm of the ratio."
    )
    return [markdown_table(("start", *(f"P = {p:g}" for p in some), "misfit"), rows, caption)]


def _misfit_of(curve: Callable[[Sequence[int]], Series], theirs: Series) -> Callable[[list[int]], float]:
    return lambda which: misfit(curve(which), theirs)


def _figure(found: Paired) -> Figure:
    """Draw by which share total costs are above the lowest, against power, and the paper's above its converged one."""
    points = published.solver_comparison()
    converged = points["qpoases"]["J_total"][-1]
    with panels(1, 1, 3.2) as (figure, (place,)):
        for variant in (None, *PRESETS.values()):
            label = variant.label if variant else QPOASES
            powers = found.powers[variant]
            above_lowest(place, powers, [found.interval(variant, power) for power in powers], COLOURS[label], label)
        for solver, label in (("qpoases", QPOASES), ("ode", AS_PRINTED)):
            total = np.maximum(points[solver]["J_total"] / converged - 1.0, LEAST_DRAWN)
            name = "qpOASES" if solver == "qpoases" else "ODE"
            paper(place, points[solver]["normalized_power"], total, COLOURS[label], f"{name}, paper")
        legend_outside(figure, place, 5)
    return figure
