"""Declaration of a process for the PLCs: its signals, its time, what it may and what it should do.

A program is given its process with its model file (`coldloop.process.settings`). A process is what a process file says
(`docs/your-plant.md`), completed with what its model says; that of the cold box is `data/cold_box.toml`.
"""

import json
from functools import cached_property
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import Field, model_validator

from coldloop.process import sections
from coldloop.process.sections import NO_LOAD, Bath, Disturbance, Input, Load, Output, Range, State

LAST_TICK: Final = 2**32 - 2**16 - 1
"""Last tick of a session, after 34 years: what is planned from there still fits a register."""

LAST_NUMBER: Final = LAST_TICK
"""Largest number of an update, or of a sequence."""

REFERENCE_TICK_S: Final = 0.25
"""Tick that default times of the settings are for: the cold box's, tau_1 of the paper (section IV)."""
MOST_SIGNALS: Final = 32
"""Outputs at most: registers have a bit for each."""


def _each(signals: str, attribute: str) -> cached_property[tuple[str, ...]]:
    return cached_property(lambda process: tuple(getattr(one, attribute) for one in getattr(process, signals)))


class Process(sections.Section):
    """A process with its time, its signals and its control problem: a value, equal to any of the same content."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,31}$")]
    """Small letters, digits and hyphens."""
    tick_s: Annotated[float, Field(gt=1e-4, le=3600.0)] = 0.25
    """The basic period, in which PLCs scan."""
    ticks_per_sample: Annotated[int, Field(ge=2, le=100)] = 20
    """Ticks of a sampling period of the prediction model, which is the longest updating period."""
    plant: sections.PlantSource = sections.PlantSource()
    """Source of the plant."""
    inputs: Annotated[tuple[Input, ...], Field(min_length=1, max_length=MOST_SIGNALS)]
    """Inputs: what the controller moves."""
    outputs: Annotated[tuple[Output, ...], Field(min_length=1, max_length=MOST_SIGNALS)]
    """Outputs: what is measured; at least one has a band or a setpoint."""
    load: Load = NO_LOAD
    """The disturbance that operators and `--load` set."""
    disturbances: Annotated[tuple[Disturbance, ...], Field(max_length=MOST_SIGNALS)] = ()
    """Others."""
    states: tuple[State, ...] = ()
    """Process noises of states by name; of others 1 % of what they move by with the inputs, a sample."""
    bath: Bath | None = None
    """Signals of a bath that the cold end of a refrigerator fills; leave it out for other plants."""
    prediction: sections.Instants = sections.Instants()
    """The problem that is solved on-line."""
    mimic: str | None = None
    """SVG file with a drawing for the operator's page, beside the process file."""
    constants: tuple[str, ...] = ()
    """Outputs whose bias is estimated by default; those that the model tells apart if not given."""
    moves_as_one: bool = False
    """Whether all outputs move when any do: one that rests meanwhile is frozen, whatever the inputs do."""
    tuned: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Settings of the preset `tuned`, by section; an estimate of the constants of all outputs if not given. In
    `unmeasured` is what `estimator` has instead where the load is not measured."""
    decimals: dict[str, int] = Field(default_factory=dict)
    """Digits after the point on the page, by unit; from noise and rates if not given."""
    notable: dict[str, float] = Field(default_factory=dict)
    """How much plant and model differ at least for a word on the page, by unit; likewise."""
    plants: tuple[str, ...] = ("of-process",)
    """Kinds of plant that simulate it, by their names in the configuration; the first by default."""
    shipped_mimic: str = ""
    """Path of a drawing that comes with the page, whose values name their registers."""
    iterations: dict[str, float] = Field(default_factory=dict)
    """Found with the model: times of iterations and of a preparation, over those with the cold box's problem."""
    forecasts: tuple[sections.Forecast, ...] = ()
    """Found with the model: what the files say that load and disturbances name in `forecast`."""
    drawing: str = ""
    """Found with the model: the text of `mimic`."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for names in (self.input_names, self.output_names, self.state_names):
            if twice := next((name for name in names if names.count(name) > 1), None):
                raise ValueError(f"{twice} is declared twice")
        if not self.banded:
            raise ValueError("outputs: none has a band or a setpoint; give one to at least one of them")
        moved = [band.loop.input for band in self.bands if band.loop is not None]
        for output, band in zip(self.banded, self.bands, strict=True):
            if band.loop is not None and band.loop.input not in self.input_names:
                raise ValueError(f"{output.name}: its loop moves {band.loop.input}, which is no input")
        shared = next((name for name in moved if moved.count(name) > 1), None)
        if shared is not None:
            raise ValueError(f"{shared}: two loops move this input; give each one of its own")
        if self.bath is not None:
            self._check_bath(self.bath)
        return self

    def _check_bath(self, bath: Bath) -> None:
        if sorted(bath.inputs) != sorted(self.input_names):
            there = ", ".join(self.input_names)
            raise ValueError(f"bath: its inputs are feed, heater and turbine_valve, each once; the process has {there}")
        banded = tuple(one.name for one in self.banded)
        for what, names, known in (
            ("output", bath.outputs, self.output_names), ("output with a band", bath.banded, banded),
        ):  # fmt: skip
            for name in names:
                if name not in known:
                    raise ValueError(f"bath: {name or 'an empty name'} is no {what}")
                if names.count(name) > 1:
                    raise ValueError(f"bath: {name} is named twice")
        if len(bath.turbine_pressures) != 2 * bool(bath.turbine_speed):
            raise ValueError("bath: give turbine_speed with two turbine_pressures, before and behind it, or neither")
        self._check_laws(bath)

    def _check_laws(self, bath: Bath) -> None:
        """Check that units, loops and loads are those that the laws of a bath are written for."""
        temperatures = (bath.temperature, bath.feed_temperature, bath.turbine_outlet)
        units = dict.fromkeys((bath.level, bath.feed), "%") | dict.fromkeys(temperatures, "K")
        declared = {one.name: one.unit for one in self.inputs} | {one.name: one.unit for one in self.outputs}
        for name, unit in units.items():
            if declared[name] != unit:
                raise ValueError(f"bath: {name} has to be in {unit}, not in '{declared[name]}'")
        loops = {bath.level: bath.heater, bath.turbine_outlet: bath.turbine_valve}
        for name, moved in loops.items():
            band = next(output.kept for output in self.banded if output.name == name)
            if band and band.loop and band.loop.input != moved:
                raise ValueError(f"bath: the loop of {name} moves {band.loop.input}; a cool-down needs it on {moved}")
        if not self.has_load:
            raise ValueError("bath: declare the load that boils it off")
        if bath.holdable_load is not None and bath.holdable_load[0] >= bath.holdable_load[1]:
            raise ValueError("bath: holdable_load: give the least load that can be held, then the largest")
        if min(bath.load_reserve, bath.least_load_error) < 0.0:
            raise ValueError("bath: load_reserve and least_load_error are 0 or more")

    @cached_property
    def content(self) -> str:
        """All of it, as text."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Process) and self.content == other.content)

    def __hash__(self) -> int:
        return hash(self.content)

    input_names = _each("inputs", "name")
    """In the order of the inputs, which is that of u."""
    input_units = _each("inputs", "unit")
    """In the same order."""
    output_names = _each("outputs", "name")
    """In the order of the outputs, which is that of y."""
    output_units = _each("outputs", "unit")
    """In the same order."""
    state_names = _each("states", "name")
    """In the order of the states, which is that of x."""
    state_units = _each("states", "unit")
    """In the same order."""

    @cached_property
    def controlled(self) -> tuple[int, ...]:
        """Places of the outputs that have a band."""
        return tuple(place for place, one in enumerate(self.outputs) if one.edges is not None)

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
        """Horizon of the prediction, s."""
        return self.decision_instants[-1] * self.tick_s * self.ticks_per_sample

    @property
    def decision_instants(self) -> tuple[int, ...]:
        """Sampling periods at which the inputs are free."""
        return self.prediction.decision_instants

    @property
    def constraint_instants(self) -> tuple[int, ...]:
        """Sampling periods at which bands count."""
        return self.prediction.constraint_instants

    @property
    def outside(self) -> tuple[Load | Disturbance, ...]:
        """The load, if there is one, and the other disturbances."""
        return (*((self.load,) if self.has_load else ()), *self.disturbances)

    @property
    def has_load(self) -> bool:
        """Whether there is a disturbance."""
        return self.load.name != NO_LOAD.name

    @property
    def measured_disturbances(self) -> tuple[Output, ...]:
        """The outputs that measure disturbances, and have no band."""
        names = {one.name for one in self.disturbances if one.noise is not None}
        return tuple(output for output in self.outputs if output.name in names and output.edges is None)

    def share(self, of: str) -> float:
        """Return the time of a solver's iteration, or of a preparation, over that with the cold box's problem."""
        return self.iterations.get(of, 1.0)

    @property
    def banded(self) -> tuple[Output, ...]:
        """Outputs that have a band."""
        return tuple(output for output in self.outputs if output.edges is not None)

    @property
    def bands(self) -> tuple[sections.Band, ...]:
        """Their bands."""
        return tuple(output.kept for output in self.outputs if output.kept is not None)

    @property
    def dead_bands(self) -> tuple[float, ...]:
        """Their dead bands."""
        return tuple(band.dead_band for band in self.bands)

    @classmethod
    def read(cls, path: str | Path) -> "Process":
        """Return the process of a process file, or of a model file.

        Raises:
            ColdloopError: The file cannot be used; one line that says why.
        """
        from coldloop.process.settings import process_of  # noqa: PLC0415 it is made of this

        file = Path(path)
        if file.suffix == ".toml":  # which the rig reads
            (reads,) = entry_points(group="coldloop.front_door", name="model_file_of")
            file, _ = reads.load()(file)
        return process_of(file)
