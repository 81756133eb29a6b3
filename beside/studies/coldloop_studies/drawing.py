"""Figures of studies, and the points of the paper's figures, as far as its source holds them.

Those of the PLC's speed are in `coldloop_rig.plc_sizing.plc`.
"""

import csv
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from coldloop.process.cold_box import SAMPLING_PERIOD_S, TICK_S
from coldloop.process.settings import InputLimits
from coldloop.registers.plant import StationMode
from coldloop.text import ends_text
from coldloop_rig.figures.plot import COLOURS, DASHES, INK, STYLE, draw_tau_u, label_marks, limit, styled
from coldloop_rig.plc_sizing.intervals import Interval
from coldloop_studies import request, study

COLUMN_IN: Final = 88 / 25.4
"""Width of a column of a journal, for figures without panels side by side."""
PAGE_IN: Final = 180 / 25.4
LONGEST_NAME: Final = 28
"""Longest name of a row in a figure of one column, characters."""
JOURNAL: Final = STYLE | {"font.size": 8, "axes.titlesize": 8, "legend.fontsize": 7}


@contextmanager
def panels(rows: int, columns: int, height_in: float, *, sharex: bool = False) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure with its panels, row by row; those of a column share their x where asked to."""
    with styled(JOURNAL):
        figure = Figure(figsize=(COLUMN_IN if columns == 1 else PAGE_IN, height_in), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharex="col" if sharex else False)
        yield figure, list(np.ravel(axes))
        figure.align_ylabels()
        label_marks(figure)


def legend_outside(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """Put the legend of one panel above all panels, where it covers no curve."""
    handles, labels = axes.get_legend_handles_labels()
    most = columns if figure.get_figwidth() > COLUMN_IN else 2
    figure.legend(handles, labels, loc="outside upper center", ncols=min(most, len(labels)))


def spans_decade(values: ArrayLike) -> bool:
    """Return whether values are positive and the largest is more than ten times the smallest."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    return bool(len(finite) and finite.min() > 0 and finite.max() > 10 * finite.min())


def ratio_scale(axes: Axes, which: Literal["x", "y"], values: ArrayLike) -> None:
    """Let ratios that span a decade have a logarithmic axis, with plain marks where they span two at most."""
    found = np.ravel(values)
    found = found[np.isfinite(found) & (found > 0)]
    if not spans_decade(found):
        return
    axes.set(**{f"{which}scale": "log"})
    if found.max() < 100 * found.min():
        axis = axes.xaxis if which == "x" else axes.yaxis
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def spread(axes: Axes, x: ArrayLike, values: ArrayLike, colour: str, label: str) -> None:
    """Draw the mean over the draws (first axis of `values`), and the range of them behind it."""
    values = np.asarray(values, dtype=float)
    dashes = DASHES.get(colour, "-")
    axes.plot(x, values.mean(axis=0), color=colour, linestyle=dashes, marker=".", markersize=4, label=label)
    if len(values) > 1:
        axes.fill_between(np.asarray(x), values.min(axis=0), values.max(axis=0), color=colour, alpha=0.18, linewidth=0)


def paper(axes: Axes, x: ArrayLike, y: ArrayLike, colour: str, label: str) -> None:
    """Draw points of the paper."""
    axes.plot(x, y, color=colour, linestyle=":", marker="o", markersize=4, markerfacecolor="white", linewidth=0.8,
              label=label)  # fmt: skip


PANELS: Final = (
    ("load", "load (W)"), ("cost", "stage cost (1)"), ("L1", "L1 (%)"), ("T5", "T5 (K)"), ("CV155", "CV155 (%)"),
    ("NCR22_A", "NCR22_A (W)"), ("CV156", "CV156 (%)"), ("iterations", "iterations (1)"), ("tau_u", "tau_u (s)"),
)  # fmt: skip


