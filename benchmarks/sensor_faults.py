"""Each sensor with each fault under MPC: when that is noticed, and what becomes of the process.

Dead: no number. Stuck: the same bits. Held: the same value, with its usual noise. Biased, drifting, and running away
(0.5 % a minute). Spiking: 1 to 20 times its bias too much or too little in one tick of fifty. Runs are in one process,
with sensor noise; faults begin after five minutes. Bands are of the true outputs. `--sound` counts what is noticed in
hours without a fault: with noise, or of plants that are not their model, by load, or with a constant one (`--watts`).
"""

import argparse
import math
import random
from collections.abc import Sequence
from typing import NamedTuple, cast

from coldloop.process.cold_box import COLD_BOX, L1, OUTPUT_NAMES, OUTPUT_UNITS, T5, TICK_S
from coldloop.process.load_profile import LoadProfile
from coldloop.registers import maps_of
from coldloop.registers.common import Event, EventKind
from coldloop.registers.control_plc import Mode
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.load import find_load
from coldloop_plant.program import PlantProgram
from coldloop_plant.settings import MismatchSettings
from coldloop_rig.cosim.one_process import OneProcessRig, Programs, load_table
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

BANDS = ControlDesign()
SETTLED_S = 300.0
MINUTES = 20
HOUR_TICKS = round(3600 / TICK_S)
SIZE = {"%": 0.6, "Hz": 100.0, "K": 0.5, "bar": 0.05}
"""Of a bias; a drift reaches it in ten minutes."""
DRIFT_S = 600.0
AWAY_S = 72.0
"""In which a reading that runs away is off by its bias."""
SPIKES = 0.02
"""Share of the ticks."""
FAULTS = ("none", "dead", "stuck", "held", "biased", "drifting", "away", "spiking")
NOISY = {"level": 0.01, "speed": 1.0, "temperature": 0.02, "pressure": 0.001}
VALVES = ("jt_valve", "turbine_valve")
NOTICED = ("good", "bad", "suspect")
"""By the cause of an event."""


class FaultySensors:
    """A plant with noisy sensors, one of which shows something else from a tick on."""

    def __init__(self, plant: PlantProgram, deviations: Sequence[float], seed: int, output: int, fault: str) -> None:
        self.sound, self._output, self._fault = plant, output, fault
        self._begin, self._deviations = round(SETTLED_S / TICK_S), deviations
        self._random, self._tick = random.Random(seed), -1  # noqa: S311 no secret
        self._held = self._stuck = math.nan
        self._shown = self.true = tuple[float, ...]()

    def __getattr__(self, name: str) -> object:
        return getattr(self.sound, name)

    def measure(self) -> tuple[float, ...]:
        """Return what the sensors show."""
        if self.sound.tick != self._tick:
            self._tick, self.true = self.sound.tick, self.sound.measure()
            noise = [self._random.gauss(0.0, sigma) for sigma in self._deviations]
            shown = [value + error for value, error in zip(self.true, noise, strict=True)]
            since = (self._tick - self._begin) * TICK_S
            if since >= 0.0:
                shown[self._output] = self._faulty(shown[self._output], noise[self._output], since)
            self._shown = tuple(shown)
        return self._shown

    def _faulty(self, value: float, noise: float, since: float) -> float:
        size = SIZE[OUTPUT_UNITS[self._output]]
        if math.isnan(self._stuck):
            self._held, self._stuck = self.true[self._output], value
        spike = self._random.choice((-size, size)) * self._random.uniform(1.0, 20.0)
        return {
            "none": value, "dead": math.nan, "stuck": self._stuck, "held": self._held + noise, "biased": value + size,
            "drifting": value + size * since / DRIFT_S, "away": value + size * since / AWAY_S,
            "spiking": value + spike * (self._random.random() < SPIKES),
        }[self._fault]  # fmt: skip


class Outcome(NamedTuple):
    """What became of a run."""

    noticed: list[Event]
    """Of sensors."""
    lowest: tuple[float, float]
    """Of L1 and T5, in truth."""
    highest: tuple[float, float]
    outside: tuple[float, float]
    """Share of the time outside their bands, %."""
    modes: set[str]


def of_sensors(rig: OneProcessRig) -> list[Event]:
    """Return the journal's events of sensors."""
    return [event for event in rig.control.journal.since(0) if event.kind == EventKind.SENSOR]


