"""The picture of a run under chaos."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from coldloop.number_text import ends_text
from coldloop.process.declaration import Process
from coldloop.process.sections import Input
from coldloop.registers.control_plc import Mode
from coldloop.whole_file import whole_file
from coldloop_optimizer_plc.qp.design import ControlDesign
from coldloop_rig.chaos.trace import ChaosTrace
from coldloop_rig.figures.plot import (
    ACCENT,
    BAND,
    INK,
    THIRD,
    Series,
    label_marks,
    legend_above,
    styled,
    view,
    with_unit,
)
from coldloop_rig.figures.plot import (
    COLOURS as PLAIN,
)
from coldloop_rig.results.recording import Recording

COLOURS: Final = {
    Mode.MPC: INK, Mode.REST: "#7f9cb8", Mode.HOLD: "#d9a441", Mode.CLASSICAL: ACCENT, Mode.MANUAL: THIRD,
}  # fmt: skip
MANY: Final = 24
"""More faults than this are marked, but not named."""


def plot_chaos(path: Path, trace: ChaosTrace, undisturbed: Recording, design: ControlDesign, title: str) -> None:
    """Draw outputs with their bands and without faults, inputs, and modes, with the faults marked (PNG)."""
    process = trace.process
    minutes = np.arange(trace.ticks) * process.tick_s / 60
    recording = trace.recording()
    bands = list(zip(design.output_low, design.output_high, strict=True))
    with styled({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False}):
        figure = Figure(figsize=(10, 10), layout="constrained")
        units = _inputs_by_unit(process)
        *panels, ribbon = figure.subplots(
            len(bands) + len(units) + 1, 1, sharex=True, height_ratios=[*[3] * (len(bands) + len(units)), 1]
        )
        axes: list[Axes] = panels
        controlled = zip(process.controlled, process.banded, bands, strict=True)
        for place, (output, one, band) in zip(axes, controlled, strict=False):
            place.axhspan(*band, color=BAND, alpha=0.35, label=f"band {ends_text(*band)}")
            place.plot(minutes, undisturbed.y[:, output], color=THIRD, linewidth=0.8, label="undisturbed")
            place.plot(minutes, recording.y[:, output], color=INK, linewidth=1, label="with faults")
            place.set_ylabel(with_unit(one.name, one.unit))
            legend_above(place)
        for place, inputs in zip(axes[len(bands) :], units.values(), strict=True):
            _inputs(place, [process.inputs[i] for i in inputs], minutes, recording.u[:, inputs])
        _modes(ribbon, trace)
        for place in axes:
            _mark_faults(place, trace)
        _name_faults(axes[0], trace)
        ribbon.set_xlabel("time (min)")
        ribbon.set_xlim(0, trace.ticks * process.tick_s / 60)
        label_marks(figure)
        figure.suptitle(title)
        whole_file(path, lambda draft: figure.savefig(draft, dpi=130, format="png"))


def _inputs_by_unit(process: Process) -> dict[str, list[int]]:
    """Return which inputs have each unit: they share a panel."""
    found: dict[str, list[int]] = {}
    for place, unit in enumerate(process.input_units):
        found.setdefault(unit, []).append(place)
    return found


def _inputs(axes: Axes, inputs: Sequence[Input], minutes: Series, u: Series) -> None:
    for one, values, colour in zip(inputs, u.T, cycle(PLAIN), strict=False):
        axes.plot(minutes, values, color=colour, linewidth=1, label=one.name)
    axes.set_ylim(*view(u))
    axes.set_ylabel(with_unit(inputs[0].name if len(inputs) == 1 else "inputs", inputs[0].unit))
    if len(inputs) > 1:
        legend_above(axes)


def _modes(axes: Axes, trace: ChaosTrace) -> None:
    tick_s = trace.process.tick_s
    changes = [(event.tick, Mode(event.subject)) for event in trace.modes()]
    ends = [tick for tick, _ in changes[1:]] + [trace.ticks]
    for (tick, mode), end in zip(changes, ends, strict=False):
        axes.axvspan(tick * tick_s / 60, end * tick_s / 60, color=COLOURS[mode], linewidth=0)
    present = {mode for _, mode in changes}
    axes.legend(
        handles=[Patch(color=colour, label=mode.name) for mode, colour in COLOURS.items() if mode in present],
        loc="upper center", bbox_to_anchor=(0.5, -0.6), ncols=len(COLOURS), frameon=False,
    )  # fmt: skip
    axes.set_yticks([])
    axes.set_ylabel("mode")


def _mark_faults(axes: Axes, trace: ChaosTrace) -> None:
    tick_s = trace.process.tick_s
    for mark in trace.marks:
        begin, end = mark.begin * tick_s / 60, (mark.end or mark.begin) * tick_s / 60
        axes.axvline(begin, color=ACCENT, linewidth=0.8, linestyle=":")
        if end > begin:
            axes.axvspan(begin, end, color=ACCENT, alpha=0.08, linewidth=0)


def _name_faults(axes: Axes, trace: ChaosTrace) -> None:
    if len(trace.marks) > MANY:
        return
    for mark in trace.marks:
        axes.annotate(
            mark.fault.label, (mark.begin * trace.process.tick_s / 60, 1.14), xycoords=("data", "axes fraction"),
            rotation=35, ha="left", va="bottom", fontsize=7,
        )  # fmt: skip
