"""The whole refrigerator as a program: the plant, its station's controller, and their disturbances."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from coldloop.kernels.named import plain_tuples
from coldloop.process.model_range import model_range
from coldloop.registers.plant import StationAlarm, StationMode, StationSample, StationStatus, Surroundings
from coldloop_plant.cold_box.program import ColdBoxProgram
from coldloop_plant.helium.properties import load_helium
from coldloop_plant.numeric import RealArray
from coldloop_plant.program import HeatLoad, MeasurementNoise
from coldloop_plant.refrigerator.equipment import ACTING, DEVIATING, GIVEN_NAMES, resting_equipment, standing_equipment
from coldloop_plant.refrigerator.events import EventSchedule
from coldloop_plant.refrigerator.file import RefrigeratorFile
from coldloop_plant.refrigerator.physics import BOX_STATES, Refrigerator, check_refrigerator, read
from coldloop_plant.refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_plant.refrigerator.station_control import station_law
from coldloop_plant.refrigerator.station_law import Commands
from coldloop_plant.refrigerator.station_settings import StationSettings
from coldloop_plant.refrigerator.tick import (
    ALARMS,
    HP,
    LP,
    MODE,
    RefrigeratorMemory,
    advance_program_tick,
    begin_memory,
    control_tick,
)
from coldloop_plant.refrigerator.warm_start import warm_state

AMBIENT: Final = GIVEN_NAMES.index("T_ambient")
RETAINED: Final = ("x", "y", "signals", "commands", "integrals", "equipment")
"""Of the memory; the rest follows from it."""


class GaugeNoise:
    """White Gaussian noise on the station's gauges: of each tick by itself, so that nothing of it is retained.

    Args:
        deviation: Standard deviation, bar; 0 measures exactly.
        seed: Of the draws, 0 or more.
    """

    def __init__(self, deviation: float, seed: int) -> None:
        self._deviation, self._seed = deviation, seed

    def at(self, tick: int) -> tuple[float, float]:
        """Return by how much the gauges of the high and of the low pressure are off, bar."""
        if not self._deviation:
            return 0.0, 0.0
        generator = np.random.Generator(np.random.Philox(key=self._seed, counter=[0, tick, 0, 0]))
        hp, lp = self._deviation * generator.standard_normal(2)
        return float(hp), float(lp)


class RefrigeratorProgram(ColdBoxProgram):
    """The simulated refrigerator with its station's controller, advanced tick by tick.

    `state` and `measure` are those of the cold box, so that all who know a cold box know this plant; `station` is the
    rest.

    Args:
        plant: The parameters of the refrigerator.
        file: Its operating point and gains; `x0` of the plant is its.
        u0: Inputs held until the first `apply`, 3 numbers.
        load: The heat load over time.
        station: Settings of the station's controller.
        events: Disturbances of the refrigerator.
        noise: Noise on the cold box's measurements; None measures exactly.
        seed: Of the noise on the station's gauges.
        warm: Begin with a warm refrigerator that stands, in the place of the operating point.

    Raises:
        ValueError: An argument of wrong length, not finite, or out of range.
    """

    def __init__(
        self,
        *,
        plant: Refrigerator = REFERENCE_REFRIGERATOR,
        file: RefrigeratorFile,
        u0: Sequence[float],
        load: HeatLoad,
        station: StationSettings,
        events: EventSchedule,
        noise: MeasurementNoise | None = None,
        seed: int = 0,
        warm: bool = False,
    ) -> None:
        check_refrigerator(plant)
        self.plant = plant
        self._plant, self._tables = plain_tuples(plant), plain_tuples(load_helium())
        self.law = station_law(station, file.reference, plant.station)
        """Of the station's controller."""
        self._law = plain_tuples(self.law)
        self._events = events
        self._gauges = GaugeNoise(station.noise_bar, seed)
        x, v = np.array(file.x0, dtype=np.float64), np.array(file.v0, dtype=np.float64)
        d = self._disturbances(0, load.value(0))
        equipment = standing_equipment(np.array(u0)) if warm else resting_equipment(np.array(u0))
        if warm:
            x = warm_state(file.x0, plant, load_helium(), ambient=d[AMBIENT], low_pressure=1e5 * station.lp_bar)
        self._memory = m = begin_memory(x, v, equipment)
        m.y[:], m.signals[:] = read(x, equipment[ACTING:DEVIATING], v, d, plant, load_helium())
        control_tick(self._memory, d, self.law)
        super().__init__(box=plant.box, x0=x[:BOX_STATES].tolist(), u0=u0, load=load, noise=noise)

    def _read(self, w: float) -> RealArray:  # noqa: ARG002 what was read with the memory
        return self._memory.y

    def _warm_up(self) -> None:
        d = self._disturbances(0, self.load)
        advance_program_tick(self.memory, self._u, d, d, self._plant, self._tables, self._law)

    @property
    def station(self) -> StationSample:
        """Compression station and nitrogen at the current tick, with mode and alarms of its controller."""
        m = self._memory
        mode, alarms = StationMode(int(m.status[MODE])), StationAlarm(int(m.status[ALARMS]))
        return StationSample(self.tick, tuple(m.signals.tolist()), mode, alarms)

    @property
    def model_range(self) -> int:
        """What is outside the property tables at the current tick, bits of `ModelRange`."""
        signals = self._memory.signals
        return int(model_range(self._x, signals[HP], signals[LP]))

    @property
    def station_status(self) -> StationStatus:
        """The same for the registers, with what its controller asks for."""
        sample = self.station
        return StationStatus(sample.tick, sample.mode, sample.alarms, sample.signals, self.commands, self.acting)

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
        return Commands(*self._memory.commands.tolist())

    @property
    def acting(self) -> tuple[float, ...]:
        """The inputs that acted on the cold box up to the current tick: CV155 %, NCR22_A W, CV156 %."""
        return tuple(self._memory.equipment[ACTING:DEVIATING].tolist())

    def advance(self) -> None:
        """Go one tick forward."""
        d, ahead = self._disturbances(self.tick, self.load), self._disturbances(self.tick + 1, 0.0)
        advance_program_tick(self._memory, self._u, d, ahead, self._plant, self._tables, self._law)
        self._x = self._memory.x[:BOX_STATES]
        self.tick += 1
        self._measured = self._sample(self._memory.y)

    def _disturbances(self, tick: int, w: float) -> RealArray:
        given, ambient = self._events.at(tick), self._events.ambient(tick)
        physical = (w, ambient, 1e-3 * given.leak, given.nitrogen, given.nc1, given.nc2)
        equipment = (given.turbine, given.cv155, given.cv156, given.heater)
        blocking = (given.blocked_nef1, given.blocked_nef2, given.blocked_nef34, given.blocked_nef6)
        return np.array([*physical, *self._gauges.at(tick), *equipment, *blocking], dtype=np.float64)

    def ahead(self, ticks: int) -> RealArray:
        """Return the disturbances, without load, of `ticks` ticks and of the one behind them, shape (ticks + 1, 16)."""
        return np.array([self._disturbances(self.tick + later, 0.0) for later in range(ticks + 1)])

    @property
    def memory(self) -> RefrigeratorMemory:
        """A copy of what a tick changes."""
        parts: dict[str, Any] = {name: part.copy() for name, part in self._memory._asdict().items()}
        return RefrigeratorMemory(**parts)

    def take_over_whole(self, tick: int, u: RealArray, memory: RefrigeratorMemory, y: RealArray) -> None:
        """Resume at another tick with what `memory` and `measure` would return there; `u` was held up to it."""
        self.take_over(tick, memory.x[:BOX_STATES], u, y)
        self._memory = memory

    def resume(
        self,
        tick: int,
        x: Sequence[float],
        u: Sequence[float],
        y: Sequence[float],
        noise_state: Mapping[str, Any],
        warm: Mapping[str, Any] | None = None,
    ) -> None:
        """Resume from what `retained` returned (ValueError or KeyError if it is not of this plant)."""
        if warm is None:
            raise ValueError("the retained state is that of a cold box, not of a refrigerator")
        kept: dict[str, Any] = {name: np.array(warm[name], dtype=np.float64) for name in RETAINED}
        for name, values in kept.items():
            if values.shape != getattr(self._memory, name).shape:
                raise ValueError(f"{name}: expected {len(getattr(self._memory, name))} numbers")
        super().resume(tick, x, u, y, noise_state)
        for since, put in warm["given"]:
            self._events.put(int(since), Surroundings(*put))
        self._memory = self._memory._replace(**kept)
        self._memory.acted[:] = np.nan

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        m = self._memory
        warm: dict[str, Any] = {name: getattr(m, name).tolist() for name in RETAINED}
        warm["given"] = [(tick, list(put)) for tick, put in self._events.puts]
        return {**super().retained(), "warm": warm}
