"""The picture of a run, in the manner of the paper's time figures."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop.process import INPUT_NAMES, L1, T5, TICK_S
from optimizer_plc.design import ControlDesign
from rig.recording import Recording
from rig.results import whole_file

Series = NDArray[np.floating]

INK, ACCENT, THIRD, BAND = "#1f3b57", "#c8553d", "#5b8e7d", "#b8c4ce"


def plot_run(path: Path, recording: Recording, design: ControlDesign, title: str, cost: Series) -> None:
    """Draw load, constrained outputs with their bands, inputs, updating period and iterations, and cost (PNG)."""
    hours = np.arange(len(recording.load)) * TICK_S / 3600
    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False}):
        figure = Figure(figsize=(10, 12), layout="constrained")
        axes: list[Axes] = list(figure.subplots(6, 1, sharex=True))
        _load(axes[0], hours, recording)
        _output(axes[1], hours, recording.y[:, L1], (design.output_low[0], design.output_high[0]), "(b) L1 (%)")
        _output(axes[2], hours, recording.y[:, T5], (design.output_low[1], design.output_high[1]), "(c) T5 (K)")
        _inputs(axes[3], hours, recording)
        _updates(axes[4], recording)
        _cost(axes[5], hours, cost)
        axes[5].set_xlabel("time (h)")
        axes[5].set_xlim(0, float(hours[-1]) if len(hours) > 1 else 1)
        figure.suptitle(title)
        whole_file(path, lambda draft: figure.savefig(draft, dpi=130, format="png"))


def _load(axes: Axes, hours: Series, recording: Recording) -> None:
    axes.plot(hours, recording.load, color=INK, linewidth=1)
    axes.set_ylabel("(a) heat load (W)")


def _output(axes: Axes, hours: Series, values: Series, band: tuple[float, float], label: str) -> None:
    axes.axhspan(*band, color=BAND, alpha=0.35, label="band")
    axes.plot(hours, values, color=INK, linewidth=1)
    axes.set_ylabel(label)
    axes.legend(loc="upper right", frameon=False)


def _inputs(axes: Axes, hours: Series, recording: Recording) -> None:
    heater = axes.twinx()
    heater.grid(visible=False)
    lines = []
    for i, (name, colour) in enumerate(zip(INPUT_NAMES, (INK, ACCENT, THIRD), strict=True)):
        place = heater if i == 1 else axes
        lines += place.plot(hours, recording.u[:, i], color=colour, linewidth=1, label=name)
    axes.set_ylabel("(d) valves (%)")
    heater.set_ylabel("heater (W)")
    axes.legend(handles=lines, loc="lower right", bbox_to_anchor=(1, 0.98), frameon=False, ncols=3, borderaxespad=0)
    axes.margins(y=0.1)


def _updates(axes: Axes, recording: Recording) -> None:
    start = np.array([row.tick for row in recording.updates]) * TICK_S / 3600
    axes.step(start, [row.tau_u * TICK_S for row in recording.updates], where="post", color=INK, linewidth=0.8)
    axes.set_ylabel("(e) tau_u (s)")
    axes.set_ylim(bottom=0)
    iterations = axes.twinx()
    iterations.grid(visible=False)
    iterations.plot(start, [row.iterations for row in recording.updates], ".", color=ACCENT, markersize=1.5)
    iterations.set_ylabel("iterations q", color=ACCENT)
    iterations.set_ylim(bottom=0)


def _cost(axes: Axes, hours: Series, cost: Series) -> None:
    axes.semilogy(hours, np.maximum(cost, 1e-6), color=INK, linewidth=1)
    axes.set_ylabel("(f) instantaneous cost")
