"""The whole refrigerator as a program: the plant, its station's controller, their disturbances, and how it starts.

`RefrigeratorKind`, an entry point of `coldloop.plant_kinds`, is what the plant service and the command line ask for.

It starts at the operating point of its file, which `python -m coldloop_refrigerator.model FILE` makes off line.
Like the model file it is JSON with its own digest, so that every run, on any machine, begins with the same bits. Or it
starts warm, before its cool-down.
"""

import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from math import pi, sin
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic import BaseModel, ValidationError

from coldloop import config, errors
from coldloop.kernels.cache import kernels_of
from coldloop.kernels.intrinsics import plain_tuples
from coldloop.process import cold_box, lti_model, model_file, model_range
from coldloop.registers.plant import StationAlarm, StationMode, StationSample, StationStatus, Surroundings
from coldloop_plant import kinds, numeric, program, settings
from coldloop_plant.cold_box import ColdBox, ColdBoxProgram
from coldloop_plant.cold_box.model import AtRest, parameters_digest
from coldloop_plant.cold_box.plant_file import REFERENCE, PlantFile
from coldloop_plant.components.phase_separator import SUPERHEAT, content
from coldloop_plant.helium import Helium, load_helium, saturation, vapour_enthalpy_and_cp
from coldloop_refrigerator import physics, plant_file, station_control, tick
from coldloop_refrigerator.physics import BOX_STATES, COMMAND_NAMES, STATE_NAMES, Refrigerator
from coldloop_refrigerator.plant_file import KIND, REFERENCE_REFRIGERATOR
from coldloop_refrigerator.tick import RefrigeratorMemory
from coldloop_refrigerator.warm import gas_mass

SHIPPED = Path(__file__).with_name("refrigerator.json")
if TYPE_CHECKING:
    from coldloop_refrigerator.compiled import CompiledRefrigerator

REMEDY = "make a new one with `python -m coldloop_refrigerator.model FILE`"


class RefrigeratorFile(BaseModel, frozen=True):
    """The operating point of a refrigerator, and its pressure controller's gains; `plant_rest` of a model file."""

    state_names: tuple[str, ...] = STATE_NAMES
    command_names: tuple[str, ...] = COMMAND_NAMES
    weights: settings.LqWeights
    """Weights that the gains were designed with."""
    parameters_digest: str
    """SHA-256 of the parameters and tables that it was made from."""
    w0: float
    """Heat load, W."""
    x0: tuple[float, ...]
    """Shape (48,)."""
    u0: tuple[float, ...]
    """Inputs of the cold box, shape (3,)."""
    v0: tuple[float, ...]
    """Openings of the warm valves, shape (4,)."""
    gains: tuple[tuple[float, ...], tuple[float, ...]]
    """K of the LQ controller, shape (2, 6)."""

    def save(self, path: Path) -> None:
        """Write the file (OSError if it cannot be written)."""
        model_file.write_document(path, {"format": model_file.FORMAT, "plant": KIND, **self.model_dump(mode="json")})


def read_refrigerator_file(path: Path, plant: Refrigerator = REFERENCE_REFRIGERATOR) -> RefrigeratorFile:
    """Return what a file holds that was made for this very refrigerator.

    Raises:
        ModelFileError: The file cannot be read, is damaged, or was made from another plant.
    """
    document = model_file.read_document(path, REMEDY)
    if document.get("plant") != KIND:
        raise errors.ModelFileError(f"{path}: not the file of a refrigerator; {REMEDY}")
    return rest_in(document, plant, str(path))


def rest_in(document: dict[str, Any], plant: Refrigerator, path: str) -> RefrigeratorFile:
    """Return what a `RefrigeratorFile` in plain data holds of this very refrigerator; `path` is for the message.

    Raises:
        ModelFileError: It is incomplete, or was made from another plant.
    """
    try:
        file = RefrigeratorFile.model_validate(document)
    except ValidationError as error:
        wrong = config.explained(error, {}, RefrigeratorFile, "the file is incomplete")
        raise errors.ModelFileError(f"{path}: {wrong}; {REMEDY}") from error
    names, sizes = (file.state_names, file.command_names), list(map(len, (file.x0, file.u0, file.v0, *file.gains)))
    if names != (STATE_NAMES, COMMAND_NAMES) or sizes != [len(STATE_NAMES), 3, len(COMMAND_NAMES), 6, 6]:
        raise errors.ModelFileError(f"{path}: made for a refrigerator with other states; {REMEDY}")
    if file.parameters_digest != refrigerator_digest(plant):
        raise errors.ModelFileError(f"{path}: made for a refrigerator with other parameters; {REMEDY}")
    return file


