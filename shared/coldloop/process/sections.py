"""Sections of a process, as a process file has them; `docs/keys.md` is made of what is said of their keys here.

What is not given follows from what is, here or when the model is made (`coldloop_rig.process_file.making`).
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Final, Self

import pydantic
from pydantic import Field, FiniteFloat, NonNegativeFloat, PositiveFloat, model_validator

LOAD_IN_WATTS: Final = "load_w"
"""Column of a load in watts; in a file it is understood for any load."""
FURTHEST_WEIGHT: Final = 1e5
"""Largest factor between a weight of the cost and the process's own, or the usual one.

With `violation_weight` 1e6 times as large J of the cold box is 1.4 times as large, with 1e10 its inputs do not move:
the other terms of the cost are below the 7 digits of single precision.
"""
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,31}$")]
Range = tuple[FiniteFloat, FiniteFloat]
Limits = tuple[int | FiniteFloat, int | FiniteFloat]
"""Limits of registers, whose digest knows whole numbers."""


class Section(pydantic.BaseModel):
    """A section of a process file."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", ignored_types=(cached_property,))

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with changes, without what was computed of the original."""
        copied = super().model_copy(update=update, deep=deep)
        for name in copied.__dict__.keys() - type(self).model_fields.keys():
            del copied.__dict__[name]
        return copied


def _near(given: float | None, usual: float, what: str) -> None:
    if given is not None and not usual / FURTHEST_WEIGHT <= given <= usual * FURTHEST_WEIGHT:
        raise ValueError(f"{what} = {given:g} is further than a factor of {FURTHEST_WEIGHT:g} from the usual one, "
                         f"{usual:g}: single precision loses the other terms of the cost")  # fmt: skip


def _width(span: Limits) -> float:
    return span[1] - span[0]


def _rising(span: Range, what: str) -> None:
    if span[0] >= span[1]:
        raise ValueError(f"{what}: give the lower end first")


class Loop(Section):
    """A PI loop of the fallback, u = gain (e + 1/T_i integral of e) with e = setpoint - y."""

    input: Name
    """Input that it moves; each loop has its own."""
    gain: FiniteFloat
    """Gain, in the unit of the input per unit of the output, with the sign of the process."""
    integral_time_s: PositiveFloat
    """T_i, s."""


def _usual_weight(low: float, high: float) -> float:
    return 0.01 / ((high - low) / 4) ** 2 if high > low else 1.0


class Signal(Section):
    """An input, an output or a disturbance."""

    name: Name
    """Letters, digits and underscores; of all signals another one."""
    variable: str | None = None
    """Its name in an FMU, if it is not `name`."""
    unit: str = ""
    """Shown with every value; an FMU may have it."""


class Input(Signal):
    """A manipulated input."""

    description: str = Field(default_factory=lambda given: given["name"])
    """Description of its register; its name if not given."""
    at: FiniteFloat
    """At the operating point."""
    low: FiniteFloat
    """Least value that the actuator takes."""
    high: FiniteFloat
    """Largest value."""
    rate: PositiveFloat
    """Largest change in a sampling period."""
    safe: FiniteFloat = Field(default_factory=lambda given: given["at"])
    """Safe value, which the rack applies when nobody drives it, if so configured; the operating point if not given."""
    weight: PositiveFloat = Field(default_factory=lambda given: _usual_weight(given["low"], given["high"]))
    """Weight in the cost, per square of its deviation; 0.01 over the square of a quarter of its range if not given."""
    scale: PositiveFloat = Field(default_factory=lambda given: (given["high"] - given["low"]) / 4)
    """Size of it in the problem; a quarter of its range if not given."""
    walk: PositiveFloat = Field(default_factory=lambda given: given["rate"] / 10)
    """Random walk of its bias, per square root of a sampling period; a tenth of `rate` if not given."""
    has_constant: bool = True
    """Whether an input bias is observable separately from the load."""
    tag: str = Field(default_factory=lambda given: given["name"].lower())
    """Its name in commands; its name in small letters if not given."""
    span: Limits = Field(default_factory=lambda given: (min(given["low"], 0.0), max(given["high"], 0.0)))
    """Range of its registers; its range and 0 if not given."""
    bar: Range | None = None
    """Ends of its bar on the operator's page; from its range if not given."""

    @model_validator(mode="after")
    def _inside(self) -> Self:
        _rising((self.low, self.high), f"{self.name}: low, high")
        for what, value in (("at", self.at), ("safe", self.safe)):
            if not self.low <= value <= self.high:
                raise ValueError(f"{self.name}: {what} = {value:g} is outside low to high")
        _near(self.weight, _usual_weight(self.low, self.high), f"{self.name}: weight")
        return self