def run(settings: Settings, load_name: str, seed: int, output: int, fault: str, ticks: int) -> Outcome:
    """Run a load with a fault."""
    header = own_header(settings.model.file)
    load = load_table(find_load(load_name, header.w0, COLD_BOX), COLD_BOX)
    exact = settings.plant.model_copy(update={"sensors": type(settings.plant.sensors)()})
    made = plant_maker(header, exact)(load, seed)
    plant = FaultySensors(made, settings.plant.sensors.deviations, seed, output, fault)
    rig = OneProcessRig(settings, compiled=False)
    control, optimizer = rig.control, rig.optimizer
    programs, listener = Programs(cast("PlantProgram", plant), control, optimizer, maps_of(COLD_BOX)), Recorder(ticks)
    optimizer.restart(0.0)
    control.restart(session=1)
    while control.tick < round(SETTLED_S / TICK_S):
        programs.tick(listener)
    lowest, highest, outside, modes = [math.inf] * 2, [-math.inf] * 2, [0, 0], set[str]()
    bands = list(zip(BANDS.output_low, BANDS.output_high, strict=True))
    while control.tick < ticks:
        programs.tick(listener)
        for i, place in enumerate((L1, T5)):
            lowest[i], highest[i] = min(lowest[i], plant.true[place]), max(highest[i], plant.true[place])
            outside[i] += not bands[i][0] <= plant.true[place] <= bands[i][1]
        modes.add(Mode(control.mode).name)
    shares = [100.0 * count / (ticks - round(SETTLED_S / TICK_S)) for count in outside]
    return Outcome(
        of_sensors(rig), (lowest[0], lowest[1]), (highest[0], highest[1]), (shares[0], shares[1]), modes
    )  # fmt: skip


def row(output: int, fault: str, found: Outcome) -> str:
    """Return a row of the table."""
    ours = [event for event in found.noticed if event.subject == output]
    told = [f"{event.tick * TICK_S - SETTLED_S:.0f} s {NOTICED[event.cause]}" for event in ours]
    others = {OUTPUT_NAMES[event.subject] for event in found.noticed} - {OUTPUT_NAMES[output]}
    truth = [
        f"{low:.2f} to {high:.2f}, {outside:.1f} % outside"
        for low, high, outside in zip(found.lowest, found.highest, found.outside, strict=True)
    ]
    return " | ".join([
        OUTPUT_NAMES[output], fault, ", ".join(told) or "never", " ".join(sorted(others)), *truth,
        " ".join(sorted(found.modes)),
    ])  # fmt: skip


def off(text: str) -> dict[str, float]:
    """Return the factors of a plant such as `valves=0.9`."""
    name, _, factor = text.partition("=")
    known = ("valves", *MismatchSettings.model_fields)
    try:
        value = float(factor)
    except ValueError:
        value = math.nan
    if name not in known or not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=FACTOR; names are {', '.join(known)}")
    return dict.fromkeys(VALVES if name == "valves" else (name,), value)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--loads", nargs="+", default=["a"], help="names of loads (default: a)")
    parser.add_argument(
        "--outputs", nargs="+", default=OUTPUT_NAMES, choices=OUTPUT_NAMES, help="sensors (default: all)"
    )
    parser.add_argument("--faults", nargs="+", default=FAULTS, choices=FAULTS, help="(default: all)")
    parser.add_argument("--minutes", type=int, default=MINUTES, help="length of a run (default: 20)")
    parser.add_argument("--exact", action="store_true", help="sensors without noise")
    parser.add_argument("--off", type=off, default={}, help="a plant that is off, such as valves=0.9")
    parser.add_argument("--kind", default="cold-box", help="of the plant")
    parser.add_argument("--unmeasured", action="store_true", help="the load is not measured")
    parser.add_argument("--watts", type=float, help="a constant load, with --sound")
    parser.add_argument(
        "--first", type=int, default=1, help="first draw, with --sound; later ones than shown are fresh"
    )
    parser.add_argument("--sound", type=int, metavar="DRAWS", help="no fault; so many draws of an hour of each load")
    options = parser.parse_args()
    sensors = {} if options.exact else NOISY
    plant = {"sensors": sensors, "mismatch": options.off, "kind": options.kind}
    program = {"estimator": {"load_known": not options.unmeasured}}
    settings = Settings.model_validate({"plant": plant, "optimizer_plc": {"program": program}})
    if options.sound:
        draws = range(options.first, options.first + options.sound)
        for load in (f"{name}@{draw}" for name in options.loads for draw in draws):
            rig, seed = OneProcessRig(settings), int(load.partition("@")[2])
            profile = find_load(load, own_header(settings.model.file).w0, COLD_BOX)
            if options.watts is not None:
                profile = LoadProfile((0,), (options.watts,))
            rig.run(Scenario(HOUR_TICKS, profile, 0.0, seed), Recorder(HOUR_TICKS))
            told = [
                f"{event.tick * TICK_S:.0f} s {OUTPUT_NAMES[event.subject]} {NOTICED[event.cause]}"
                for event in of_sensors(rig)
            ]
            print(load, "|", ", ".join(told) or "nothing", flush=True)
        return
    print("load | sensor | fault | noticed after | others | L1, %, in truth | T5, K, in truth | modes")
    ticks = round(60 * options.minutes / TICK_S)
    for name in options.outputs:
        for fault in options.faults:
            for load in options.loads:
                output = OUTPUT_NAMES.index(name)
                seed = int(load.partition("@")[2] or 1)
                print(load, "|", row(output, fault, run(settings, load, seed, output, fault, ticks)), flush=True)


if __name__ == "__main__":
    main()