@cache
def refrigerator_digest(plant: Refrigerator) -> str:
    """Return the SHA-256 over all parameters, tables and what the states mean, in hexadecimal."""
    helium = load_helium()
    digest = hashlib.sha256(parameters_digest(plant.box, helium).encode())
    digest.update(helium.departure.nodes.astype("<f8").tobytes())
    digest.update(repr((plant.precooler, plant.station)).encode())
    digest.update(b"M_HP is the mass in the line and in the passes")  # a file from before has another mass
    return digest.hexdigest()


def warm_state(
    rest: Sequence[float], plant: Refrigerator, helium: Helium, *, ambient: float, low_pressure: float
) -> numeric.RealArray:
    """Return the state, shape (48,), of a warm refrigerator with as much helium as it holds at rest.

    No compressor runs. The low-pressure line is at its set point and the bath, a vessel of vapour, with it; what is
    left of the helium of the operating point is on the high-pressure side and in the buffer, at one pressure. The
    nitrogen bath is empty.

    `rest` (48) is the state at the operating point. Everything has the temperature `ambient` (K) but the high-pressure
    line, which has that of the cooler's gas; low-pressure line and bath have the pressure `low_pressure` (Pa).
    """
    station, bath = plant.station, plant.box.separator
    total = physics.inventory(np.array(rest), plant, helium)
    saturated = saturation(low_pressure, helium)
    h, _ = vapour_enthalpy_and_cp(low_pressure, ambient, saturated.T, helium.vapour)
    x = np.zeros(len(STATE_NAMES))
    x[0], x[1] = low_pressure, (saturated.h_v - h) / SUPERHEAT * bath.volume
    x[STATE_NAMES.index("T_nef1_1") : BOX_STATES] = x[BOX_STATES : physics.COIL + 1] = ambient
    lp_line = gas_mass(station.lp, low_pressure, ambient)
    elsewhere = total - lp_line - content(bath, x[0], x[1], helium).mass
    pressure = low_pressure
    for _ in range(20):  # masses are nearly in proportion to the pressure
        high = physics.high_pressure_mass(x, pressure, ambient, plant, helium)
        pressure *= elsewhere / (high + gas_mass(station.buffer, pressure, ambient))
    x[physics.STATION : physics.STATION + 3] = high, lp_line, elsewhere - high
    return x


class EventSchedule:
    """Boundary conditions at each tick: of two events for one time and target the later in the list holds.

    `ambient` (K) is the temperature without an event, `daily_swing` (K) the amplitude of its sine over a day, whose
    first six hours are the warmer.
    """

    def __init__(self, events: Sequence[settings.RefrigeratorEvent], ambient: float, daily_swing: float) -> None:
        self._swing = daily_swing
        self._given = Surroundings(ambient=ambient)
        self._changes = sorted(((event.tick, event.target, event.value) for event in events), key=itemgetter(0))
        """Tick, what, and its value, in the order in which they are made."""
        self.put: list[tuple[int, Surroundings]] = []
        """Boundary conditions, and from which tick on each holds, until an event that is planned for later."""

    def at(self, tick: int) -> Surroundings:
        """Return what is given from `tick` (0 or later) to the next, the day's swing left out."""
        since, given = next(((at, put) for at, put in reversed(self.put) if at <= tick), (-1, self._given))
        for at, target, value in self._changes:
            if since < at <= tick:
                changed: dict[str, Any] = {target.value: value if target in settings.MEASURED else int(value)}
                given = given._replace(**changed)
        return given

    def ambient(self, tick: int) -> float:
        """Return the temperature of the surroundings (K) with the day's swing."""
        swing = self._swing * sin(2.0 * pi * tick * cold_box.TICK_S / 86_400.0) if self._swing else 0.0
        return self.at(tick).ambient + swing


AMBIENT: Final = tick.GIVEN_NAMES.index("T_ambient")
RETAINED: Final = ("x", "y", "signals", "commands", "integrals", "equipment")
"""Fields of the memory that are retained; the rest follows from them."""


