"""The picture of a run under chaos."""

from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from coldloop.process.signals import INPUT_NAMES, L1, T5, TICK_S
from coldloop.registers.control_plc import Mode
from coldloop.whole_file import whole_file
from optimizer_plc.qp.design import ControlDesign
from rig.chaos.trace import ChaosTrace
from rig.figures.plot import ACCENT, BAND, INK, THIRD, Series, legend_above, view
from rig.results.recording import Recording

COLOURS: Final = {
    Mode.MPC: INK, Mode.REST: "#7f9cb8", Mode.HOLD: "#d9a441", Mode.CLASSICAL: ACCENT, Mode.MANUAL: THIRD,
}  # fmt: skip
MANY: Final = 24
"""More faults than this are marked, but not named."""


def plot_chaos(path: Path, trace: ChaosTrace, undisturbed: Recording, design: ControlDesign, title: str) -> None:
    """Draw outputs with their bands and without faults, inputs, and modes, with the faults marked (PNG)."""
    minutes = np.arange(trace.ticks) * TICK_S / 60
    recording = trace.recording()
    bands = list(zip(design.output_low, design.output_high, strict=True))
    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False}):
        figure = Figure(figsize=(10, 10), layout="constrained")
        axes: list[Axes] = list(figure.subplots(5, 1, sharex=True, height_ratios=[3, 3, 3, 3, 1]))
        for place, output, band, label in zip(axes[:2], (L1, T5), bands, ("L1 (%)", "T5 (K)"), strict=True):
            place.axhspan(*band, color=BAND, alpha=0.35, label=f"band {band[0]:g} to {band[1]:g}")
            place.plot(minutes, undisturbed.y[:, output], color=THIRD, linewidth=0.8, label="undisturbed")
            place.plot(minutes, recording.y[:, output], color=INK, linewidth=1, label="with faults")
            place.set_ylabel(label)
            legend_above(place)
        _inputs(axes[2], axes[3], minutes, recording)
        _modes(axes[4], trace)
        for place in axes[:4]:
            _mark_faults(place, trace)
        _name_faults(axes[0], trace)
        axes[4].set_xlabel("time (min)")
        axes[4].set_xlim(0, trace.ticks * TICK_S / 60)
        figure.suptitle(title)
        whole_file(path, lambda draft: figure.savefig(draft, dpi=130, format="png"))


def _inputs(valves: Axes, heater: Axes, minutes: Series, recording: Recording) -> None:
    for i, colour in ((0, INK), (2, THIRD)):
        valves.plot(minutes, recording.u[:, i], color=colour, linewidth=1, label=INPUT_NAMES[i])
    valves.set_ylabel("valves (%)")
    legend_above(valves)
    heater.plot(minutes, recording.u[:, 1], color=ACCENT, linewidth=1)
    heater.set_ylim(*view(recording.u[:, 1]))
    heater.set_ylabel(f"{INPUT_NAMES[1]} (W)")


def _modes(axes: Axes, trace: ChaosTrace) -> None:
    changes = [(event.tick, Mode(event.subject)) for event in trace.modes()]
    ends = [tick for tick, _ in changes[1:]] + [trace.ticks]
    for (tick, mode), end in zip(changes, ends, strict=False):
        axes.axvspan(tick * TICK_S / 60, end * TICK_S / 60, color=COLOURS[mode], linewidth=0)
    present = {mode for _, mode in changes}
    axes.legend(
        handles=[Patch(color=colour, label=mode.name) for mode, colour in COLOURS.items() if mode in present],
        loc="upper center", bbox_to_anchor=(0.5, -0.6), ncols=len(COLOURS), frameon=False,
    )  # fmt: skip
    axes.set_yticks([])
    axes.set_ylabel("mode")


def _mark_faults(axes: Axes, trace: ChaosTrace) -> None:
    for mark in trace.marks:
        begin, end = mark.begin * TICK_S / 60, (mark.end or mark.begin) * TICK_S / 60
        axes.axvline(begin, color=ACCENT, linewidth=0.8, linestyle=":")
        if end > begin:
            axes.axvspan(begin, end, color=ACCENT, alpha=0.08, linewidth=0)


def _name_faults(axes: Axes, trace: ChaosTrace) -> None:
    if len(trace.marks) > MANY:
        return
    for mark in trace.marks:
        axes.annotate(
            mark.fault.label, (mark.begin * TICK_S / 60, 1.14), xycoords=("data", "axes fraction"),
            rotation=35, ha="left", va="bottom", fontsize=7,
        )  # fmt: skip
