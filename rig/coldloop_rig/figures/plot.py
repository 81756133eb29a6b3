"""Figures of recorded runs as PNG, PDF or SVG, in the manner of the paper's time figures, and as an HTML page."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from io import BytesIO
from itertools import cycle
from pathlib import Path
from string import ascii_letters
from threading import RLock
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import ScalarFormatter
from numpy.typing import NDArray

from coldloop import errors, text
from coldloop.process import cold_box, declaration, sections
from coldloop_rig.results import recording, run_folder
from coldloop_rig.results.columns import STATION, excess_keys
from coldloop_rig.text_tables import aligned

Series = NDArray[np.floating]

INK, ACCENT, THIRD, BAND = "#0072b2", "#d55e00", "#009e73", "#b8c4ce"
COLOURS: Final = (INK, ACCENT, THIRD, "#cc79a7", "#e69f00", "#000000")
"""Colours of curves that share a panel (Okabe and Ito, which people with colour blindness can distinguish)."""
DASHES: Final = dict(zip(COLOURS, ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2))), strict=True))
"""Line styles of the same curves, for pages printed without colours."""
MODE_COLOURS: Final = {"mpc": INK, "rest": "#56b4e9", "hold": "#e69f00", "classical": ACCENT, "manual": THIRD}
STYLE: Final[Any] = {
    "font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False,
    "legend.frameon": False, "legend.fontsize": 8, "svg.hashsalt": "coldloop", "axes.formatter.useoffset": False,
    "pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "none",  # text that journals take and editors find
}  # fmt: skip


def with_unit(name: str, unit: str) -> str:
    """Return the label of an axis."""
    return f"{name} ({unit})" if unit else name


@cache
def labels_of(process: declaration.Process) -> Mapping[str, str]:
    """Return the columns of the trace that are drawn, in their order, with the labels of their axes."""
    load = {process.load.column: with_unit(process.load.title, process.load.unit)} if process.has_load else {}
    signals: tuple[sections.Input | sections.Output, ...] = (
        *process.measured_disturbances,
        *process.banded,
        *process.inputs,
    )
    named = {one.name: with_unit(one.name, one.unit) for one in signals}
    return {**load, **named, "tau_u_s": "tau_u (s)", "stage_cost": "stage cost (1)"}


@contextmanager
def styled(style: Any = STYLE) -> Iterator[None]:  # noqa: ANN401 parameters of matplotlib
    """Draw in a style within the context; matplotlib has one style at a time for all threads."""
    with _STYLED, mpl.rc_context(style):
        yield


_STYLED: Final = RLock()
NOT_CURVES: Final = ("tau_u_s", "stage_cost")
"""The last of these columns, which are drawn in their own ways."""
LEAST_COST: Final = 1e-6
"""Least stage cost that is drawn: at steady state the cost is rounding."""
SMOOTHING_S: Final = 60.0
"""Window of the mean of tau_u: adaptive periods change at nearly every update."""
PANELS: Final = {"left": 0.083, "right": 0.993, "top": 0.962, "bottom": 0.048, "hspace": 0.3}
"""Places of the panels, in shares of the figure. Matplotlib's layout engine would draw the figure three times more."""
LABEL_AT: Final = -0.068
"""Place of letters and labels of panels, in widths of a panel: beside numbers of six characters."""


Edges = Mapping[str, tuple[float, float]]
"""Bands of the outputs and limits of the inputs: lowest and highest value, by column."""


def edges_of(configuration: Mapping[str, Any], process: declaration.Process) -> Edges:
    """Return the bands and limits of a configuration by dotted key."""
    found: dict[str, tuple[float, float]] = {}
    names = tuple(one.name for one in process.banded)
    for columns, key in ((names, "optimizer_plc.program.design.output_"), (process.input_names, "limits.")):
        pairs = zip(configuration[f"{key}low"], configuration[f"{key}high"], strict=True)
        found |= dict(zip(columns, pairs, strict=True))
    return found


