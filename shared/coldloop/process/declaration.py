"""What a process is to the PLCs: its signals, its time, what it may and what it should do.

A program is given its process with its model file (`coldloop.process.settings`). The cold box is
declared in `coldloop.process.cold_box`; others come with their model file, from a process file (`docs/your-plant.md`).
Needs the standard library only.
"""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Final, Self, get_args, get_type_hints

LAST_TICK: Final = 2**32 - 2**16 - 1
"""Last tick of a session, after 34 years: what is planned from there still fits a register."""

LAST_NUMBER: Final = LAST_TICK
"""Largest number of an update, or of a sequence."""

LOAD_IN_WATTS: Final = "load_w"
"""Column of a load in watts; in a file it is understood for any load."""

REFERENCE_TICK_S: Final = 0.25
"""Tick that default times of the settings are for: the cold box's, tau_1 of the paper (section IV)."""

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Input:
    """A manipulated input."""

    name: str
    unit: str
    register: str
    """Its name as a field of registers."""
    description: str
    span: Range
    """What its registers take."""
    low: float
    high: float
    rate: float
    """Largest change in a sampling period, up or down."""
    safe: float
    """What the rack applies by default when nobody drives it."""
    scale: float
    """Of its variable in the problem."""
    weight: float
    """In the cost, per square of its deviation from the operating point."""
    walk: float
    """Random walk of its constant error, per square root of a sampling period."""
    has_constant: bool = True
    """Whether its constant error is told from the load."""
    bar: Range | None = None
    """Ends of its bar on the operator's page; from its bounds where they are not given."""


@dataclass(frozen=True, kw_only=True)
class Loop:
    """A PI loop of the fallback: u = gain (e + 1/T_i integral of e) with e = setpoint - y."""

    input: str
    gain: float
    """In the unit of the input per unit of the output."""
    integral_time_s: float
    setpoint_offset: float = 0.0
    """Setpoint less the output at the operating point, in the unit of the output."""


@dataclass(frozen=True, kw_only=True)
class Band:
    """What an output is to be kept within."""

    low: float
    high: float
    weight: float
    """rho, per square of what the band is missed by and sample."""
    margin: float = 0.0
    """How far inside it the rows of the problem are: half of it where there is a setpoint, in its middle."""
    alarm: Range | None = None
    """Outside of it the alarm is raised; the band where it is not given."""
    dead_band: float = 0.0
    """Excess up to which the output does not count as outside, in its unit: for alarms, indicators and the page."""
    loop: Loop | None = None
    alarm_word: str = ""
    """What its alarm is called; `NAME outside its band` where this is empty."""


@dataclass(frozen=True, kw_only=True)
class Output:
    """A measured output."""

    name: str
    unit: str
    quantity: str = ""
    """What the settings of sensors and estimator call its kind; empty where the three numbers below say it."""
    range: Range = (0.0, 0.0)
    """Of its sensor."""
    noise: float = 0.0
    """Standard deviation that the estimator expects."""
    allowance: float = 0.0
    """What a plant that is not its model adds to a residual."""
    weight: float = 0.0
    """In the cost, per square of its deviation from the operating point."""
    band: Band | None = None
    bar: Range | None = None
    """Ends of its bar on the operator's page; from its band, or the range of its sensor, where they are not given."""


@dataclass(frozen=True, kw_only=True)
class State:
    """A state of the model."""

    name: str
    unit: str
    walk: float | None = None
    """Its process noise, per square root of a sampling period; None where settings of the estimator say it by unit."""


