"""A recorded run as one HTML page with interactive plots; the page holds all that it needs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import plotly.graph_objects as go
from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from coldloop.number_text import number_text
from coldloop.process.declaration import Process
from coldloop_rig.figures import plot
from coldloop_rig.results.run_folder import Curves, RunFolder

DRAWN_TICKS: Final = 20_000
"""A longer trace is reduced, so that the page stays small and quick."""
MOST_EVENTS: Final = 500


def run_page(folder: Path) -> str:
    """Return the page of the run in a folder. Raises UsageError if there is no run."""
    run = RunFolder(folder)
    manifest = run.manifest
    environment = Environment(
        loader=PackageLoader("coldloop_rig", "figures"), autoescape=True, trim_blocks=True, undefined=StrictUndefined
    )
    environment.filters["shown"] = _shown
    return environment.get_template("run.html.j2").render(
        title=f"Coldloop: {plot.title_of(run.configuration, run.process, manifest['way'])}",
        identity=plot.identity_of(manifest),
        manifest=manifest,
        summary=run.summary,
        events=run.events(),
        most=MOST_EVENTS,
        versions={name: manifest[name] for name in ("coldloop", "python", "platform")} | manifest["dependencies"],
        reduced=manifest["recorded_ticks"] > DRAWN_TICKS,
        library=get_plotlyjs(),
        plot=_plot(run),
    )


def _shown(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number_text(value, 6) if isinstance(value, float) else str(value)


def _plot(run: RunFolder) -> str:
    """Return the curves as an HTML element."""
    process, labels = run.process, plot.labels_of(run.process)
    curves = run.series([*labels], DRAWN_TICKS)
    scale_s, unit = plot.time_unit(curves["time_s"])
    figure = make_subplots(rows=len(labels), cols=1, shared_xaxes=True, vertical_spacing=0.02)
    for row, (name, label) in enumerate(labels.items(), start=1):
        _add_curve(figure, row, curves, name, process)
        figure.update_yaxes(title_text=label, row=row, col=1)
    bounds = plot.Bounds.of(run.configuration, process)
    _add_bounds(figure, {name: row for row, name in enumerate(labels, start=1)}, curves, bounds)
    if len(curves["time_s"]):
        for begin, end in plot.alarm_times(run.events(), scale_s, float(curves["time_s"][-1]) / scale_s):
            figure.add_vrect(x0=begin, x1=end, fillcolor="#b3261e", opacity=0.12, line_width=0)
    figure.update_xaxes(title_text=f"plant time ({unit})", row=len(labels), col=1)
    figure.update_yaxes(exponentformat="e", minexponent=7)  # by itself it writes 150k
    figure.update_layout(
        height=190 * len(labels), template="plotly_white", hovermode="x", margin={"l": 70, "r": 20, "t": 20, "b": 50},
        showlegend=False,
    )  # fmt: skip
    html: str = figure.to_html(full_html=False, include_plotlyjs=False, config={"displaylogo": False})
    return html


def _add_curve(figure: Any, row: int, curves: Curves, name: str, process: Process) -> None:  # noqa: ANN401 plotly has no types
    shape = "hv" if name in (process.load.column, "tau_u_s") else "linear"
    line = {"color": plot.INK, "width": 1.2, "shape": shape}
    values = curves[name].astype("float32")
    if name == "stage_cost" and plot.spans_a_decade(values):
        values = values.clip(min=plot.LEAST_COST)
        figure.update_yaxes(type="log", exponentformat="power", dtick=2, row=row, col=1)
    elif name == "tau_u_s":
        figure.update_yaxes(range=(0, process.sampling_period_s + 0.3), row=row, col=1)
    else:
        figure.update_yaxes(range=plot.view(values), row=row, col=1)
    scale_s, _ = plot.time_unit(curves["time_s"])
    curve = go.Scattergl(x=curves["time_s"] / scale_s, y=values, name=name, mode="lines", line=line)
    figure.add_trace(curve, row=row, col=1)


def _add_bounds(figure: Any, rows: Mapping[str, int], curves: Mapping[str, plot.Series], bounds: plot.Bounds) -> None:  # noqa: ANN401 plotly has no types
    """Draw bands and bounds; those that are far from the curve stay outside the view, until it is zoomed out."""
    edges: Mapping[str, tuple[float, float]] = {**bounds.bands, **bounds.inputs}
    for name, (low, high) in edges.items():
        figure.add_hrect(y0=low, y1=high, fillcolor=plot.BAND, opacity=0.2, line_width=0, row=rows[name], col=1)
        for edge in (low, high):
            figure.add_hline(y=edge, line={"color": plot.ACCENT, "width": 1, "dash": "dash"}, row=rows[name], col=1)
        figure.update_yaxes(range=plot.view_with_limits(curves[name], (low, high)), row=rows[name], col=1)