class RunCurves(NamedTuple):
    """Curves, events and texts of the figure of a run."""

    process: declaration.Process
    series: Mapping[str, Series]
    """`time_s` and the columns of `labels_of`."""
    events: Sequence[Mapping[str, Any]]
    edges: Edges
    title: str
    identity: str
    """Identity of the run: a line below the figure."""
    pressures: Mapping[str, tuple[float, float]] = {}
    """Alarm limits (bar) of each of the station's pressures in `series`; empty without a station."""


def draw_run(curves: RunCurves) -> Figure:
    """Return load, disturbances, outputs with their bands, inputs with their bounds, tau_u, cost, modes and alarms."""
    scale_s, unit = time_unit(curves.series["time_s"])
    time = curves.series["time_s"] / scale_s
    process, labels = curves.process, labels_of(curves.process)
    heights = [1.0] * (len(labels) + len(curves.pressures)) + ([0.45] if curves.events else [])
    units = {one.name: one.unit for one in process.outputs} | {one.name: one.unit for one in process.inputs}
    with styled():
        figure = Figure(figsize=(9.5, 13.5 + 1.6 * (len(labels) + len(curves.pressures) - 8)))
        panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, gridspec_kw=PANELS)
        axes: list[Axes] = list(panels)
        for place, (name, label) in zip(axes, labels.items(), strict=False):
            if name not in NOT_CURVES:
                word = process.load.name if name == process.load.column else name
                place.plot(time, curves.series[name], color=INK, linewidth=1, label=word, drawstyle="steps-post")
                place.set_ylabel(label)
            if (edges := curves.edges.get(name)) is not None:
                what = "bounds" if name in process.input_names else "band"
                limit(place, curves.series[name], edges, f"{what} {text.ends_text(*edges)} {units[name]}".rstrip())
        behind = len(labels) - len(NOT_CURVES)
        for place, (name, ends) in zip(axes[behind:], curves.pressures.items(), strict=False):
            place.plot(time, curves.series[name], color=INK, linewidth=1, label=name, drawstyle="steps-post")
            place.set_ylabel(f"{name} (bar)")
            limit(place, curves.series[name], ends, f"no alarm from {text.ends_text(*ends)} bar")
        behind += len(curves.pressures)
        place, tau_u = axes[behind], curves.series["tau_u_s"]
        place.set_ylabel("tau_u (s)")
        place.set_ylim(0, process.sampling_period_s + 0.3)
        if np.isnan(tau_u).all():
            place.text(0.5, 0.5, "no updates", transform=place.transAxes, ha="center", va="center", color=ACCENT)
        else:
            draw_tau_u(place, time, tau_u, curves.series["time_s"], INK, "tau_u")
        place, cost = axes[behind + 1], curves.series["stage_cost"]
        place.plot(time, np.maximum(cost, LEAST_COST), color=INK, linewidth=1, label="stage cost")
        place.set_ylabel("stage cost (1)")
        if spans_a_decade(cost):
            place.set_yscale("log")
        if curves.events:
            _ribbons(axes[-1], curves.events, scale_s, float(time[-1]))
        for place, letter in zip(axes, ascii_letters, strict=False):
            legend_above(place)
            place.text(LABEL_AT, 1.03, f"({letter})", transform=place.transAxes, fontsize=8, ha="center")
            place.yaxis.set_label_coords(LABEL_AT, 0.5)
        label_marks(figure)
        axes[-1].set_xlabel(f"plant time ({unit})")
        axes[-1].set_xlim(float(time[0]), float(time[-1]) if len(time) > 1 else float(time[0]) + 1)
        figure.suptitle(curves.title, y=0.99)
        figure.supxlabel(curves.identity, y=0.004, fontsize=6.5, color="#5a6672")
    return figure


class MarkLabels(ScalarFormatter):
    """Labels of a linear axis: as many digits as the step of its marks needs."""

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """Return the labels of the marks."""
        return text.axis_labels(values)


def label_marks(figure: Figure) -> None:
    """Give the marks of all linear axes without words their labels."""
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        if isinstance(axis.get_major_formatter(), ScalarFormatter):
            axis.set_major_formatter(MarkLabels())


