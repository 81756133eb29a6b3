"""The figure of a run from its folder, as PNG, PDF or SVG."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.declaration import Process
from coldloop.whole_file import whole_file
from coldloop_rig.figures.plot import Bounds, RunCurves, draw_run, labels_of, styled
from coldloop_rig.results.columns import STATION
from coldloop_rig.results.run_folder import Curves, RunFolder
from coldloop_rig.results.way import Way

DPI: Final = 130
LEAST_PIXELS: Final = 900
"""Width of a figure that is narrow on paper."""


def plot_run(folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw the run of a folder; return the files, `run.png` for the format png.

    Raises:
        OSError: A file cannot be written.
        UsageError: There is no run in the folder.
    """
    figure = draw_run(curves_of(RunFolder(folder)))
    paths = [folder / f"run.{extension}" for extension in formats]
    for path in paths:
        save_figure(figure, path)
    return paths


def draw_nothing() -> None:
    """Draw one tick into memory: fonts, and what else the first figure of a process needs, are loaded then."""
    series, edges = {name: np.zeros(1) for name in ("time_s", *labels_of(COLD_BOX))}, {"L1": (0.0, 1.0)}
    draw_run(RunCurves(COLD_BOX, series, [], Bounds(edges, {}), "", "")).savefig(BytesIO(), dpi=DPI)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's name; nothing in it depends on the time of day."""
    extension = path.suffix.removeprefix(".")
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(extension)
    dpi = max(DPI, LEAST_PIXELS / figure.get_figwidth())
    with styled():
        whole_file(path, lambda draft: figure.savefig(draft, dpi=dpi, format=extension, metadata=metadata))


def curves_of(run: RunFolder) -> RunCurves:
    """Return what is drawn of a run."""
    pressures = pressure_limits(run.configuration) if (run.path / STATION).exists() else {}
    process = run.process
    series = run.series([*labels_of(process)])
    if pressures:
        series |= at_times(run.series(list(pressures), file_name=STATION), series["time_s"])
    return RunCurves(
        process,
        series,
        run.events(),
        Bounds.of(run.configuration, process),
        title_of(run.configuration, process, run.manifest["way"]),
        identity_of(run.manifest),
        pressures,
    )


def pressure_limits(configuration: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return the pressures of a station with the limits of their alarms, bar."""
    alarms = {
        key: float(configuration[f"plant.station.alarms.{key}_bar"])
        for key in ("hp_low", "hp_high", "lp_low", "lp_high")
    }
    return {"P12": (alarms["hp_low"], alarms["hp_high"]), "P11": (alarms["lp_low"], alarms["lp_high"])}


def at_times(series: Curves, times_s: NDArray[np.float64]) -> Curves:
    """Return the curves of a file at the times of another one."""
    known = series["time_s"]
    return {n: np.interp(times_s, known, curve, np.nan, np.nan) for n, curve in series.items() if n != "time_s"}


def title_of(configuration: Mapping[str, Any], process: Process, way: str = "") -> str:
    """Return what a run was, in a few words; of a session that was recorded, the load is not known by name."""
    named = f"load {Path(configuration['plant.load']).name}" if process.has_load else process.name
    load = "session under way" if way == Way.RECORDED else named
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