def _edges(given: dict[str, Any]) -> Range | None:
    setpoint, tolerance = given["setpoint"], given["tolerance"]
    return given["band"] if setpoint is None else (setpoint - tolerance, setpoint + tolerance)


def _usual_penalty(given: dict[str, Any]) -> float | None:
    edges = _edges(given)
    if edges is None or edges[0] >= edges[1]:
        return None
    return float(1.0 / ((edges[1] - edges[0]) / (20 if given["setpoint"] is None else 2)) ** 2)


def _usual_dead_band(given: dict[str, Any]) -> float:
    band = given["band"]
    return max(3.0 * given["noise"], 0.01 * (band[1] - band[0])) if band else 0.0


class Output(Signal):
    """A measured output."""

    range: Range
    """Range of its sensor: a reading outside is no measurement."""
    noise: PositiveFloat
    """Standard deviation of its sensor."""
    at: FiniteFloat | None = None
    """At the operating point; found from the equations where the plant has them."""
    band: Range | None = None
    """Band that it is to be kept within."""
    setpoint: FiniteFloat | None = None
    """Setpoint that it is to be kept at, instead of a band."""
    tolerance: PositiveFloat | None = Field(
        default_factory=lambda given: None if given["setpoint"] is None else 0.01 * _width(given["range"])
    )
    """Deadband on either side of the setpoint, for indicators, figures and alarms; 1 % of `range` if not given."""
    penalty: PositiveFloat | None = Field(default_factory=_usual_penalty)
    """rho, per square of what band or setpoint is missed by and sample; if not given 1 over the square of a twentieth
    of the band, or of the tolerance."""
    alarm: Range | None = None
    """Outside of it the alarm is raised; the band, or the setpoint with its tolerance, if not given."""
    dead_band: NonNegativeFloat = Field(default_factory=_usual_dead_band)
    """Excess over the band up to which it does not count as outside, for alarms, indicators and the page; if not given
    3 times `noise`, and 1 % of the band at least; a setpoint's is its tolerance."""
    weight: NonNegativeFloat = 0.0
    """Weight in the cost, per square of its deviation from the operating point."""
    loop: Loop | None = None
    """The PI loop of the fallback that controls it; none if not given."""
    alarm_word: str = ""
    """Name of its alarm; `NAME outside its band` if not given."""
    quantity: str = ""
    """level, speed, temperature or pressure: range and noise are then those of the settings of this kind of sensor."""
    allowance: NonNegativeFloat = 0.0
    """Allowance for a residual of a plant that differs from its model, in its unit."""
    bar: Range | None = None
    """Ends of its bar on the operator's page; from its band, or the range of its sensor, if not given."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _rising(self.range, f"{self.name}: range")
        if self.at is not None and not self.range[0] <= self.at <= self.range[1]:
            raise ValueError(f"{self.name}: at = {self.at:g} is outside its range")
        if self.band is not None:
            _rising(self.band, f"{self.name}: band")
        if self.setpoint is None:
            if self.tolerance is not None:
                raise ValueError(f"{self.name}: a tolerance needs a setpoint")
        elif self.band is not None:
            raise ValueError(f"{self.name}: give a band or a setpoint")
        elif not self.range[0] <= self.setpoint <= self.range[1]:
            raise ValueError(f"{self.name}: setpoint = {self.setpoint:g} is outside its range")
        edges = self.edges
        if edges is None and any(each is not None for each in (self.loop, self.penalty, self.alarm)):
            raise ValueError(f"{self.name}: a loop, a penalty or an alarm needs a band or a setpoint")
        if edges is not None and self.alarm is not None:
            _rising(self.alarm, f"{self.name}: alarm")
            if self.alarm[0] > edges[0] or self.alarm[1] < edges[1]:
                raise ValueError(f"{self.name}: alarm begins inside {edges[0]:g} to {edges[1]:g}; widen it")
        return self

    @model_validator(mode="after")
    def _weighed(self) -> Self:
        if self.band is None and self.dead_band:
            raise ValueError(f"{self.name}: a dead_band needs a band; leave it out: a setpoint has its tolerance")
        if (usual := _usual_penalty(vars(self))) is not None:
            _near(self.penalty, usual, f"{self.name}: penalty")
        return self

    @property
    def edges(self) -> Range | None:
        """The band, or the setpoint less and plus its tolerance; None where it is only measured."""
        return _edges(vars(self))

    @cached_property
    def kept(self) -> "Band | None":
        """Band that it is to be kept within; None where it is only measured."""
        if self.edges is None or self.penalty is None:
            return None
        low, high = self.edges
        at_rest = self.setpoint if self.at is None else self.at
        return Band(
            low=low, high=high, weight=self.penalty, margin=0.0 if self.setpoint is None else (high - low) / 2,
            alarm=self.alarm, dead_band=self.dead_band, loop=self.loop, alarm_word=self.alarm_word,
            setpoint_offset=0.0 if self.setpoint is None else self.setpoint - (at_rest or 0.0),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Band:
    """Band that an output is to be kept within, as controllers take it."""

    low: float
    high: float
    weight: float
    """rho, per square of what the band is missed by and sample."""
    margin: float
    """How far inside it the rows of the problem are: half of it where there is a setpoint, in its middle."""
    alarm: Range | None
    """Outside of it the alarm is raised; the band where it is None."""
    dead_band: float
    """Excess up to which the output does not count as outside, in its unit: for alarms, indicators and the page."""
    loop: Loop | None
    alarm_word: str
    setpoint_offset: float
    """Setpoint of the loop less the output at the operating point, in the unit of the output."""


class Outside(Signal):
    """Quantity that acts on the plant and is no input."""

    at: FiniteFloat
    """At the operating point."""
    span: Limits
    """Within which it stays."""
    walk: PositiveFloat = Field(default_factory=lambda given: 0.01 * _width(given["span"]))
    """Random walk that the estimator expects of the part of the load that is not measured, per square root of a
    sampling period; 1 % of the span if not given."""
    forecast: str | None = None
    """CSV file with the columns time_s and `name`, steps held: what the optimiser expects; it holds if not given."""

    @model_validator(mode="after")
    def _inside(self) -> Self:
        _rising(self.span, f"{self.name}: span")
        if not self.span[0] <= self.at <= self.span[1]:
            raise ValueError(f"{self.name}: at = {self.at:g} is outside its span")
        return self


class Load(Outside):
    """The load: a disturbance that is measured, and that operators and `--load` set; leave it out if there is none."""

    noun: str = "Load"
    """Noun for it in descriptions."""
    word: str = ""
    """Operators' name for it; its name if not given."""
    bar: Range | None = None
    """Ends of its bar on the operator's page; its span if not given."""
    has_named_loads: bool = False
    """Whether the loads that have a name are its own; elsewhere they are stretched to its span."""

    @property
    def title(self) -> str:
        """Operators' name for it."""
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


