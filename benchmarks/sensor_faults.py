"""Each sensor dead, stuck, biased and drifting under MPC: whether it is noticed, and what becomes of the process.

Runs are in one process, with sensor noise; faults begin after ten minutes. Bands are of the true outputs. `--quiet`
is another question: what is noticed in so many hours with noise and without a fault.
"""

import argparse
import math
from typing import NamedTuple, cast

from coldloop.process.signals import L1, OUTPUT_NAMES, OUTPUT_UNITS, T5, TICK_S
from coldloop.registers.control_plc import Mode
from coldloop.registers.safety import AlarmKind
from plant.kinds import plant_maker
from plant.load import find_load
from plant.own_model import own_header
from plant.program import PlantProgram
from rig.cosim.one_process import OneProcessRig, Programs, load_table
from rig.results.recording import Recorder
from rig.settings import Settings

SETTLED_S = 600.0
MINUTES = 30
SIZE = {"%": 0.6, "Hz": 100.0, "K": 0.5, "bar": 0.05}
"""Of a bias; a drift reaches it in ten minutes."""
DRIFT_S = 600.0
SURPRISING = 3.0
"""From here on the page names a reading."""
FAULTS = ("dead", "stuck", "biased", "drifting")
NOISY = {"level": 0.01, "speed": 1.0, "temperature": 0.02, "pressure": 0.001}


class FaultySensors:
    """A plant, one of whose sensors shows something else from a tick on."""

    def __init__(self, plant: PlantProgram, output: int, fault: str) -> None:
        self._plant, self._output, self._fault = plant, output, fault
        self._begin = round(SETTLED_S / TICK_S)
        self._stuck = math.nan
        self.true: tuple[float, ...] = ()

    def __getattr__(self, name: str) -> object:
        return getattr(self._plant, name)

    def measure(self) -> tuple[float, ...]:
        """Return what the sensors show."""
        self.true = shown = self._plant.measure()
        since = (self._plant.tick - self._begin) * TICK_S
        if since < 0.0 or not self._fault:
            return shown
        value, size = shown[self._output], SIZE[OUTPUT_UNITS[self._output]]
        if math.isnan(self._stuck):
            self._stuck = value
        faulty = {
            "dead": math.nan, "stuck": self._stuck, "biased": value + size, "drifting": value + size * since / DRIFT_S,
        }  # fmt: skip
        return (*shown[: self._output], faulty[self._fault], *shown[self._output + 1 :])


class Outcome(NamedTuple):
    """What became of a run."""

    alarm_s: float
    """When `sensor bad` was raised, after the fault; infinite if never."""
    surprise_s: float
    """When the reading was first surprising, after the fault."""
    lowest: tuple[float, float]
    """Of L1 and T5, in truth."""
    highest: tuple[float, float]
    modes: set[str]


def run(load_name: str, seed: int, output: int, fault: str, ticks: int) -> Outcome:
    """Run a load with a fault."""
    settings = Settings.model_validate({"plant": {"sensors": NOISY}})
    header = own_header(settings.model.file)
    load = load_table(find_load(load_name, header.w0))
    plant = FaultySensors(plant_maker(header, settings.plant)(load, seed), output, fault)
    rig = OneProcessRig(settings, compiled=False)
    control, optimizer = rig.control, rig.optimizer
    programs, listener = Programs(cast("PlantProgram", plant), control, optimizer), Recorder(ticks)
    optimizer.restart(0.0)
    control.restart(session=1)
    lowest, highest, modes = [math.inf] * 2, [-math.inf] * 2, set[str]()
    alarm = surprise = math.inf
    while control.tick < ticks:
        programs.tick(listener)
        since = control.tick * TICK_S - SETTLED_S
        if since < 0.0:
            continue
        for i, place in enumerate((L1, T5)):
            lowest[i], highest[i] = min(lowest[i], plant.true[place]), max(highest[i], plant.true[place])
        modes.add(Mode(control.mode).name)
        if control.alarms.rows[AlarmKind.SENSOR_BAD].times:
            alarm = min(alarm, since)
        if optimizer.state.belief.surprise.max() > SURPRISING**2:
            surprise = min(surprise, since)
    return Outcome(alarm, surprise, (lowest[0], lowest[1]), (highest[0], highest[1]), modes)


def row(name: str, fault: str, found: Outcome) -> str:
    """Return a row of the table."""

    def when(seconds: float) -> str:
        return f"{seconds:.0f} s" if math.isfinite(seconds) else "never"

    truth = ", ".join(f"{low:.2f} to {high:.2f}" for low, high in zip(found.lowest, found.highest, strict=True))
    return " | ".join([name, fault, when(found.alarm_s), when(found.surprise_s), truth, " ".join(sorted(found.modes))])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--load", default="a", help="name of the load (default: a)")
    parser.add_argument(
        "--outputs", nargs="+", default=OUTPUT_NAMES, choices=OUTPUT_NAMES, help="sensors (default: all)"
    )
    parser.add_argument("--minutes", type=int, default=MINUTES, help="length of a run (default: 30)")
    parser.add_argument("--quiet", type=int, metavar="HOURS", help="hours without a fault instead, one draw each")
    options = parser.parse_args()
    print("sensor | fault | alarm after | surprising after | L1, %, and T5, K, in truth | modes")
    if options.quiet:
        for draw in range(1, options.quiet + 1):
            print(
                row(
                    f"{options.load}@{draw}", "none", run(f"{options.load}@{draw}", draw, L1, "", round(3600 / TICK_S))
                ),
                flush=True,
            )
        return
    for name in options.outputs:
        for fault in FAULTS:
            found = run(options.load, 1, OUTPUT_NAMES.index(name), fault, round(60 * options.minutes / TICK_S))
            print(row(name, fault, found), flush=True)


if __name__ == "__main__":
    main()
