"""Steps of each valve and of the load, and what both pressures do.

`python -m coldloop_refrigerator.pressure_steps` prints the table.

The refrigerator is at rest until the step. The controller's valves step by what is added to the openings that it asks
for, as a positioner would that is off; in open loop they stay at the operating point otherwise.
"""

import argparse
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from coldloop.process.cold_box import INPUT_NAMES, TICK_S
from coldloop_plant.helium import load_helium
from coldloop_plant.numeric import RealArray
from coldloop_plant.settings import StationControlKind, StationSettings
from coldloop_refrigerator import physics, plant_file, program, station_control

LOAD: Final = "load"
STEPS: Final = (
    ("CV956", 5.0), ("CV952", 20.0), ("CV953", 20.0), ("CV167", 10.0), ("CV155", 2.0), ("NCR22_A", 20.0),
    ("CV156", 3.0), (LOAD, 60.0), (LOAD, -60.0),
)  # fmt: skip
"""Stepped signals and the sizes of their steps: openings in %, heater and load in W."""
SETTLED_BAR: Final = (0.01, 0.001)  # High and low pressure have settled when they stay within these of their last value
AMBIENT_K: Final = 300.0
PRESSURES: Final = tuple(physics.SIGNAL_NAMES.index(name) for name in ("P12", "P11"))
BUFFER, NITROGEN = (physics.SIGNAL_NAMES.index(name) for name in ("P13", "L_N2"))
OPENINGS: Final = tuple(physics.STATE_NAMES.index(name) for name in ("CV956", "CV952", "CV953"))


class Response(NamedTuple):
    """Response of one pressure to one step."""

    peak: float  # Deviation from rest that is largest in amount, with its sign, bar
    overshoot: float  # Largest deviation to the other side after that, bar, not below 0
    settled_s: float | None  # From the step on; None: not within the time that was looked at


def response_of(deviations: RealArray, band: float, tick_s: float = TICK_S) -> Response:
    """Judge one pressure by its deviations from rest (bar) at each tick, from that of the step on.

    It has settled when it stays within `band` (bar) of the last one.
    """
    at = int(np.argmax(np.abs(deviations)))
    peak = float(deviations[at])
    overshoot = abs(float(np.max(-np.sign(peak) * deviations[at:], initial=0.0)))
    outside = np.flatnonzero(np.abs(deviations - deviations[-1]) > band)
    settled = 0 if not outside.size else int(outside[-1]) + 1
    is_over = settled < 0.9 * deviations.size  # what has only just arrived may still move
    return Response(peak, overshoot, settled * tick_s if is_over else None)


def pressures_after(
    name: str, size: float, control: StationControlKind | None, seconds: float, file: program.RefrigeratorFile
) -> RealArray:
    """Let an input, a valve of the station or `LOAD` step by a size (% or W); return both pressures, (N, 2), bar.

    Without `control` the openings stay those of the operating point.
    """
    plant, helium = plant_file.REFERENCE_REFRIGERATOR, load_helium()
    u, added = np.array(file.u0, dtype=np.float64), np.zeros(len(physics.COMMAND_NAMES))
    d = np.array([file.w0, AMBIENT_K, 0.0, 1.0, 1.0, 1.0])
    x, v = np.array(file.x0), np.array(file.v0, dtype=np.float64)
    _, _, signals = physics.evaluated(x, u, v, d, plant, helium)
    if name == LOAD:
        d[0] += size
    elif name in INPUT_NAMES:
        u[INPUT_NAMES.index(name)] += size
    else:
        added[physics.COMMAND_NAMES.index(name)] = size
    settings, memory = StationSettings(control=control or StationControlKind.LQ), np.zeros(station_control.MEMORY_SIZE)
    law = station_control.station_law(settings, file.gains, file.v0, plant.station)
    rows = np.empty((round(seconds / TICK_S), len(PRESSURES)))
    for row in rows:
        row[:] = signals[list(PRESSURES)]
        if control is not None:
            hp, lp, buffer, nitrogen = signals[[*PRESSURES, BUFFER, NITROGEN]].tolist()
            bypass, discharge, charge = x[list(OPENINGS)].tolist()
            measured = station_control.StationMeasurement(
                hp, lp, buffer, bypass, discharge, charge, nitrogen, lost=0.0, bath=1.23, nc1=True, nc2=True,
                loaded=2, turbine=True, overspeed=False, deviating=False, suction=False,
            )  # fmt: skip
            v = np.array(station_control.control_station(law, memory, measured)[0])
        opened = np.clip(v + added, 0.0, 100.0)
        x = physics.advance_refrigerator(x, u, opened, d, TICK_S, plant, helium)
        _, _, signals = physics.evaluated(x, u, opened, d, plant, helium)
    return rows


def table(seconds: float, steps: Sequence[tuple[str, float]] = STEPS) -> list[str]:
    """Return the responses to all steps in open loop, with LQ and with PI, as lines of a Markdown table."""
    file = program.read_refrigerator_file(program.SHIPPED)
    lines = [
        "| step | control | HP: peak, mbar | overshoot | settled, s | LP: peak, mbar | overshoot | settled, s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, size in steps:
        unit = "%" if name.startswith("CV") else "W"
        for control in (None, *StationControlKind):
            rows = pressures_after(name, size, control, seconds, file)
            responses = [
                response_of(rows[:, column] - rows[0, column], band) for column, band in enumerate(SETTLED_BAR)
            ]
            cells = " | ".join(
                f"{1e3 * peak:+.1f} | {1e3 * overshoot:.1f} | {'no' if settled_s is None else f'{settled_s:.0f}'}"
                for peak, overshoot, settled_s in responses
            )
            lines.append(f"| {name} {size:+g} {unit} | {control.value if control else 'none'} | {cells} |")
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description="Steps of valves and load: both pressures.")
    parser.add_argument("--seconds", type=float, default=900.0, help="plant time after each step (default: 900)")
    print("\n".join(table(parser.parse_args().seconds)))  # noqa: T201 a program for the terminal


if __name__ == "__main__":
    main()
