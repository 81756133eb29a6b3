"""What a process file says, checked when it is read; `docs/keys.md` is made of what is said of its keys here."""

from keyword import iskeyword
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeFloat,
    PositiveFloat,
    model_validator,
)

from coldloop.config import load_configuration
from coldloop.process.declaration import FURTHEST_WEIGHT, Bath

MOST_SIGNALS: Final = 32
"""Outputs at most: registers have a bit for each."""
LISTING: Final = "`coldloop docs keys` lists all keys"

RESERVED: Final = frozenset((
    "tick", "session", "holder", "generation", "crc", "mode", "update", "u", "time_s", "load", "load_w", "cause",
    "driver", "bad_sensors", "stage_cost", "tau_u_s", "iterations", "j", "model_range", "none",
))  # fmt: skip
"""Fields of registers and columns of a trace, in small letters."""

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,31}$")]
Span = tuple[FiniteFloat, FiniteFloat]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


def _near(given: float | None, usual: float, what: str) -> None:
    if given is not None and not usual / FURTHEST_WEIGHT <= given <= usual * FURTHEST_WEIGHT:
        raise ValueError(f"{what} = {given:g} is further than a factor of {FURTHEST_WEIGHT:g} from the usual one, "
                         f"{usual:g}: single precision loses the other terms of the cost")  # fmt: skip


def _rising(span: Span, what: str) -> None:
    if span[0] >= span[1]:
        raise ValueError(f"{what}: give the lower end first")


class LoopSection(_Section):
    """A PI loop of the fallback, u = gain (e + 1/T_i integral of e) with e = setpoint - y."""

    input: Name
    """That it moves; each loop has its own."""
    gain: FiniteFloat
    """In the unit of the input per unit of the output, with the sign of the process."""
    integral_time_s: PositiveFloat
    """T_i, s."""


class InputSection(_Section):
    """A manipulated input."""

    name: Name
    """Letters, digits and underscores; of all signals another one."""
    variable: str | None = None
    """Its name in an FMU, if it is not `name`."""
    unit: str = ""
    """Shown with every value; an FMU may have it."""
    description: str = ""
    """Of its register."""
    at: FiniteFloat
    """At the operating point."""
    low: FiniteFloat
    """Least value that the actuator takes."""
    high: FiniteFloat
    """Largest value."""
    rate: PositiveFloat
    """Largest change in a sampling period."""
    safe: FiniteFloat | None = None
    """What the rack applies when nobody drives it, if so configured; the operating point if not given."""
    weight: PositiveFloat | None = None
    """In the cost, per square of its deviation; 0.01 over the square of a quarter of its range if not given."""

    @model_validator(mode="after")
    def _inside(self) -> Self:
        _rising((self.low, self.high), f"{self.name}: low, high")
        for what, value in (("at", self.at), ("safe", self.at if self.safe is None else self.safe)):
            if not self.low <= value <= self.high:
                raise ValueError(f"{self.name}: {what} = {value:g} is outside low to high")
        _near(self.weight, self.usual_weight, f"{self.name}: weight")
        return self

    @property
    def usual_weight(self) -> float:
        """What `weight` is if it is not given."""
        return 0.01 / ((self.high - self.low) / 4) ** 2


class OutputSection(_Section):
    """A measured output."""

    name: Name
    """Letters, digits and underscores; of all signals another one."""
    variable: str | None = None
    """Its name in an FMU, if it is not `name`."""
    unit: str = ""
    """Shown with every value; an FMU may have it."""
    range: Span
    """Of its sensor: what is outside is no measurement."""
    noise: PositiveFloat
    """Standard deviation of its sensor."""
    at: FiniteFloat | None = None
    """At the operating point; found from the equations where the plant has them."""
    band: Span | None = None
    """What it is to be kept within."""
    setpoint: FiniteFloat | None = None
    """What it is to be kept at, instead of a band."""
    tolerance: PositiveFloat | None = None
    """Deviation from the setpoint that is none to indicators, figures and alarms; 1 % of `range` if not given."""
    penalty: PositiveFloat | None = None
    """rho, per square of what band or setpoint is missed by and sample; if not given 1 over the square of a twentieth
    of the band, or of the tolerance."""
    alarm: Span | None = None
    """Outside of it the alarm is raised; the band, or the setpoint with its tolerance, if not given."""
    dead_band: NonNegativeFloat | None = None
    """Excess over the band up to which it does not count as outside, for alarms, indicators and the page; if not given
    3 times `noise`, and 1 % of the band at least; a setpoint's is its tolerance."""
    weight: NonNegativeFloat = 0.0
    """In the cost, per square of its deviation from the operating point."""
    loop: LoopSection | None = None
    """The PI loop of the fallback that controls it; none if not given."""

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
        if self.band is None and self.dead_band is not None:
            raise ValueError(f"{self.name}: a dead_band needs a band; leave it out: a setpoint has its tolerance")
        if self.edges is not None:
            _near(self.penalty, self.usual_penalty(self.edges), f"{self.name}: penalty")
        return self

    def usual_penalty(self, edges: Span) -> float:
        """Return what `penalty` is if it is not given."""
        return 1.0 / ((edges[1] - edges[0]) / (20 if self.setpoint is None else 2)) ** 2

    @property
    def usual_dead_band(self) -> float:
        """What `dead_band` is if it is not given."""
        return max(3.0 * self.noise, 0.01 * (self.band[1] - self.band[0])) if self.band else 0.0

    @property
    def edges(self) -> Span | None:
        """The band, or the setpoint less and plus its tolerance; None where it is only measured."""
        if self.setpoint is None:
            return self.band
        tolerance = self.tolerance or 0.01 * (self.range[1] - self.range[0])
        return self.setpoint - tolerance, self.setpoint + tolerance


