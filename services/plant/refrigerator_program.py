"""The whole refrigerator as a program: the plant, its station's controller, and what happens to both."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coldloop.registers.plant import StationSample, StationStatus, Surroundings
from plant.helium.properties import load_helium
from plant.integrator import plain_tuples
from plant.numeric import RealArray
from plant.program import HeatLoad, MeasurementNoise, PlantProgram
from plant.refrigerator import (
    BOX_STATES,
    REFERENCE_REFRIGERATOR,
    SIGNAL_NAMES,
    STATE_NAMES,
    advance_and_read_refrigerator,
    check_refrigerator,
    read,
)
from plant.refrigerator_events import EventSchedule
from plant.refrigerator_file import RefrigeratorFile
from plant.station_control import Commands, StationControl, StationMeasurement
from plant.station_settings import StationSettings

HP, LP, BUFFER, NITROGEN, LOST = (SIGNAL_NAMES.index(name) for name in ("P12", "P11", "P13", "L_N2", "lost"))
CV956, CV952, CV953 = (STATE_NAMES.index(name) for name in ("CV956", "CV952", "CV953"))


class RefrigeratorProgram(PlantProgram):
    """The simulated refrigerator with its station's controller, advanced tick by tick.

    `state` and `measure` are those of the cold box, so that all who know a cold box know this plant; `station` is the
    rest.

    Args:
        file: Operating point and gains; `x0` of the plant is its.
        u0: Inputs held until the first `apply`, 3 numbers.
        load: The heat load over time.
        station: Settings of the station's controller.
        events: What happens to the refrigerator.
        noise: Noise on the cold box's measurements; None measures exactly.

    Raises:
        ValueError: An argument of wrong length, not finite, or out of range.
    """

    def __init__(
        self,
        *,
        file: RefrigeratorFile,
        u0: Sequence[float],
        load: HeatLoad,
        station: StationSettings,
        events: EventSchedule,
        noise: MeasurementNoise | None = None,
    ) -> None:
        check_refrigerator(REFERENCE_REFRIGERATOR)
        self._plant, self._tables = plain_tuples(REFERENCE_REFRIGERATOR), plain_tuples(load_helium())
        self._control = StationControl(station, file.reference, REFERENCE_REFRIGERATOR.station)
        self._events = events
        self._full = np.array(file.x0)
        self.tick = 0
        self._signals = self._read_at(np.array(u0, dtype=np.float64), np.array(file.v0), load.value(0))
        self._commands = self._controlled()
        super().__init__(box=REFERENCE_REFRIGERATOR.box, x0=file.x0[:BOX_STATES], u0=u0, load=load, noise=noise)

    def _read_at(self, u: RealArray, v: RealArray, w: float) -> RealArray:
        d = self._disturbances(0, w)
        _, signals = read(self._full, u, v, d, REFERENCE_REFRIGERATOR, load_helium())
        return signals

    @property
    def station(self) -> StationSample:
        """Compression station and nitrogen at the current tick, with mode and alarms of its controller."""
        return StationSample(self.tick, tuple(self._signals.tolist()), self._control.mode, self._control.alarms)

    @property
    def station_status(self) -> StationStatus:
        """The same for the registers, with what its controller asks for."""
        sample = self.station
        return StationStatus(sample.tick, sample.mode, sample.alarms, sample.signals, tuple(self._commands))

    @property
    def surroundings(self) -> Surroundings:
        """What is given at the current tick."""
        return self._events.at(self.tick)

    def give(self, surroundings: Surroundings) -> None:
        """Change what is given, from the next tick on."""
        self._events.put(self.tick + 1, surroundings)

    @property
    def commands(self) -> Commands:
        """Openings that the station's controller asks for from the current tick on, %."""
        return self._commands

    def advance(self) -> None:
        """Go one tick forward."""
        d = self._disturbances(self.tick, self.load)
        v = np.array(self._commands)
        self._full, y, self._signals = advance_and_read_refrigerator(
            self._full, self._u, v, d, self._tick_s, self._plant, self._tables
        )
        self._x = self._full[:BOX_STATES]
        self.tick += 1
        self._commands = self._controlled()
        self._measured = self._sample(y)

    def _disturbances(self, tick: int, w: float) -> RealArray:
        given, ambient = self._events.at(tick), self._events.ambient(tick)
        return np.array([w, ambient, 1e-3 * given.leak, given.nitrogen, given.nc1, given.nc2], dtype=np.float64)

    def _controlled(self) -> Commands:
        """Return what the station's controller asks for at the present tick."""
        signals, x, now = self._signals, self._full, self._events.at(self.tick)
        return self._control.step(
            StationMeasurement(
                float(signals[HP]), float(signals[LP]), float(signals[BUFFER]),
                float(x[CV956]), float(x[CV952]), float(x[CV953]),
                float(signals[NITROGEN]), float(signals[LOST]), bool(now.nc1), bool(now.nc2),
            )
        )  # fmt: skip

    def resume(
        self,
        tick: int,
        x: Sequence[float],
        u: Sequence[float],
        y: Sequence[float],
        noise_state: Mapping[str, Any],
        warm: Mapping[str, Any] | None = None,
    ) -> None:
        """Go on from what `retained` returned (ValueError or KeyError if it is not of this plant)."""
        if warm is None:
            raise ValueError("the retained state is that of a cold box, not of a refrigerator")
        full, signals = np.array(warm["x"], dtype=np.float64), np.array(warm["signals"], dtype=np.float64)
        if full.shape != self._full.shape or signals.shape != self._signals.shape:
            raise ValueError(f"expected {len(STATE_NAMES)} states and {len(SIGNAL_NAMES)} signals")
        super().resume(tick, x, u, y, noise_state)
        self._control.resume(list(warm["control"]))
        for since, put in warm["given"]:
            self._events.put(int(since), Surroundings(*put))
        self._full, self._signals, self._commands = full, signals, Commands(*warm["commands"])

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        warm = {
            "x": self._full.tolist(), "signals": self._signals.tolist(),
            "control": self._control.retained(), "commands": list(self._commands),
            "given": [(tick, list(put)) for tick, put in self._events.puts],
        }  # fmt: skip
        return {**super().retained(), "warm": warm}