class RefrigeratorProgram(ColdBoxProgram):
    """The simulated refrigerator with its station's controller, advanced tick by tick.

    `state` and `measure` are those of the cold box, so that all who know a cold box know this plant; `station` is the
    rest.

    It begins at the operating point of `file`, or `warm`, with compressors that stand. `seed` is that of the noise on
    the station's gauges, `noise` is on the cold box's outputs.
    """

    def __init__(
        self,
        *,
        plant: Refrigerator = REFERENCE_REFRIGERATOR,
        file: RefrigeratorFile,
        u0: Sequence[float],
        load: program.HeatLoad,
        station: settings.StationSettings,
        events: EventSchedule,
        noise: program.MeasurementNoise | None = None,
        seed: int = 0,
        warm: bool = False,
    ) -> None:
        self.plant = plant
        self._plant, self._tables = plain_tuples(plant), plain_tuples(load_helium())
        self.law = station_control.station_law(
            station, file.gains, file.v0, plant.station
        )  # Control law of the station
        self._law = plain_tuples(self.law)
        self._events = events
        self._gauge_deviation, self._seed = station.noise_bar, seed
        x, v = np.array(file.x0, dtype=np.float64), np.array(file.v0, dtype=np.float64)
        d = self._disturbances(0, load.value(0))
        equipment = tick.resting_equipment(np.array(u0), warm=warm)
        if warm:
            x = warm_state(file.x0, plant, load_helium(), ambient=d[AMBIENT], low_pressure=1e5 * station.lp_bar)
        self._memory = m = tick.begin_memory(x, v, equipment)
        acting = equipment[tick.ACTING : tick.DEVIATING]
        _, m.y[:], m.signals[:] = physics.evaluated(x, acting, v, d, plant, load_helium())
        tick.control_tick(self._memory, d, self.law)
        super().__init__(box=plant.box, x0=x[:BOX_STATES].tolist(), u0=u0, load=load, noise=noise)

    def _read(self, w: float) -> numeric.RealArray:  # noqa: ARG002 what was read with the memory
        return self._memory.y

    def _warm_up(self) -> None:
        d = self._disturbances(0, self.load)
        tick.advance_program_tick(self.memory, self._u, d, d, self._plant, self._tables, self._law)

    @property
    def station(self) -> StationSample:
        """Compression station and nitrogen at the current tick, with mode and alarms of its controller."""
        m = self._memory
        mode, alarms = StationMode(int(m.status[tick.MODE])), StationAlarm(int(m.status[tick.ALARMS]))
        return StationSample(self.tick, tuple(m.signals.tolist()), mode, alarms)

    @property
    def model_range(self) -> int:
        """Parts outside the property tables at the current tick, bits of `ModelRange`."""
        signals = self._memory.signals
        return model_range.present_model_range(self._x, float(signals[tick.HP]), float(signals[tick.LP]))

    @property
    def station_status(self) -> StationStatus:
        """The same for the registers, with openings asked of the warm valves (%) and inputs that acted on the box."""
        sample = self.station
        m = self._memory
        commands, acting = tuple(m.commands.tolist()), tuple(m.equipment[tick.ACTING : tick.DEVIATING].tolist())
        return StationStatus(sample.tick, sample.mode, sample.alarms, sample.signals, commands, acting)

    @property
    def surroundings(self) -> Surroundings:
        """Boundary conditions at the current tick."""
        return self._events.at(self.tick)

    def give(self, surroundings: Surroundings) -> None:
        """Change what is given, from the next tick on."""
        self._events.put.append((self.tick + 1, surroundings))

    def advance(self) -> None:
        """Go one tick forward."""
        d, ahead = self._disturbances(self.tick, self.load), self._disturbances(self.tick + 1, 0.0)
        tick.advance_program_tick(self._memory, self._u, d, ahead, self._plant, self._tables, self._law)
        self._x = self._memory.x[:BOX_STATES]
        self.tick += 1
        self._measured = self._sample(self._memory.y)

    def _disturbances(self, tick: int, w: float) -> numeric.RealArray:
        """Return what is given in a tick under a load `w` (W); the gauges' noise follows from tick and seed alone."""
        given, ambient, gauges = self._events.at(tick), self._events.ambient(tick), np.zeros(2)
        if self._gauge_deviation:
            generator = np.random.Generator(np.random.Philox(key=self._seed, counter=[0, tick, 0, 0]))
            gauges = self._gauge_deviation * generator.standard_normal(2)
        physical = (w, ambient, 1e-3 * given.leak, given.nitrogen, given.nc1, given.nc2)
        equipment = (given.turbine, given.cv155, given.cv156, given.heater)
        blocking = (given.blocked_nef1, given.blocked_nef2, given.blocked_nef34, given.blocked_nef6)
        return np.array([*physical, *gauges, *equipment, *blocking], dtype=np.float64)

    def ahead(self, ticks: int) -> numeric.RealArray:
        """Return the disturbances, without load, of `ticks` ticks and of the one behind them, shape (ticks + 1, 16)."""
        return np.array([self._disturbances(self.tick + later, 0.0) for later in range(ticks + 1)])

    @property
    def memory(self) -> RefrigeratorMemory:
        """A copy of what a tick changes."""
        parts: dict[str, Any] = {name: part.copy() for name, part in self._memory._asdict().items()}
        return RefrigeratorMemory(**parts)

    def take_over_whole(
        self, tick: int, u: numeric.RealArray, memory: RefrigeratorMemory, y: numeric.RealArray
    ) -> None:
        """Resume at another tick with what `memory` and `measure` would return there; `u` was held up to it."""
        self.take_over(tick, memory.x[:BOX_STATES], u, y)
        self._memory = memory

    def compiled(self) -> "CompiledRefrigerator":
        """Return it as the rig's compiled loop takes it."""
        from coldloop_refrigerator.compiled import CompiledRefrigerator  # noqa: PLC0415 the service has no such loop

        return CompiledRefrigerator(self)

    def resume(self, *retained: Any, warm: Mapping[str, Any] | None = None, **named: Any) -> None:  # noqa: ANN401
        """Resume from what `retained` returned (ValueError or KeyError if it is not of this plant)."""
        if warm is None:
            raise ValueError("the retained state is that of a cold box, not of a refrigerator")
        kept: dict[str, Any] = {name: np.array(warm[name], dtype=np.float64) for name in RETAINED}
        for name, values in kept.items():
            if values.shape != getattr(self._memory, name).shape:
                raise ValueError(f"{name}: expected {len(getattr(self._memory, name))} numbers")
        super().resume(*retained, **named)
        self._events.put += [(int(since), Surroundings(*put)) for since, put in warm["given"]]
        self._memory = self._memory._replace(**kept)
        self._memory.acted[:] = np.nan

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        m = self._memory
        warm: dict[str, Any] = {name: getattr(m, name).tolist() for name in RETAINED}
        warm["given"] = [(tick, list(put)) for tick, put in self._events.put]
        return {**super().retained(), "warm": warm}