def time_unit(time_s: Series) -> tuple[float, str]:
    """Return the length (s) and the name of the unit that suits a time axis."""
    span = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    if span >= 2 * 3600:
        return 3600.0, "h"
    return (60.0, "min") if span >= 180 else (1.0, "s")


def legend_above(axes: Axes) -> None:
    """Put the legend above the panel, where it covers no curve."""
    handles, _ = axes.get_legend_handles_labels()
    if handles and axes.get_legend() is None:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=len(handles), borderaxespad=0.1)


def limit(axes: Axes, values: Series, limits: tuple[float, float], label: str) -> None:
    """Draw a band or bounds; the values decide the scale, and an edge that is far from them stays outside."""
    low, high = view_with_limits(values, limits)
    out_of_view = [edge for edge in limits if not low <= edge <= high]
    note = " (edges outside the view)" if len(out_of_view) == 2 else ""
    is_seen = limits[0] < high and limits[1] > low
    axes.axhspan(*limits, color=BAND, alpha=0.3, linewidth=0, label=label + note if is_seen else None)
    for edge in limits:
        axes.axhline(edge, color=ACCENT, linewidth=0.8, linestyle="--")
    axes.set_ylim(low, high)


def view_with_limits(values: Series, limits: tuple[float, float]) -> tuple[float, float]:
    """Return the scale that shows the values, and those of the limits that are not far from them."""
    low, high = view(values)
    span = high - low
    return (
        min(low, limits[0] - 0.06 * span) if low - span < limits[0] else low,
        max(high, limits[1] + 0.06 * span) if high + span > limits[1] else high,
    )


def view(values: Series) -> tuple[float, float]:
    """Return the scale that shows the values: their range and a margin, of 0.1 % at least."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    margin = max(0.08 * (high - low), 1e-3 * max(abs(low), abs(high)), 1e-6)
    return low - margin, high + margin


def draw_tau_u(axes: Axes, time: Series, tau_u: Series, time_s: Series, colour: str, label: str) -> None:
    """Draw the updating period at these times as steps; where it chatters, also its mean over a minute."""
    changes = int(np.count_nonzero(np.diff(np.nan_to_num(tau_u))))
    chatters = changes > 100
    axes.plot(time, tau_u, color=colour, linewidth=0.5 if chatters else 1.0, alpha=0.45 if chatters else 1.0,
              drawstyle="steps-post", label=label)  # fmt: skip
    if chatters:
        step = float(np.median(np.diff(time_s))) or 1.0
        mean = np.where(np.isfinite(tau_u), moving_mean(tau_u, max(1, round(SMOOTHING_S / step))), np.nan)
        axes.plot(time, mean, color=colour, linewidth=1.3, label=f"{label}, mean over {SMOOTHING_S:g} s")


def moving_mean(values: Series, window: int) -> Series:
    """Return the mean over a centred window of so many values, which is cut off at the ends; NaN does not count."""
    known = np.isfinite(values)
    kernel = np.ones(min(window, len(values)))
    count = np.convolve(known, kernel, "same")
    total = np.convolve(np.where(known, values, 0.0), kernel, "same")
    mean: Series = np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0.5)
    return mean


def spans_a_decade(cost: Series) -> bool:
    """Return whether a cost needs a logarithmic axis."""
    finite = cost[np.isfinite(cost)]
    return bool(len(finite)) and float(finite.max()) > 10 * max(float(finite.min()), LEAST_COST)


def _ribbons(axes: Axes, events: Sequence[Mapping[str, Any]], scale_s: float, end: float) -> None:
    """Draw the operating mode as a ribbon, and the active alarms below it."""
    modes = [(event["time_s"] / scale_s, event["subject"]) for event in events if event["kind"] == "mode"]
    ends = [time for time, _ in modes[1:]] + [end]
    for (begin, mode), until in zip(modes, ends, strict=False):
        axes.broken_barh([(begin, max(until - begin, 0.0))], (0.55, 0.4), color=MODE_COLOURS.get(mode, BAND))
    for begin, until in alarm_times(events, scale_s, end):
        axes.broken_barh([(begin, until - begin)], (0.05, 0.4), color="#b3261e", alpha=0.5)
    seen = {mode for (begin, mode), until in zip(modes, ends, strict=False) if until - begin > end / 2000}
    present = [Patch(color=colour, label=mode) for mode, colour in MODE_COLOURS.items() if mode in seen]
    axes.set_yticks([0.25, 0.75], ["alarms", "mode"])
    axes.set_ylim(0, 1)
    axes.grid(visible=False)
    axes.legend(handles=present, loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=5, borderaxespad=0.1)


def alarm_times(events: Sequence[Mapping[str, Any]], scale_s: float, end: float) -> list[tuple[float, float]]:
    """Return when each alarm was active."""
    active: dict[str, float] = {}
    times = []
    for event in events:
        time = event["time_s"] / scale_s
        if event["kind"] == "alarm raised":
            active.setdefault(event["subject"], time)
        elif event["kind"] == "alarm returned" and event["subject"] in active:
            times.append((active.pop(event["subject"]), time))
    return times + [(begin, end) for begin in active.values()]


DPI: Final = 130


def plot_run(folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw the run of a folder; return the files, `run.png` for the format png.

    Raises:
        OSError: A file cannot be written.
        UsageError: There is no run in the folder.
    """
    figure = draw_run(curves_of(run_folder.RunFolder(folder)))
    paths = [folder / f"run.{extension}" for extension in formats]
    for path in paths:
        save_figure(figure, path)
    return paths


