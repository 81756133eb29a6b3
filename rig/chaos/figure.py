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
from coldloop.process.signals import CONTROLLED, INPUT_NAMES, INPUT_UNITS, TICK_S
from coldloop.registers.control_plc import Mode
from coldloop.whole_file import whole_file
from optimizer_plc.qp.design import ControlDesign
from rig.chaos.trace import ChaosTrace
from rig.figures.plot import (
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
from rig.figures.plot import (
    COLOURS as PLAIN,
)
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
    with styled({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False}):
        figure = Figure(figsize=(10, 10), layout="constrained")
        units = _inputs_by_unit()
        *panels, ribbon = figure.subplots(
            len(bands) + len(units) + 1, 1, sharex=True, height_ratios=[*[3] * (len(bands) + len(units)), 1]
        )
        axes: list[Axes] = panels
        labels = [with_unit(one.name, one.unit) for one in design.process.banded]
        for place, output, band, label in zip(axes[: len(bands)], CONTROLLED, bands, labels, strict=True):
            place.axhspan(*band, color=BAND, alpha=0.35, label=f"band {ends_text(*band)}")
            place.plot(minutes, undisturbed.y[:, output], color=THIRD, linewidth=0.8, label="undisturbed")
            place.plot(minutes, recording.y[:, output], color=INK, linewidth=1, label="with faults")
            place.set_ylabel(label)
            legend_above(place)
        for place, (unit, inputs) in zip(axes[len(bands) :], units.items(), strict=True):
            _inputs(place, unit, inputs, minutes, recording)
        _modes(ribbon, trace)
        for place in axes:
            _mark_faults(place, trace)
        _name_faults(axes[0], trace)
        ribbon.set_xlabel("time (min)")
        ribbon.set_xlim(0, trace.ticks * TICK_S / 60)
        label_marks(figure)
        figure.suptitle(title)
        whole_file(path, lambda draft: figure.savefig(draft, dpi=130, format="png"))


def _inputs_by_unit() -> dict[str, list[int]]:
    """Return which inputs have each unit: they share a panel."""
    found: dict[str, list[int]] = {}
    for place, unit in enumerate(INPUT_UNITS):
        found.setdefault(unit, []).append(place)
    return found


def _inputs(axes: Axes, unit: str, inputs: Sequence[int], minutes: Series, recording: Recording) -> None:
    for i, colour in zip(inputs, cycle(PLAIN), strict=False):
        axes.plot(minutes, recording.u[:, i], color=colour, linewidth=1, label=INPUT_NAMES[i])
    axes.set_ylim(*view(recording.u[:, inputs]))
    axes.set_ylabel(with_unit(INPUT_NAMES[inputs[0]] if len(inputs) == 1 else "inputs", unit))
    if len(inputs) > 1:
        legend_above(axes)


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
