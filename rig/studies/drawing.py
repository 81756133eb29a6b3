"""How the figures of studies are drawn."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from coldloop.process import TICK_S
from rig.plot import ACCENT, BAND, INK, THIRD
from rig.studies.request import Outcome

COLOURS = (INK, ACCENT, THIRD, "#8a6fae", "#b08d2f", "#4d4d4d")
STYLE: Any = {
    "font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False,
    "legend.frameon": False,
}  # fmt: skip


@contextmanager
def panels(
    rows: int, columns: int, size: tuple[float, float], *, sharex: bool = False
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure with its panels, row by row."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex)
        yield figure, list(np.ravel(axes))


def spread(axes: Axes, x: ArrayLike, values: ArrayLike, colour: str, label: str) -> None:
    """Draw the mean over the draws (first axis of `values`), and the range of them behind it."""
    values = np.asarray(values, dtype=float)
    axes.plot(x, values.mean(axis=0), color=colour, marker=".", markersize=4, linewidth=1.2, label=label)
    if len(values) > 1:
        axes.fill_between(np.asarray(x), values.min(axis=0), values.max(axis=0), color=colour, alpha=0.18, linewidth=0)


def paper(axes: Axes, x: ArrayLike, y: ArrayLike, colour: str, label: str) -> None:
    """Draw points of the paper."""
    axes.plot(x, y, color=colour, linestyle=":", marker="o", markersize=4, markerfacecolor="white", linewidth=0.8,
              label=label)  # fmt: skip


def time_panels(outcomes: Sequence[tuple[str, Outcome]], bands: Sequence[tuple[float, float]]) -> Figure:
    """Draw load, cost, constrained outputs, inputs, updating period and iterations of runs under one load."""
    with panels(8, 1, (9.0, 13.0), sharex=True) as (figure, axes):
        for (label, outcome), colour in zip(outcomes, COLOURS, strict=False):
            hours = outcome.series("time_s") / 3600
            for place, name in zip(axes[1:7], ("cost", "L1", "T5", "CV155", "NCR22_A", "CV156"), strict=True):
                place.plot(hours, outcome.series(name), color=colour, linewidth=0.9, label=label)
            start = outcome.column("tick") * TICK_S / 3600
            axes[7].step(start, outcome.column("iterations"), where="post", color=colour, linewidth=0.7, label=label)
        _, first = outcomes[0]
        axes[0].plot(first.series("time_s") / 3600, first.series("load"), color=INK, linewidth=0.9)
        for place, label in zip(axes, (
            "(a) load (W)", "(b) stage cost", "(c) L1 (%)", "(d) T5 (K)", "(e) CV155 (%)", "(f) NCR22 (W)",
            "(g) CV156 (%)", "(h) iterations",
        ), strict=True):  # fmt: skip
            place.set_ylabel(label)
        axes[1].set_yscale("log")
        axes[1].set_ylim(bottom=1e-4)
        for place, band in zip(axes[2:4], bands, strict=True):
            place.axhspan(*band, color=BAND, alpha=0.3, zorder=0)
        axes[0].legend(*axes[1].get_legend_handles_labels(), loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
        axes[7].set_xlabel("time (h)")
    return figure