@dataclass(frozen=True, kw_only=True)
class Load:
    """The one disturbance."""

    name: str
    unit: str
    span: Range
    walk: float
    """Random walk of what of it is not measured, per square root of a sampling period."""
    has_named_loads: bool = False
    """Whether the loads that have a name are its own; elsewhere they are stretched to its span."""
    noun: str = "Load"
    """What descriptions call it."""
    word: str = ""
    """What operators call it; its name where this is empty."""
    bar: Range | None = None
    """Ends of its bar on the operator's page; its span where they are not given."""

    @property
    def title(self) -> str:
        """What operators call it."""
        return self.word or self.name

    @property
    def column(self) -> str:
        """Its column in files and traces."""
        return LOAD_IN_WATTS if self.unit == "W" else "load"

    @property
    def stored_span(self) -> Range:
        """Its span as registers have it, in single precision."""
        low, high = struct.unpack("2f", struct.pack("2f", *self.span))
        return low, high


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """What the optimiser expects of the load or of another disturbance, steps held."""

    name: str
    """Of the load, or of a state that is a disturbance."""
    ticks: tuple[int, ...]
    """From 0, rising."""
    values: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Bath:
    """A bath of liquid that the cold end of a refrigerator fills, and the load boils off: the signals that make it one.

    Its level integrates. Targets, the limit of the feed, the weights of states and the cool-down are laws of such a
    plant, whatever its signals are called and in which order they are. All but states are names of inputs and outputs.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}
    """For process files, whose section `bath` this is."""

    level: str
    """Output with a band that integrates."""
    temperature: str
    """Output: of what leaves the bath, as warm as the liquid where there is some."""
    feed: str
    """Input: opening of the valve that fills it, a Joule-Thomson valve."""
    feed_temperature: str
    """Output: before that valve."""
    heater: str
    """Input: power that boils liquid off beside the load."""
    turbine_valve: str
    """Input: opening of the valve before the turbine."""
    turbine_outlet: str
    """Output with a band: temperature behind the turbine, which falls with cold in excess."""
    turbine_speed: str = ""
    """Output that may be 0 while all others move; empty where it is not measured."""
    turbine_pressures: tuple[str, ...] = ()
    """Outputs: before and behind the turbine, by which it is known whether it may stand; with `turbine_speed`."""
    pressure_state: str = ""
    """State that weighs as a pressure in the cost; none where it is empty, here and below."""
    level_state: str = ""
    """State that weighs as the level."""
    temperature_states: tuple[str, ...] = ()
    """States whose mean weighs as a temperature."""
    holdable_load: Range | None = None
    """Loads that some inputs hold at rest within the bands, in the load's unit; its span where it is not known."""
    load_reserve: float = 0.0
    """How near an estimated load may come to the largest one that the linear model holds."""
    least_load_error: float = 0.0
    """What the least load that the linear model holds is too high by, until the error of the turbine's outlet is known.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """All inputs of such a plant."""
        return self.feed, self.heater, self.turbine_valve

    @property
    def banded(self) -> tuple[str, ...]:
        """Outputs that have a band."""
        return self.level, self.turbine_outlet

    @property
    def outputs(self) -> tuple[str, ...]:
        """All outputs that it names."""
        speed = (self.turbine_speed,) if self.turbine_speed else ()
        return (*self.banded, self.temperature, self.feed_temperature, *speed, *self.turbine_pressures)

    @property
    def states(self) -> tuple[str, ...]:
        """The states that it names."""
        return (*filter(None, (self.pressure_state, self.level_state)), *self.temperature_states)


FURTHEST_WEIGHT: Final = 1e5
"""Largest factor between a weight of the cost and the process's own, or the usual one.

