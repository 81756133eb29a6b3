"""Where the best of the fixed updating periods lies, for several settings of a solver."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coldloop_rig.figures.plot import ACCENT, DASHES, INK, THIRD
from coldloop_rig.studies import published
from coldloop_rig.studies.beyond.penalty_variants import AS_PRINTED, TUNED, PenaltyVariant
from coldloop_rig.studies.drawing import hour_panels, paper
from coldloop_rig.studies.intervals import Interval, interval_of_share, mean_ratio
from coldloop_rig.studies.paper.updating_period import is_inside
from coldloop_rig.studies.request import Series
from coldloop_rig.studies.study import Load, first_and_fresh
from coldloop_rig.text_tables import Cell, markdown_table

FIRST: Final = "hours of the first draw"
COSTS: Final = {"J_open_mean": "open loop", "J_BF": "J_BF"}
PeriodCosts = dict[Load, Mapping[str, Series]]
"""By hour: costs of the periods, by kind of cost."""


def table_of(costs: PeriodCosts, some: Sequence[Load], cost: str) -> Series:
    """Return the costs of the periods in some hours, shape (hours, periods)."""
    return np.array([costs[load][cost] for load in some])


def share_inside(table: Series) -> Interval:
    """Return the share of hours, rows of `table`, whose best period is inside, with its interval over the hours."""
    return interval_of_share(sum(map(is_inside, table)), len(table))


def end_over_best(table: Series, end: int) -> Interval:
    """Return by how much the first (0) or the last (-1) period costs more than the best, geometric mean of hours."""
    return mean_ratio(table[:, end], table.min(axis=1))


def period_values(preset: str, costs: PeriodCosts) -> dict[str, list[float]]:
    """Return shares of hours with an interior best period by name."""
    return {
        f"{preset}: interior optimum, share of {title}, {name}": [share_inside(table_of(costs, some, cost)).value]
        for title, some in first_and_fresh(costs, FIRST).items()
        for cost, name in COSTS.items()
    }


def period_remarks(timed: Mapping[PenaltyVariant, PeriodCosts], periods: Sequence[float]) -> list[str]:
    """Return a table for each cost."""
    theirs = np.array([hour["cost_fixed_pct"] for hour in published.updating_period().values()])
    remarks = []
    for cost, name in COSTS.items():
        rows: list[tuple[Cell, ...]] = []
        for setting, costs in timed.items():
            for title, some in first_and_fresh(costs, FIRST).items():
                rows.append((setting.label, title, *_row(table_of(costs, some, cost), periods)))
        if cost == "J_open_mean" and theirs.shape[1] == len(periods):
            rows.insert(0, ("the paper's points", "hours a to f", *_row(theirs, periods)))
        caption = (
            f"**Best of the fixed periods, {name}**: in how many hours it is neither the shortest nor the longest, "
            "which it is in each (s), and what the shortest and the longest cost over it, geometric mean of the hours; "
            "in brackets 95 % intervals over the hours."
        )
        header = ("setting", "hours", "inside, share", "best in each hour (s)", f"{periods[0]:g} s over the best",
                  f"{periods[-1]:g} s over the best")  # fmt: skip
        remarks.append(markdown_table(header, rows, caption))
    return remarks


def _row(table: Series, periods: Sequence[float]) -> tuple[Cell, ...]:
    best = " ".join(f"{periods[place]:g}" for place in table.argmin(axis=1))
    ends = (end_over_best(table, end).brief() for end in (0, -1))
    return share_inside(table).brief(2), best, *ends


def period_figure(timed: Mapping[PenaltyVariant, PeriodCosts], periods: Sequence[float]) -> Figure:
    """Draw the first draw of each hour over its best period, both presets and the paper's points."""
    colours = {TUNED: INK, AS_PRINTED: ACCENT}
    presets = {setting: costs for setting, costs in timed.items() if not setting.change}
    names = [load.name for load in next(iter(presets.values())) if load.draw == 1]

    def draw(name: str, place: Axes) -> None:
        for setting, costs in presets.items():
            of_hour = next(of_load for load, of_load in costs.items() if load.name == name)["J_open_mean"]
            colour = colours[setting.preset]
            place.plot(periods, of_hour / of_hour.min(), color=colour, linestyle=DASHES[colour], marker=".",
                       label=setting.label)  # fmt: skip
        theirs = published.updating_period().get(name)
        if theirs:
            fixed = theirs["cost_fixed_pct"]
            paper(place, theirs["tau_u_s"], fixed / fixed.min(), THIRD, "paper")

    return hour_panels(names, draw, "cost over that of the best (1)", (1, 2, 5, 10, 20, 50))