class RefrigeratorKind:
    """The refrigerator as a `coldloop_plant.kinds.Kind`."""

    def plant_in(self, model: model_file.ModelHeader | lti_model.LtiModel, where: str) -> tuple[ColdBox, str]:
        """Return the cold box of the refrigerator that a model file describes, and the digest of its parameters."""
        plant = _refrigerator_in(model, where)
        return plant.box, refrigerator_digest(plant)

    def maker_of(
        self, header: model_file.ModelHeader, section: settings.PlantSection, noise_of_seed: program.NoiseOfSeed
    ) -> program.MakePlant:
        """Return what makes the refrigerator of a model file, for a load and a seed.

        Raises:
            ModelFileError: The refrigerator's file, or what the model file says of the plant, cannot be used.
            ConfigurationError: Its gains are not of the configured weights.
        """
        if header.plant == model_file.COLD_BOX and kinds.box_of(header) != REFERENCE:
            raise errors.ModelFileError(
                "model.file: of another cold box than the refrigerator's; set plant.kind to cold-box"
            )
        plant, named = REFERENCE_REFRIGERATOR, section.refrigerator.file
        if header.plant != model_file.COLD_BOX:
            plant = _refrigerator_in(header, "model.file")
        if named is None and header.plant_rest:
            file = rest_in(header.plant_rest, plant, "model.file: plant_rest")
        else:
            file = read_refrigerator_file(named or SHIPPED, plant)
        if section.station.control is settings.StationControlKind.LQ and section.station.weights != file.weights:
            raise errors.ConfigurationError(
                "plant.station.weights: the gains of this refrigerator belong to other weights; make a file with"
                " `python -m coldloop_refrigerator.model FILE` and name it in plant.refrigerator.file, or, with a"
                " plant file, its model file with `coldloop model --plant` and these weights"
            )
        happening = section.refrigerator

        def make(load: program.HeatLoad, seed: int) -> program.PlantProgram:
            events = EventSchedule(happening.events, happening.ambient_k, happening.daily_swing_k)
            with kernels_of("the refrigerator", about_s=20):
                return RefrigeratorProgram(
                    plant=plant, file=file, u0=header.u0, load=load, station=section.station, events=events,
                    noise=noise_of_seed(seed), seed=seed, warm=happening.start is settings.RefrigeratorStart.WARM,
                )  # fmt: skip

        return make

    read_plant_file = staticmethod(plant_file.read_plant_file)

    def at_rest(self, file: PlantFile, control: settings.StationSettings) -> AtRest:
        """Return the refrigerator of a plant file at rest, and its model with the gains of the controller's weights."""
        from coldloop_refrigerator.model import described_at_rest  # noqa: PLC0415 it needs SciPy, the service does not

        return described_at_rest(plant_file.RefrigeratorPlantFile.model_validate(file), control)


def _refrigerator_in(model: model_file.ModelHeader | lti_model.LtiModel, where: str) -> Refrigerator:
    return kinds.parameters_in(model, plant_file.RefrigeratorParameters, where).refrigerator