class _OutsideSection(_Section):
    """What acts on the plant and is no input."""

    name: Name
    """Letters, digits and underscores; of all signals another one."""
    variable: str | None = None
    """Its name in an FMU, if it is not `name`."""
    unit: str = ""
    """Shown with every value; an FMU may have it."""
    at: FiniteFloat
    """At the operating point."""
    span: Span
    """Within which it stays."""
    walk: PositiveFloat | None = None
    """Random walk that the estimator expects, of the load of what is not measured of it, per square root of a sampling
    period; 1 % of the span if not given."""
    forecast: str | None = None
    """CSV file with the columns time_s and `name`, steps held: what the optimiser expects; it holds if not given."""

    @model_validator(mode="after")
    def _inside(self) -> Self:
        _rising(self.span, f"{self.name}: span")
        if not self.span[0] <= self.at <= self.span[1]:
            raise ValueError(f"{self.name}: at = {self.at:g} is outside its span")
        return self

    @property
    def usual_walk(self) -> float:
        """The walk, given or not."""
        return self.walk or 0.01 * (self.span[1] - self.span[0])


class LoadSection(_OutsideSection):
    """The load: a disturbance that is measured, and that operators and `--load` set; leave it out if there is none."""


class DisturbanceSection(_OutsideSection):
    """A disturbance beside the load: a state of the model that wanders, and an output where it is measured."""

    noise: PositiveFloat | None = None
    """Standard deviation of its sensor; not measured but estimated if not given."""
    course: str | None = None
    """CSV file with the columns time_s and `name`, steps held: what the simulated plant meets; nothing if not given."""


class LagSection(_Section):
    """gain exp(-delay s) / (time constant s + 1) from an input, the load or another disturbance, to an output."""

    output: Name
    """That it moves."""
    source: Name
    """An input, the load or another disturbance."""
    gain: FiniteFloat
    """At rest, in the unit of the output per unit of the source."""
    time_constant_s: PositiveFloat
    """Of the lag, s."""
    delay_s: NonNegativeFloat = 0.0
    """Dead time, s; whole ticks on the simulated plant."""


class PlantSection(_Section):
    """Where the plant comes from: one of these."""

    python: Annotated[str, Field(pattern=r"^[^:]+\.py:[A-Za-z_]\w*$")] | None = None
    """`file.py:Class`, the file beside the process file."""
    installed: str | None = None
    """Such a class of a package that is installed: the name of its entry point, of the group `coldloop.plants`."""
    matrices: str | None = None
    """NPZ or JSON file with A, B, C and, where there are such, D, F, G: dx/dt = A x + B u + F w, y = C x + D u + G w.

    All are deviations from the operating point, time in seconds. F and G have a column for the load and one for each
    other disturbance. Or `file.py:NAME`, a state space in continuous time, as of python-control, whose inputs are those
    of the file, then the load and the other disturbances."""
    transfer_functions: tuple[LagSection, ...] | None = None
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
        if sum(getattr(self, each) is not None for each in sources) != 1:
            raise ValueError(f"plant: give one of {', '.join(sources)}")
        if self.fmu is None and (self.start or self.steps_per_tick or self.rest_s):
            raise ValueError("plant: start, steps_per_tick and rest_s are for an FMU")
        return self


class StateSection(_Section):
    """Process noise of a state."""

    name: Name
    """Of the plant's states."""
    walk: PositiveFloat
    """Per square root of a sampling period."""