NO_LOAD: Final = Load(name="no_load", at=0.0, span=(0.0, 1.0), walk=1e-6)
"""The load of a process that has none."""


class Disturbance(Outside):
    """A disturbance beside the load: a state of the model that wanders, and an output where it is measured."""

    noise: PositiveFloat | None = None
    """Standard deviation of its sensor; not measured but estimated if not given."""
    course: str | None = None
    """CSV file with the columns time_s and `name`, steps held: what the simulated plant meets; nothing if not given."""


class Lag(Section):
    """gain exp(-delay s) / (time constant s + 1) from an input, the load or another disturbance, to an output."""

    output: Name
    """Output that it moves."""
    source: Name
    """An input, the load or another disturbance."""
    gain: FiniteFloat
    """At rest, in the unit of the output per unit of the source."""
    time_constant_s: PositiveFloat
    """Time constant of the lag, s."""
    delay_s: NonNegativeFloat = 0.0
    """Dead time, s; whole ticks on the simulated plant."""


class PlantSource(Section):
    """Source of the plant: one of the first six."""

    python: Annotated[str, Field(pattern=r"^[^:]+\.py:[A-Za-z_]\w*$")] | None = None
    """`file.py:Class`, the file beside the process file."""
    installed: str | None = None
    """Such a class of a package that is installed: the name of its entry point, of the group `coldloop.plants`."""
    matrices: str | None = None
    """NPZ or JSON file with A, B, C and, where there are such, D, F, G: dx/dt = A x + B u + F w, y = C x + D u + G w.

    All are deviations from the operating point, time in seconds. F and G have a column for the load and one for each
    other disturbance. Or `file.py:NAME`, a state space in continuous time, as of python-control, whose inputs are those
    of the file, then the load and the other disturbances."""
    transfer_functions: tuple[Lag, ...] | None = None
    """First-order lags with dead times."""
    step_test: str | None = None
    """CSV file with columns time_s, inputs, load and other disturbances (those that moved), outputs: the plant is the
    model that is found in it."""
    fmu: str | None = None
    """FMU for co-simulation, of FMI 2.0 or 3.0, beside the process file; the keys below are for it."""
    start: dict[str, float] = {}
    """Start values of its variables, by name."""
    steps_per_tick: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Steps that it is asked for in a tick; 1, or as many as its fixed step needs, if not given."""
    rest_s: PositiveFloat | None = None
    """How long it may take from its start to rest at the operating point, s; 24 horizons if not given."""

    @model_validator(mode="after")
    def _one(self) -> Self:
        sources = ("python", "installed", "matrices", "transfer_functions", "step_test", "fmu")
        if sum(getattr(self, each) is not None for each in sources) > 1:
            raise ValueError(f"plant: give one of {', '.join(sources)}")
        if self.fmu is None and (self.start or self.steps_per_tick or self.rest_s):
            raise ValueError("plant: start, steps_per_tick and rest_s are for an FMU")
        return self


class State(Section):
    """A state of the model; a file names those whose process noise it gives."""

    name: str
    """Name of one of the plant's states."""
    unit: str = ""
    """As the plant has it."""
    walk: PositiveFloat | None = None
    """Its process noise, per square root of a sampling period; of the cold box settings of the estimator say it."""