def draw_nothing() -> None:
    """Draw one tick into memory: fonts, and what else the first figure of a process needs, are loaded then."""
    series = {name: np.zeros(1) for name in ("time_s", *labels_of(cold_box.COLD_BOX))}
    draw_run(RunCurves(cold_box.COLD_BOX, series, [], {"L1": (0.0, 1.0)}, "", "")).savefig(BytesIO(), dpi=DPI)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's name; nothing in it depends on the time of day."""
    extension = path.suffix.removeprefix(".")
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(extension)
    dpi = max(DPI, 900 / figure.get_figwidth())  # so many pixels across where it is narrow on paper
    with styled():
        text.whole_file(path, lambda draft: figure.savefig(draft, dpi=dpi, format=extension, metadata=metadata))


def curves_of(run: run_folder.RunFolder) -> RunCurves:
    """Return what is drawn of a run."""
    pressures = pressure_limits(run.configuration) if (run.path / STATION).exists() else {}
    process, configuration = run.process, run.configuration
    series = run.series([*labels_of(process)])
    if pressures:
        series |= at_times(run.series(list(pressures), file_name=STATION), series["time_s"])
    edges, title = edges_of(configuration, process), title_of(configuration, process, run.manifest["way"])
    return RunCurves(process, series, run.events(), edges, title, identity_of(run.manifest), pressures)


