"""What load and other disturbances are over time, for the simulated plant and as the optimiser expects: CSV files."""

from itertools import pairwise
from pathlib import Path
from typing import Any

from coldloop.errors import UsageError
from coldloop.process.declaration import Process
from coldloop.process.sections import Disturbance, Forecast, Load
from coldloop.table import TIME, read_table


def courses_of(file: Process, folder: Path) -> dict[str, Any]:
    """Return what a model file says of the disturbances among the plant's parameters; nothing if there are none.

    Raises:
        UsageError: A course cannot be read, or leaves the span: one line.
    """
    if not file.disturbances:
        return {}
    return {"disturbances": [_course(one, folder, file.tick_s) for one in file.disturbances]}


def forecasts_of(file: Process, folder: Path) -> tuple[Forecast, ...]:
    """Return what the optimiser expects.

    Raises:
        UsageError: A forecast cannot be read, or leaves the span: one line.
    """
    return tuple(
        Forecast(name=one.name, ticks=tuple(ticks), values=tuple(values))
        for one in file.outside
        if one.forecast is not None
        for ticks, values in [_steps(one, folder / one.forecast, file.tick_s)]
    )


def _course(one: Disturbance, folder: Path, tick_s: float) -> dict[str, Any]:
    ticks, values = ([0], [one.at]) if one.course is None else _steps(one, folder / one.course, tick_s)
    return {"ticks": ticks, "values": values, "measured": one.noise is not None}


def _steps(one: Load | Disturbance, path: Path, tick_s: float) -> tuple[list[int], list[float]]:
    """Return ticks and values of a CSV file with time_s and the name of a signal."""
    wanted = (TIME, one.name)
    times, values = read_table(path, wanted, "name a CSV file beside the process file").columns(wanted)
    ticks = [round(time / tick_s) for time in times]
    if ticks[0] != 0:
        raise UsageError(f"{path}: {TIME} begins at {times[0]:g}; it begins at 0, which is when a session begins")
    at = next((at for at, (before, tick) in zip(times[1:], pairwise(ticks), strict=True) if tick <= before), None)
    if at is not None:
        raise UsageError(f"{path}: {TIME} = {at:g}: it rises by at least a tick, {tick_s:g} s, from line to line")
    low, high = one.span
    wrong = next((value for value in values if not low <= value <= high), None)
    if wrong is not None:
        raise UsageError(f"{path}: {one.name} = {wrong:g} is outside its span, {low:g} to {high:g}")
    return ticks, values