def time_panels(outcomes: Sequence[tuple[str, request.Outcome]], bands: Sequence[tuple[float, float]]) -> Figure:
    """Draw load, cost, constrained outputs, inputs, iterations and updating period of runs under one load.

    The updating period is left out where all runs have the same fixed one.
    """
    periods = {period for _, outcome in outcomes for period in outcome.updates["tau_u"]}
    shown = PANELS if len(periods) > 1 else PANELS[:-1]
    with panels(len(shown), 1, 1.0 * len(shown) + 0.6, sharex=True) as (figure, axes):
        place = dict(zip((name for name, _ in shown), axes, strict=True))
        for (label, outcome), colour in zip(outcomes, COLOURS, strict=False):
            hours = outcome.series("time_s") / 3600
            for name, _ in shown[1:7]:
                place[name].plot(hours, outcome.series(name), color=colour, linestyle=DASHES[colour], linewidth=0.9,
                                 label=label)  # fmt: skip
            _updates(place, label, outcome, colour)
        _, first = outcomes[0]
        place["load"].plot(first.series("time_s") / 3600, first.series("load"), color=INK, linewidth=0.9, label="load")
        limits = InputLimits()
        edges = [*bands, *zip(limits.low, limits.high, strict=True)]
        limited = ("L1", "band"), ("T5", "band"), ("CV155", "bounds"), ("NCR22_A", "bounds"), ("CV156", "bounds")
        for (name, what), edge in zip(limited, edges, strict=True):
            together = np.concatenate([outcome.series(name) for _, outcome in outcomes])
            limit(place[name], together, edge, f"{what} {ends_text(*edge)}")
        place["cost"].set(yscale="log", ylim=(1e-4, None))
        for (name, label), letter in zip(shown, "abcdefghi", strict=False):
            place[name].set_ylabel(label)
            place[name].set_title(f"({letter})", loc="left", pad=3)
        legend_outside(figure, place["cost"])
        axes[-1].set(xlabel="plant time (h)", xlim=(0, float(first.series("time_s")[-1]) / 3600))
    return figure


def _updates(place: Mapping[str, Axes], label: str, outcome: request.Outcome, colour: str) -> None:
    """Draw what changes at updating instants, as long as it was in force: for an updating period at most."""
    start = outcome.column("tick").astype(int)
    if not len(start):
        return
    ticks = np.arange(start[0], start[-1] + 1)
    update = np.searchsorted(start, ticks, side="right") - 1
    in_force = ticks < start[update] + outcome.column("tau_u")[update]
    tau_u, iterations = (np.where(in_force, outcome.column(name)[update], np.nan) for name in ("tau_u", "iterations"))
    hours = ticks * TICK_S / 3600
    place["iterations"].step(hours, iterations, where="post", color=colour, linewidth=0.7, label=label)
    if "tau_u" in place:
        draw_tau_u(place["tau_u"], hours, tau_u * TICK_S, ticks * TICK_S, colour, label)
        place["tau_u"].set_ylim(0, SAMPLING_PERIOD_S + 0.3)


def over_time(
    title: str, runs: Sequence[tuple[str, request.Outcome]], shown: Mapping[str, str], height: float
) -> Figure:
    """Draw series of a refrigerator's runs, `shown` with their labels, over each other; a cold box has not all."""
    with panels(len(shown), 1, height, sharex=True) as (figure, axes):
        for (label, run), colour in zip(runs, COLOURS, strict=False):
            for name, place in zip(shown, axes, strict=True):
                if name in run.trace:
                    place.plot(run.series("time_s") / 60, run.series(name), color=colour, linestyle=DASHES[colour],
                               linewidth=0.9, label=label)  # fmt: skip
        for (name, label), place in zip(shown.items(), axes, strict=True):
            place.set_ylabel(label)
            if name == "mode":
                place.set_yticks(list(StationMode), [mode.name.lower().replace("_", " ") for mode in StationMode])
        axes[0].set_title(title, loc="left")
        axes[-1].set_xlabel("plant time (min)")
        legend_outside(figure, axes[0])
    return figure


def cost_bars(result: study.StudyResult, cases: Iterable[str], width: float, *, logarithmic: bool = False) -> Figure:
    """Draw J_BF of rows (load, case, J_BF, ...): a bar for each case, side by side for each load."""
    names = list(dict.fromkeys(str(row[0]) for row in result.rows))
    cases = list(cases)
    with panels(1, 1, 2.6) as (figure, (place,)):
        for number, (case, colour) in enumerate(zip(cases, COLOURS, strict=False)):
            heights = [float(row[2]) for row in result.rows if row[1] == case]
            offset = (width + 0.02) * (number - 0.5 * (len(cases) - 1))
            place.bar(np.arange(len(names)) + offset, heights, width, color=colour, label=case)
        if logarithmic:
            ratio_scale(place, "y", [float(row[2]) for row in result.rows])
        place.set_xticks(range(len(names)), names, rotation=0 if len(names) < 9 else 60)
        place.set(xlabel="load", ylabel="$J^{BF}$ (1)")
        legend_outside(figure, place)
    return figure


