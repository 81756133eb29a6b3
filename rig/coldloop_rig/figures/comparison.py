"""Several recorded runs side by side: indicators, what differs in their configuration, and their curves."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coldloop.errors import UsageError
from coldloop.number_text import ends_text, number_text
from coldloop_rig.figures.plot import (
    COLOURS,
    Bounds,
    draw_tau_u,
    label_marks,
    labels_of,
    legend_above,
    limit,
    styled,
    time_unit,
)
from coldloop_rig.figures.run_plot import save_figure
from coldloop_rig.results.folders import writing
from coldloop_rig.results.indicators import excess_keys
from coldloop_rig.results.run_folder import Curves, RunFolder
from coldloop_rig.text_tables import aligned

FIGURES: Final = (
    "complete", "ticks", "updates", "J_BF", "J_open_mean", "J_dev", "J_cst", "c1", "c2", "tau_u_mean",
    "tau_u_mean_per_update", "iterations_total",
)  # fmt: skip


def compare(paths: Sequence[Path], out: Path) -> str:
    """Draw the runs over each other; return their table as text.

    Raises:
        UsageError: A folder has no run, or one of another process.
        ResultsError: The figure cannot be written.
    """
    runs = [RunFolder(path) for path in paths]
    process = runs[0].process
    for run in runs:
        if labels_of(run.process) != labels_of(process):
            raise UsageError(f"{run.path}: a run of {run.process.name}, and not of {process.name}; compare runs of one")
    labels = _labels(paths)
    with writing(out):
        save_figure(draw_comparison(runs, labels), out)
    return comparison_table(runs, labels) + f"figure in {out}\n"


def _labels(paths: Sequence[Path]) -> list[str]:
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def comparison_table(runs: Sequence[RunFolder], labels: Sequence[str]) -> str:
    """Return the indicators, then the keys of the configuration that differ, a column a run."""
    summaries = [run.summary for run in runs]
    rows = [["", *labels]]
    process = runs[0].process
    shares = (f"{one.name}_outside_band_pct" for one in process.banded)
    figures = (*FIGURES, *shares, *excess_keys(process), "deadline_misses", "trace_sha256")
    rows += [[name, *(_cell(summary.get(name)) for summary in summaries)] for name in figures]
    keys = sorted({key for run in runs for key in run.configuration})
    different = [key for key in keys if len({repr(run.configuration.get(key)) for run in runs}) > 1]
    rows += [[key, *(_cell(run.configuration.get(key)) for run in runs)] for key in different]
    return aligned(rows, numbers=True)


def _cell(value: Any) -> str:  # noqa: ANN401 a value of a JSON document
    if value is None:
        return "-"
    if isinstance(value, float):
        return number_text(value, 5)
    return f"{value[:12]}" if isinstance(value, str) and len(value) == 64 else str(value)


def draw_comparison(runs: Sequence[RunFolder], labels: Sequence[str]) -> Figure:
    """Return the curves of the runs over each other."""
    named = labels_of(runs[0].process)
    curves = [run.series([*named]) for run in runs]
    scale_s, unit = time_unit(max((one["time_s"] for one in curves), key=lambda times: float(times[-1])))
    with styled():
        figure = Figure(figsize=(9.5, 13), layout="constrained")
        axes: dict[str, Axes] = dict(zip(named, figure.subplots(len(named), 1, sharex=True), strict=True))
        for one, label, colour in zip(curves, labels, _colours(len(runs)), strict=True):
            for name, place in axes.items():
                if name == "tau_u_s":
                    draw_tau_u(place, one["time_s"] / scale_s, one[name], one["time_s"], colour, label)
                else:
                    place.plot(one["time_s"] / scale_s, one[name], color=colour, linewidth=0.9, label=label)
        _scale(axes, runs[0], curves)
        for name, label in named.items():
            axes[name].set_ylabel(label)
            legend_above(axes[name])
        label_marks(figure)
        axes["stage_cost"].set_xlabel(f"plant time ({unit})")
        axes["stage_cost"].set_xlim(0, max(float(one["time_s"][-1]) for one in curves) / scale_s)
        figure.align_ylabels(list(axes.values()))
        figure.suptitle("  ·  ".join(labels))
    return figure


def _colours(count: int) -> list[str]:
    return [COLOURS[i % len(COLOURS)] for i in range(count)]


def _scale(axes: dict[str, Axes], first: RunFolder, curves: Sequence[Curves]) -> None:
    bounds = Bounds.of(first.configuration, first.process)
    for name, edges in {**bounds.bands, **bounds.inputs}.items():
        values = np.concatenate([one[name] for one in curves])
        limit(axes[name], values, edges, f"{'band' if name in bounds.bands else 'bounds'} {ends_text(*edges)}")
    axes["tau_u_s"].set_ylim(0, first.process.sampling_period_s + 0.3)
    axes["stage_cost"].set_yscale("log")
    axes["stage_cost"].set_ylim(bottom=1e-6)