def pressure_limits(configuration: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return the pressures of a station with the limits of their alarms, bar."""
    alarms = "plant.station.alarms."
    return {
        name: (float(configuration[f"{alarms}{side}_low_bar"]), float(configuration[f"{alarms}{side}_high_bar"]))
        for name, side in (("P12", "hp"), ("P11", "lp"))
    }


def at_times(series: run_folder.Curves, times_s: NDArray[np.float64]) -> run_folder.Curves:
    """Return the curves of a file at the times of another one."""
    known = series["time_s"]
    return {n: np.interp(times_s, known, curve, np.nan, np.nan) for n, curve in series.items() if n != "time_s"}


def title_of(configuration: Mapping[str, Any], process: declaration.Process, way: str = "") -> str:
    """Return what a run was, in a few words; of a session that was recorded, the load is not known by name."""
    named = f"load {Path(configuration['plant.load']).name}" if process.has_load else process.name
    load = "session under way" if way == recording.Way.RECORDED else named
    if configuration["control_plc.driver"] == "classical":
        return f"{load}, classical loops"
    period = configuration["optimizer_plc.program.updating_period_s"]
    updating = f"tau_u {period:g} s" if period else "tau_u adaptive"
    solver = configuration.get("optimizer_plc.program.outside.solver") or configuration["optimizer_plc.program.solver"]
    return f"{load}, solver {solver}, {updating}"


def identity_of(manifest: Mapping[str, Any]) -> str:
    """Return which run it was: trace, version, start, way; and whether it is complete."""
    trace = manifest["hashes"]["trace_sha256"] or ""
    parts = [
        f"trace {trace[:12]}", f"coldloop {manifest['coldloop']}", manifest["started_utc"], manifest["way"],
        f"model {manifest['hashes']['model_sha256'][:12]}",
    ]  # fmt: skip
    if not manifest["complete"]:
        parts.append(f"INCOMPLETE, {manifest['recorded_ticks']} of {manifest['ticks']} ticks: {manifest['reason']}")
    return "  ·  ".join(parts)


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
    runs = [run_folder.RunFolder(path) for path in paths]
    process = runs[0].process
    for run in runs:
        if labels_of(run.process) != labels_of(process):
            raise errors.UsageError(
                f"{run.path}: a run of {run.process.name}, and not of {process.name}; compare runs of one"
            )
    names = [path.resolve().name for path in paths]
    labels = names if len(set(names)) == len(names) else [str(path) for path in paths]
    with run_folder.writing(out):
        save_figure(_draw_comparison(runs, labels), out)
    summaries, rows = [run.summary for run in runs], [["", *labels]]
    shares = (f"{one.name}_outside_band_pct" for one in process.banded)
    figures = (*FIGURES, *shares, *excess_keys(process), "deadline_misses", "trace_sha256")
    rows += [[name, *(_cell(summary.get(name)) for summary in summaries)] for name in figures]
    keys = sorted({key for run in runs for key in run.configuration})
    different = [key for key in keys if len({repr(run.configuration.get(key)) for run in runs}) > 1]
    rows += [[key, *(_cell(run.configuration.get(key)) for run in runs)] for key in different]
    return f"{aligned(rows, numbers=True)}figure in {out}\n"


def _cell(value: Any) -> str:  # noqa: ANN401 a value of a JSON document
    if value is None:
        return "-"
    if isinstance(value, float):
        return text.number_text(value, 5)
    return f"{value[:12]}" if isinstance(value, str) and len(value) == 64 else str(value)


def _draw_comparison(runs: Sequence[run_folder.RunFolder], labels: Sequence[str]) -> Figure:
    named = labels_of(runs[0].process)
    curves = [run.series([*named]) for run in runs]
    scale_s, unit = time_unit(max((one["time_s"] for one in curves), key=lambda times: float(times[-1])))
    with styled():
        figure = Figure(figsize=(9.5, 13), layout="constrained")
        axes: dict[str, Axes] = dict(zip(named, figure.subplots(len(named), 1, sharex=True), strict=True))
        for one, label, colour in zip(curves, labels, cycle(COLOURS), strict=False):
            for name, place in axes.items():
                if name == "tau_u_s":
                    draw_tau_u(place, one["time_s"] / scale_s, one[name], one["time_s"], colour, label)
                else:
                    place.plot(one["time_s"] / scale_s, one[name], color=colour, linewidth=0.9, label=label)
        process = runs[0].process
        for name, edges in edges_of(runs[0].configuration, process).items():
            what = "bounds" if name in process.input_names else "band"
            limit(axes[name], np.concatenate([one[name] for one in curves]), edges, f"{what} {text.ends_text(*edges)}")
        axes["tau_u_s"].set_ylim(0, process.sampling_period_s + 0.3)
        axes["stage_cost"].set_yscale("log")
        axes["stage_cost"].set_ylim(bottom=LEAST_COST)
        for name, label in named.items():
            axes[name].set_ylabel(label)
            legend_above(axes[name])
        label_marks(figure)
        axes["stage_cost"].set_xlabel(f"plant time ({unit})")
        axes["stage_cost"].set_xlim(0, max(float(one["time_s"][-1]) for one in curves) / scale_s)
        figure.align_ylabels(list(axes.values()))
        figure.suptitle("  ·  ".join(labels))
    return figure


PAGE_TICKS: Final = 20_000
"""A longer trace is reduced, so that the page stays small and quick."""


def run_page(folder: Path) -> str:
    """Return the run in a folder as one HTML page with interactive plots, which holds all that it needs.

    Raises:
        UsageError: There is no run.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415 an extra
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 an extra

    run = run_folder.RunFolder(folder)
    manifest = run.manifest
    environment = Environment(
        loader=PackageLoader("coldloop_rig", "figures"), autoescape=True, trim_blocks=True, undefined=StrictUndefined
    )
    environment.filters["shown"] = _shown
    return environment.get_template("run.html.j2").render(
        title=f"Coldloop: {title_of(run.configuration, run.process, manifest['way'])}",
        identity=identity_of(manifest),
        manifest=manifest,
        summary=run.summary,
        events=run.events(),
        most=500,
        versions={name: manifest[name] for name in ("coldloop", "python", "platform")} | manifest["dependencies"],
        reduced=manifest["recorded_ticks"] > PAGE_TICKS,
        library=get_plotlyjs(),
        plot=_plots(run),
    )


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value is None else text.number_text(value, 6) if isinstance(value, float) else str(value)


def _plots(run: run_folder.RunFolder) -> str:
    """Return the curves as an HTML element."""
    from plotly.graph_objects import Scattergl  # noqa: PLC0415 an extra
    from plotly.subplots import make_subplots  # noqa: PLC0415 an extra

    process, labels = run.process, labels_of(run.process)
    curves, edges = run.series([*labels], PAGE_TICKS), edges_of(run.configuration, process)
    scale_s, unit = time_unit(curves["time_s"])
    figure = make_subplots(rows=len(labels), cols=1, shared_xaxes=True, vertical_spacing=0.02)
    for row, (name, label) in enumerate(labels.items(), start=1):
        values, axis = curves[name].astype("float32"), dict[str, Any]()
        if name == "stage_cost" and spans_a_decade(values):
            values, axis = values.clip(min=LEAST_COST), {"type": "log", "exponentformat": "power", "dtick": 2}
        elif name == "tau_u_s":
            axis = {"range": (0, process.sampling_period_s + 0.3)}
        else:  # edges that are far from the curve are outside the view
            axis = {"range": view_with_limits(curves[name], edges[name]) if name in edges else view(values)}
        line = {"color": INK, "width": 1.2, "shape": "hv" if name in (process.load.column, "tau_u_s") else "linear"}
        curve = Scattergl(x=curves["time_s"] / scale_s, y=values, name=name, mode="lines", line=line)
        figure.add_trace(curve, row=row, col=1)
        figure.update_yaxes(**axis, title_text=label, row=row, col=1)
        if name in edges:
            low, high = edges[name]
            figure.add_hrect(y0=low, y1=high, fillcolor=BAND, opacity=0.2, line_width=0, row=row, col=1)
            for edge in (low, high):
                figure.add_hline(y=edge, line={"color": ACCENT, "width": 1, "dash": "dash"}, row=row, col=1)
    if len(curves["time_s"]):
        for begin, end in alarm_times(run.events(), scale_s, float(curves["time_s"][-1]) / scale_s):
            figure.add_vrect(x0=begin, x1=end, fillcolor="#b3261e", opacity=0.12, line_width=0)
    figure.update_xaxes(title_text=f"plant time ({unit})", row=len(labels), col=1)
    figure.update_yaxes(exponentformat="e", minexponent=7)  # by itself it writes 150k
    figure.update_layout(
        height=190 * len(labels), template="plotly_white", hovermode="x", margin={"l": 70, "r": 20, "t": 20, "b": 50},
        showlegend=False,
    )  # fmt: skip
    html: str = figure.to_html(full_html=False, include_plotlyjs=False, config={"displaylogo": False})
    return html