With `violation_weight` 1e6 times as large J of the cold box is 1.4 times as large, with 1e10 its inputs do not move:
the other terms of the cost are below the 7 digits of single precision.
"""

NO_LOAD: Final = Load(name="no load", unit="", span=(0.0, 1.0), walk=1e-6)
"""The load of a process that has none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Process:
    """A process with its time, its signals and its control problem: a value, equal to any of the same content.

    Raises:
        ValueError: Names are used twice, or a loop or a bath names signals that there are not.
    """

    name: str
    tick_s: float
    """The basic period tau_1."""
    ticks_per_sample: int
    """Ticks of a sampling period of the prediction model, which is the longest updating period."""
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    states: tuple[State, ...]
    load: Load
    decision_instants: tuple[int, ...]
    constraint_instants: tuple[int, ...]
    constants: tuple[str, ...]
    """Outputs whose constant error is told from states, load and the other constants: estimated by default."""
    iterations: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """See `share`; what is not named is 1."""
    disturbances: tuple[str, ...] = ()
    """Outputs that measure a disturbance beside the load."""
    forecasts: tuple[Forecast, ...] = ()
    mimic: str = ""
    """Drawing for the operator's page, an SVG text; empty where there is none."""
    shipped_mimic: str = ""
    """Path of a drawing that comes with the page, whose values name their registers."""
    bath: Bath | None = None
    """Which signals are those of a bath with a cold end; None where it is another kind of plant."""
    moves_as_one: bool = False
    """Whether all outputs move when any do: one that rests meanwhile is frozen, whatever the inputs do."""
    tuned: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    """Settings of the preset `tuned`, by section; an estimate of the constants of all outputs where there are none. In
    `unmeasured` is what `estimator` has instead where the load is not measured."""
    plants: tuple[str, ...] = ("of-process",)
    """Kinds of plant that simulate it, by their names in the configuration; the first by default."""
    decimals: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    """Digits after the point on the page, by unit; from noise and rates where a unit is not named."""
    notable: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """How much plant and model differ at least for a word on the page, by unit; likewise."""

    def __post_init__(self) -> None:
        for what in (self.inputs, self.outputs, self.states):
            names = [each.name for each in what]
            if len(set(names)) < len(names):
                raise ValueError(f"{next(name for name in names if names.count(name) > 1)} is declared twice")
        known = {each.name for each in self.inputs}
        for output in self.banded:
            loop = output.band.loop if output.band else None
            if loop is not None and loop.input not in known:
                raise ValueError(f"the loop of {output.name} moves {loop.input}, which is no input")
        if self.bath is not None:
            self._check_bath(self.bath)

    def _check_bath(self, bath: Bath) -> None:
        inputs = [one.name for one in self.inputs]
        if sorted(bath.inputs) != sorted(inputs):
            raise ValueError(
                f"bath: its inputs are feed, heater and turbine_valve, each once; the process has {', '.join(inputs)}"
            )
        self._check_names("output", bath.outputs, self.outputs)
        self._check_names("output with a band", bath.banded, self.banded)
        self._check_names("state", bath.states, self.states)
        if len(bath.turbine_pressures) != 2 * bool(bath.turbine_speed):
            raise ValueError("bath: give turbine_speed with two turbine_pressures, before and behind it, or neither")
        self._check_laws(bath)

    def _check_laws(self, bath: Bath) -> None:
        """Check that units, loops and loads are those that the laws of a bath are written for."""
        units = dict.fromkeys((bath.level, bath.feed), "%") | dict.fromkeys(
            (bath.temperature, bath.feed_temperature, bath.turbine_outlet), "K"
        )
        declared = {one.name: one.unit for one in self.inputs} | {one.name: one.unit for one in self.outputs}
        for name, unit in units.items():
            if declared[name] != unit:
                raise ValueError(f"bath: {name} has to be in {unit}, not in '{declared[name]}'")
        loops = {bath.level: bath.heater, bath.turbine_outlet: bath.turbine_valve}
        for name, moved in loops.items():
            band = next(output.band for output in self.banded if output.name == name)
            if band and band.loop and band.loop.input != moved:
                raise ValueError(f"bath: the loop of {name} moves {band.loop.input}; a cool-down needs it on {moved}")
        if not self.has_load:
            raise ValueError("bath: declare the load that boils it off")
        if bath.holdable_load is not None and bath.holdable_load[0] >= bath.holdable_load[1]:
            raise ValueError("bath: holdable_load: give the least load that can be held, then the largest")
        if min(bath.load_reserve, bath.least_load_error) < 0.0:
            raise ValueError("bath: load_reserve and least_load_error are 0 or more")

    @staticmethod
    def _check_names(what: str, names: Sequence[str], declared: Sequence[Output | State]) -> None:
        for name in names:
            if name not in [each.name for each in declared]:
                raise ValueError(f"bath: {name or 'an empty name'} is no {what}")
            if names.count(name) > 1:
                raise ValueError(f"bath: {name} is named twice")

    @cached_property
    def _content(self) -> str:
        return json.dumps(self.document(), sort_keys=True)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Process) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)

    def __reduce__(self) -> tuple[Any, ...]:
        return Process.of, (self.document(),)

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """In the order of the inputs, which is that of u."""
        return tuple(one.name for one in self.inputs)

    @cached_property
    def input_units(self) -> tuple[str, ...]:
        """In the same order."""
        return tuple(one.unit for one in self.inputs)

    @cached_property
    def output_names(self) -> tuple[str, ...]:
        """In the order of the outputs, which is that of y."""
        return tuple(one.name for one in self.outputs)

    @cached_property
    def output_units(self) -> tuple[str, ...]:
        """In the same order."""
        return tuple(one.unit for one in self.outputs)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """In the order of the states, which is that of x."""
        return tuple(one.name for one in self.states)

    @cached_property
    def state_units(self) -> tuple[str, ...]:
        """In the same order."""
        return tuple(one.unit for one in self.states)

    @cached_property
    def controlled(self) -> tuple[int, ...]:
        """Places of the outputs that have a band."""
        return tuple(place for place, one in enumerate(self.outputs) if one.band is not None)

    @cached_property
    def sampling_period_s(self) -> float:
        """Sampling period of the prediction model, s of plant time; the longest updating period."""
        return self.ticks_per_sample * self.tick_s

    @property
    def stretch(self) -> float:
        """How much longer a tick is than that which default times of the settings are for."""
        return self.tick_s / REFERENCE_TICK_S

    @property
    def tick_unit(self) -> str:
        """Unit of what is counted in ticks."""
        return f"{self.tick_s:g} s"

    @property
    def span_of_inputs(self) -> Range:
        """No input is outside."""
        return min(one.span[0] for one in self.inputs), float(max(one.span[1] for one in self.inputs))

    @property
    def has_station(self) -> bool:
        """Whether its plant may be a refrigerator, with a compression station and property tables."""
        return "refrigerator" in self.plants

    @property
    def horizon_s(self) -> float:
        """Of the prediction, in seconds."""
        return self.decision_instants[-1] * self.tick_s * self.ticks_per_sample

    @property
    def has_load(self) -> bool:
        """Whether there is a disturbance."""
        return self.load.name != NO_LOAD.name

    @property
    def measured_disturbances(self) -> tuple[Output, ...]:
        """The outputs that are its `disturbances`."""
        return tuple(output for output in self.outputs if output.name in self.disturbances)

    def share(self, of: str) -> float:
        """Return the time of a solver's iteration, or of a preparation, over that with the cold box's problem."""
        return self.iterations.get(of, 1.0)

    @property
    def banded(self) -> tuple[Output, ...]:
        """Outputs that have a band."""
        return tuple(output for output in self.outputs if output.band is not None)

    @property
    def bands(self) -> tuple[Band, ...]:
        """Their bands."""
        return tuple(output.band for output in self.outputs if output.band is not None)

    @property
    def dead_bands(self) -> tuple[float, ...]:
        """Their dead bands."""
        return tuple(band.dead_band for band in self.bands)

    def document(self) -> dict[str, Any]:
        """Return this as plain data, tuples as lists."""
        plain: dict[str, Any] = _plain({each.name: getattr(self, each.name) for each in fields(self)})
        return plain

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """Return the process of a document.

        Raises:
            KeyError, TypeError, ValueError: It is not one that `document` makes.
        """
        made: Self = _made_of(cls, document)
        return made


def _plain(value: Any) -> Any:  # noqa: ANN401 of any field
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, tuple | list) else value


def _made_of(kind: Any, value: Any) -> Any:  # noqa: ANN401 of any field
    """Return a value of a declared type from plain data."""
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        unknown = set(value) - set(hints)
        if unknown:
            raise TypeError(f"{getattr(kind, '__name__', kind)}: {min(unknown)} is unknown")
        return kind(**{name: _made_of(hints[name], each) for name, each in value.items()})  # type: ignore[operator]
    arguments = get_args(kind)
    if isinstance(value, list):
        return tuple(_made_of(arguments[0] if arguments else Any, each) for each in value)
    if value is not None and type(None) in arguments:
        return _made_of(next(each for each in arguments if each is not type(None)), value)
    if isinstance(value, Mapping):
        return {name: _made_of(arguments[1] if arguments else Any, each) for name, each in value.items()}
    return value