class PredictionSection(_Section):
    """Decision and constraint instants, in sampling periods, and where the model is from, if not from the plant."""

    step_test: str | None = None
    """CSV file as of `plant.step_test`: the controller's model is found in it, and the plant hides its states."""
    decision_instants: tuple[Annotated[int, Field(ge=1, le=400)], ...] = (1, 2, 4, 8, 16, 30, 60)
    """At which the inputs are free, rising; the last one is the horizon."""
    constraint_instants: tuple[Annotated[int, Field(ge=1, le=400)], ...] = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 44, 60)
    """At which bands and setpoints count, rising, within the horizon; `coldloop design` compares sets."""

    @model_validator(mode="after")
    def _rising(self) -> Self:
        for name in ("decision_instants", "constraint_instants"):
            instants = getattr(self, name)
            if not instants or list(instants) != sorted(set(instants)):
                raise ValueError(f"prediction.{name}: give rising numbers of sampling periods, from 1")
        if self.constraint_instants[-1] > self.decision_instants[-1]:
            raise ValueError("prediction: the last decision instant is the horizon; constraints end within it")
        return self


class ProcessFile(_Section):
    """A process file."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,31}$")]
    """Small letters, digits and hyphens."""
    tick_s: Annotated[float, Field(gt=1e-4, le=3600.0)] = 0.25
    """The basic period, in which PLCs scan."""
    ticks_per_sample: Annotated[int, Field(ge=2, le=100)] = 20
    """Ticks of a sampling period of the prediction model, which is the longest updating period."""
    plant: PlantSection
    """Where the plant comes from."""
    inputs: Annotated[tuple[InputSection, ...], Field(min_length=1, max_length=MOST_SIGNALS)]
    """What the controller moves."""
    outputs: Annotated[tuple[OutputSection, ...], Field(min_length=1, max_length=MOST_SIGNALS)]
    """What is measured; at least one has a band or a setpoint."""
    load: LoadSection | None = None
    """The disturbance that operators and `--load` set."""
    disturbances: Annotated[tuple[DisturbanceSection, ...], Field(max_length=MOST_SIGNALS)] = ()
    """Others."""
    states: tuple[StateSection, ...] = ()
    """Process noises of states by name; of others 1 % of what they move by with the inputs, a sample."""
    bath: Bath | None = None
    """Which signals are those of a bath that the cold end of a refrigerator fills; leave it out for other plants."""
    prediction: PredictionSection = PredictionSection()
    """The problem that is solved on-line."""
    mimic: str | None = None
    """SVG file with a drawing for the operator's page, beside the process file."""

    @property
    def horizon_s(self) -> float:
        """Of the prediction, in seconds."""
        return self.prediction.decision_instants[-1] * self.tick_s * self.ticks_per_sample

    @property
    def outside(self) -> tuple[LoadSection | DisturbanceSection, ...]:
        """The load, if there is one, and the other disturbances."""
        return (*((self.load,) if self.load else ()), *self.disturbances)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        signals = (*self.inputs, *self.outputs, *self.outside)
        names = [each.name for each in signals]
        lower = [name.lower() for name in names]
        twice = next((name for name in names if lower.count(name.lower()) > 1), None)
        if twice is not None:
            raise ValueError(f"{twice}: two signals have this name (small and capital letters are the same)")
        reserved = RESERVED.intersection(lower) | {name for name in names if iskeyword(name) or iskeyword(name.lower())}
        if reserved:
            raise ValueError(f"{min(reserved)}: a register, a column or Python has this name already; choose another")
        if not any(output.edges for output in self.outputs):
            raise ValueError("outputs: none has a band or a setpoint; give one to at least one of them")
        if self.prediction.step_test and (self.plant.matrices or self.plant.step_test):
            raise ValueError("prediction.step_test: plant.matrices and plant.step_test are a model already; keep one")
        if self.plant.fmu is None and any(one.variable for one in signals):
            raise ValueError(f"{next(one.name for one in signals if one.variable)}: variable is for an FMU")
        inputs = {one.name for one in self.inputs}
        for output in self.outputs:
            if output.loop is not None and output.loop.input not in inputs:
                raise ValueError(f"{output.name}: its loop moves {output.loop.input}, which is no input")
        moved = [output.loop.input for output in self.outputs if output.loop is not None]
        shared = next((name for name in moved if moved.count(name) > 1), None)
        if shared is not None:
            raise ValueError(f"{shared}: two loops move this input; give each one of its own")
        return self


def read_process_file(path: Path) -> ProcessFile:
    """Return what a process file says.

    Raises:
        ConfigurationError: One line that names file, key and remedy.
    """
    return load_configuration(ProcessFile, file=path, environment={}, option="FILE", listing=LISTING).settings