class Forecast(Section):
    """Forecast of the load or of another disturbance, as the optimiser expects it, steps held."""

    name: str
    """Name of the load, or of a state that is a disturbance."""
    ticks: tuple[int, ...]
    """Ticks from 0, rising."""
    values: tuple[FiniteFloat, ...]
    """Values from each of these ticks on."""


def rising_instants(instants: tuple[int, ...]) -> tuple[int, ...]:
    """Return instants of a prediction, which are sampling periods, if they rise from 1 on."""
    if not instants or instants[0] < 1 or list(instants) != sorted(set(instants)):
        raise ValueError("give rising numbers of sampling periods, from 1")
    return instants


class Instants(Section):
    """Decision and constraint instants, in sampling periods, and where the model is from, if not from the plant."""

    step_test: str | None = None
    """CSV file as of `plant.step_test`: the controller's model is found in it, and the plant hides its states."""
    decision_instants: tuple[Annotated[int, Field(ge=1, le=400)], ...] = (1, 2, 4, 8, 16, 30, 60)
    """Sampling periods at which the inputs are free, rising; the last one is the horizon."""
    constraint_instants: tuple[Annotated[int, Field(ge=1, le=400)], ...] = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 44, 60)
    """Sampling periods at which bands and setpoints count, rising, within the horizon; `coldloop design` compares sets.
    """

    _rising = pydantic.field_validator("decision_instants", "constraint_instants")(rising_instants)

    @model_validator(mode="after")
    def _within_the_horizon(self) -> Self:
        if self.constraint_instants[-1] > self.decision_instants[-1]:
            raise ValueError("prediction: the last decision instant is the horizon; constraints end within it")
        return self


class Bath(Section):
    """A bath of liquid that the cold end of a refrigerator fills, and the load boils off: the signals that make it one.

    Its level integrates. Targets, the limit of the feed, the weights of states and the cool-down are laws of such a
    plant, whatever its signals are called and in which order they are. All but states are names of inputs and outputs.
    """

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
    """Reserve of an estimated load below the largest one that the linear model holds."""
    least_load_error: float = 0.0
    """Error of the least load that the linear model holds (too high), until the error of the turbine's outlet is known.
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