def ratio_rows(
    ratios: Mapping[str, Mapping[str, Interval]], label: str, height_in: float, gap: float, columns: int
) -> Figure:
    """Draw ratios with their intervals: a row for each name, in it a point for each series (the outer keys)."""
    names = list(next(iter(ratios.values())))
    with panels(1, 1, height_in) as (figure, (place,)):
        if max(map(len, names)) > LONGEST_NAME:
            figure.set_figwidth(PAGE_IN)
        for number, ((series, by_name), colour) in enumerate(zip(ratios.items(), COLOURS, strict=False)):
            rows = np.arange(len(names)) + gap * (number - 0.5 * (len(ratios) - 1))
            found = [by_name[name] for name in names]
            place.plot([one.value for one in found], rows, "o", markersize=6 if len(ratios) == 1 else 3.5, color=colour,
                       label=series)  # fmt: skip
            place.hlines(rows, [one.low for one in found], [one.high for one in found], color=colour, linewidth=0.9)
        place.axvline(1.0, color="#888888", linewidth=0.8)
        place.set_yticks(range(len(names)), names)
        place.set_ylim(len(names) - 0.5, -0.5)
        ratio_scale(place, "x", [one[:3] for by_name in ratios.values() for one in by_name.values()])
        figure.supxlabel(textwrap.fill(label, 44), fontsize=8)
        legend_outside(figure, place, columns)
    return figure


def _published(name: str, key: str) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return the numeric columns of a file, by the value of the column `key`."""
    with (Path(__file__).with_name("published") / name).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))  # noqa: TID251 ours
    groups: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(row.pop(key), []).append(row)
    return {
        group: {column: np.array([float(row[column]) for row in members]) for column in members[0]}
        for group, members in groups.items()
    }


@cache
def published_comparison() -> Mapping[str, Mapping[str, NDArray[np.float64]]]:
    """Return normalized_power, J_dev, J_cst, J_total, c1, c2 and J_BF of `ode` and `qpoases` (figure `solv_cmp`)."""
    return _published("fig_solver_comparison.csv", "solver")


@cache
def published_periods() -> Mapping[str, Mapping[str, NDArray[np.float64]]]:
    """Return tau_u_s, cost_fixed_pct and cost_adaptive_pct of the scenarios a to f (figure `tu_opt`)."""
    return _published("fig_updating_period.csv", "scenario")


LEAST_DRAWN: Final = 1e-5
"""Share above the lowest cost below which it is drawn here: the axis is logarithmic."""


def above_lowest(axes: Axes, powers: ArrayLike, totals: Sequence[Interval], colour: str, label: str) -> None:
    """Draw by which share total costs over the lowest, with intervals, are above it, against power."""
    value, low, high = np.maximum(np.transpose(totals) - 1.0, LEAST_DRAWN)
    axes.plot(powers, value, color=colour, linestyle=DASHES.get(colour, "-"), marker=".", label=label)
    axes.fill_between(np.asarray(powers), low, high, color=colour, alpha=0.18, linewidth=0)
    labels = {"xlabel": "normalised power $P$ (1)", "ylabel": "total cost over the lowest, less 1 (1)"}
    axes.set(xscale="log", yscale="log", **labels)


def hour_panels(
    names: Sequence[str], draw: Callable[[str, Axes], None], label: str, ticks: Sequence[int], columns: int = 4
) -> Figure:
    """Return a panel for each hour, drawn by `draw`: something against the updating period, with these ticks."""
    beside = min(2, len(names))
    rows = -(-len(names) // beside)
    with panels(rows, beside, 2.2 * rows + 0.5) as (figure, axes):
        for name, place in zip(names, axes, strict=False):
            draw(name, place)
            place.set_title(f"({Path(name).name})", loc="left")
            place.set_ylabel(label)
            low, high = place.get_ylim()
            if sum(low <= mark <= high for mark in ticks) > 1:  # else costs that are nearly the same: a linear axis
                place.set_yscale("log")
                place.autoscale(axis="y")  # the linear limits can lie below 0
                low, high = place.get_ylim()
                shown = [mark for mark in ticks if low <= mark <= high]
                place.set_yticks(shown, map(str, shown))
                place.minorticks_off()
        legend_outside(figure, axes[0], columns)
        for place in axes[max(0, len(names) - beside) : len(names)]:
            place.set_xlabel("updating period (s)")
        for place in axes[len(names) :]:
            place.set_visible(False)
    return figure
