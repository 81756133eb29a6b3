"""Settings of what the optimiser computes with: arithmetic, power, estimator, solvers. Nothing slow is imported.

The reference PLC (P = 1) is the Schneider TSX P574634M of the paper: one ODE iteration in a slot of 0.25 s, and one
slot for the preparation of the problem, hence 4 tau_u - 1 iterations (section VI; `studies/slips.md`, 7).
"""

from bisect import bisect_right
from collections.abc import Sequence
from contextlib import AbstractContextManager
from enum import StrEnum
from functools import cached_property
from importlib.metadata import entry_points
from typing import Annotated, Any, Self

from pydantic import BaseModel, Field, PositiveFloat, field_validator, model_validator

from coldloop.errors import ConfigurationError, foreign
from coldloop.process import declaration, updating_periods
from coldloop.process.settings import PositivePerInput, ProcessSettings, declared, settings_process, stretched, within

PENALTY_WEIGHT = 3000.0
"""alpha that all solvers are judged by with the default weights. In a program's settings it follows from `penalties`
and `design.violation_weight` wherever it is not set."""


def signals_of(process: declaration.Process) -> tuple[str, ...]:
    """Return what may have a bias, in the order of their states: outputs, then inputs."""
    return (*process.output_names, *process.input_names)


def groups_of(process: declaration.Process) -> dict[str, tuple[str, ...]]:
    """Return what `estimator.disturbances` calls all outputs, or inputs, that may have a bias: not L1, nor the heater.

    No sensor of the cold box tells a bias of these from liquid helium, or from the load.
    """
    inputs = tuple(one.name for one in process.inputs if one.has_constant)
    return {"outputs": process.constants, "inputs": inputs}


class Arithmetic(StrEnum):
    """Floating-point types to choose from."""

    FLOAT64 = "float64"
    FLOAT32 = "float32"


class EstimatorKind(StrEnum):
    """Kind of the estimator."""

    KALMAN = "kalman"
    STATE_FEEDBACK = "state-feedback"


class NoiseReference(StrEnum):
    """Reference of the standard deviations of the sensors."""

    MEASUREMENT = "measurement"
    TIME = "time"


class EstimatorSettings(ProcessSettings):
    """Settings of the estimator; standard deviations are per square root of a sampling period of 5 s."""

    kind: EstimatorKind = EstimatorKind.KALMAN
    load_known: bool = True
    """Whether the heat load is measured; where it is not, all of it is load mismatch, and no period is interrupted."""
    load_walk_w: PositiveFloat = declared(lambda process: process.load.walk)
    """Random walk of the load mismatch, W; for a load that is not measured, of the size of its steps."""
    pressure_noise_pa: PositiveFloat = 50.0
    """Process noise of states in Pa."""
    volume_noise_m3: PositiveFloat = 1e-5
    """Process noise of states in m3."""
    temperature_noise_k: PositiveFloat = 0.05
    """Process noise of states in K."""
    mass_noise_kg: PositiveFloat = 1e-4
    """Process noise of a line of the compression station, where the model has it, as the next two."""
    flow_noise_kg_s: PositiveFloat = 1e-5
    """Process noise of states in kg/s."""
    integral_noise_bar_s: PositiveFloat = 1e-5
    """Process noise of states in bar s."""
    level_sensor: PositiveFloat = 0.01
    """Standard deviation of the sensors: %, Hz, K and bar."""
    speed_sensor: PositiveFloat = 1.0
    """Noise of the sensors of speed, Hz."""
    temperature_sensor: PositiveFloat = 0.02
    """Noise of the sensors of temperature, K."""
    pressure_sensor: PositiveFloat = 1e-3
    """Noise of the sensors of pressure, bar."""
    noise_reference: NoiseReference = NoiseReference.MEASUREMENT
    """Reference of the sensors' noise: one measurement, whatever the updating period; or a mean over a sampling period,
    so that measurements which follow each other sooner count for less: a model error is then not taken for more load
    the shorter the period is."""
    disturbances: tuple[str, ...] = ()
    """Signals, by name or group (`outputs`, `inputs`), with an unknown constant that is estimated, so that there is no
    offset on a plant that is not the model. That of an output is added to its reading, that of an input acts like
    more of it."""
    disturbance_walk: PositiveFloat = 3.0
    """Random walk of an output's constant over its sensor's standard deviation."""
    input_walk: PositivePerInput = declared(lambda process: tuple(one.walk for one in process.inputs))
    """Random walk of an input's constant, in its unit."""
    longest_riccati: Annotated[int, Field(ge=1)] = 2000
    """Longest run of the Riccati recursion for a stationary gain, in periods."""

    @field_validator("disturbances", mode="before")
    @classmethod
    def _one_or_several(cls, names: object) -> object:
        return (names,) if isinstance(names, str) else names

    @field_validator("disturbances")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        process = settings_process()
        found, signals = _members(names, process), signals_of(process)
        if any(name not in signals for name in found) or len(set(found)) < len(found):
            raise ValueError(f"disturbances are a list, each once, of {', '.join((*groups_of(process), *signals))}")
        return names

    @property
    def sensors(self) -> tuple[float, ...]:
        """Standard deviation of each output's sensor, in its unit."""
        return _by_quantity(self, "sensor", [output.noise for output in self.process.outputs])

    @property
    def disturbed(self) -> tuple[int, ...]:
        """Indices of the outputs, and then inputs, that have a disturbance, rising."""
        return tuple(sorted(map(signals_of(self.process).index, _members(self.disturbances, self.process))))

    @model_validator(mode="after")
    def _what_is_estimated(self) -> Self:
        if self.kind is EstimatorKind.STATE_FEEDBACK and self.disturbances:
            raise ValueError("state-feedback estimates no disturbances; choose kind = kalman")
        if self.kind is EstimatorKind.STATE_FEEDBACK and not self.load_known:
            raise ValueError("state-feedback estimates no load; choose kind = kalman for load_known = false")
        return self


class PlausibilitySettings(ProcessSettings):
    """Plausibility check: when the Kalman filter masks a reading that prediction and other readings contradict."""

    sigmas: Annotated[float, Field(ge=0)] = 0.0
    """Largest residual over its standard deviation; 0: any is plausible. With 6 a good sensor is suspected by noise
    alone once in 5e8 updates, which is one of the 22 in two years at updates every 2.5 s."""
    level_allowance: Annotated[float, Field(ge=0)] = 0.05
    """Allowance for a residual of a plant that differs from its model, %, Hz, K and bar: from the hours a to f of
    plants that are 20 % off, whose residuals are below 5 sigmas and 0.02 %, 0 Hz, 0 K, 0.009 bar (`docs/fail-safe.md`).
    """
    speed_allowance: Annotated[float, Field(ge=0)] = 5.0
    """The same of a speed, Hz."""
    temperature_allowance: Annotated[float, Field(ge=0)] = 0.0
    """The same of a temperature, K."""
    pressure_allowance: Annotated[float, Field(ge=0)] = 0.01
    """The same of a pressure, bar."""
    settled_s: Annotated[float, Field(ge=0)] = stretched(60.0)
    """A reading is judged when it has been used for so long: until then the filter learns how the plant differs."""
    agreeing_s: Annotated[float, Field(ge=0)] = stretched(60.0)
    """Time after which a suspect that agrees with the others is reinstated."""
    longest_s: Annotated[float, Field(ge=0)] = stretched(1800.0)
    """Time after which it is reinstated in any case: the others' prediction of it is then no better."""
    most: Annotated[int, within(lambda process: (0, len(process.outputs) - 1))] = declared(
        lambda process: min(2, len(process.outputs) - 1)
    )
    """Readings that may be suspected at once; when more contradict the prediction it is the plant: the four gauges of
    the supply see a compressor trip."""
    model_sigmas: Annotated[float, Field(gt=0)] = 4.0
    """The model holds while no reading's residual is larger, over its standard deviation, as a root mean square over a
    minute (and but for its allowance). While it does not, no other reading is suspected, and suspects are reinstated:
    what contradicts them is wrong itself. L1, which has no bias, is reinstated where two or more say so."""

    spike_s: Annotated[float, Field(ge=0)] = stretched(7.5)
    """A reading that contradicts the others is left out at once, and a suspect when it has done so for longer than
    this, less a tenth of the time in which it did not."""
    level_span: tuple[float, float] = (5.0, 95.0)
    """A level that is predicted outside of this, %, is not judged: a bath that runs dry or full is not as its model."""
    movement_sigmas: Annotated[float, Field(ge=0)] = 10.0
    """A reading without a bias (L1) is stuck when it shows only its noise while the prediction without it
    moves about its trend by so many standard deviations of its sensor for `settled_s`, or by more for less; 0: never.
    """

    @field_validator("level_span")
    @classmethod
    def _low_first(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not value[0] < value[1]:
            raise ValueError("give the lower end first, then the higher one")
        return value

    @property
    def spans(self) -> tuple[tuple[float, float], ...]:
        """Within which predictions each output is judged."""
        spans = {"level": self.level_span}
        return tuple(spans.get(output.quantity, (-1e30, 1e30)) for output in self.process.outputs)

    @property
    def allowances(self) -> tuple[float, ...]:
        """Allowance of each output, in its unit."""
        return _by_quantity(self, "allowance", [output.allowance for output in self.process.outputs])


def _by_quantity(settings: ProcessSettings, what: str, numbers: Sequence[float]) -> tuple[float, ...]:
    """Return what a section sets for the quantity of each output; of `numbers` where it has none."""
    return tuple(
        getattr(settings, f"{output.quantity}_{what}") if output.quantity else value
        for output, value in zip(settings.process.outputs, numbers, strict=True)
    )


def _members(names: tuple[str, ...], process: declaration.Process) -> list[str]:
    return [member for name in names for member in groups_of(process).get(name, (name,))]


SLOT_S = 0.25
"""Length of a slot of the reference PLC with the problem of the cold box, s."""


class BudgetSettings(ProcessSettings):
    """Computing power of the optimiser PLC."""

    power: PositiveFloat = 1.0
    """P, relative to the reference PLC."""
    preparation_slots: Annotated[int, Field(ge=0, le=20)] = 1
    """Slots of 0.25 s / P that the preparation is given in an updating period."""
    preparation_s: Annotated[float, Field(ge=0)] = declared(lambda process: 0.17 * process.share("preparation"))
    """Time that it takes at P = 1: 89,000 operations at 0.53 Mflop/s (`docs/budget.md`)."""


class PlcBudget:
    """Converts between iterations and updating periods for one solver."""

    def __init__(self, settings: BudgetSettings, tau_1_s: float) -> None:
        process = settings.process
        slots_s = settings.preparation_slots * (SLOT_S * process.share("preparation"))
        self.longest_ticks = process.ticks_per_sample
        """Longest updating period, a sampling period."""
        self.times = updating_periods.ComputingTimes(
            slots_s / settings.power, settings.preparation_s / settings.power, tau_1_s / settings.power,
            process.tick_s, self.longest_ticks,
        )  # fmt: skip
        self.iterations = self.times.iterations
        """Iterations that fit into an updating period of so many ticks; at least one is always done."""

    @cached_property
    def ladder(self) -> tuple[int, ...]:
        """Updating periods that a rule chooses from, in ticks; q is the number of one, from 1."""
        return self.times.ladder()

    def q(self, ticks: int) -> int:
        """Return the number of the longest period of the ladder that is no longer than so many ticks; at least 1."""
        return max(1, bisect_right(self.ladder, ticks))

    def answer_after_s(self, iterations: int) -> float:
        """Return the plant time from an updating instant to the end of its computation, in seconds."""
        return self.times.preparation + iterations * self.times.iteration

    def too_slow(self, ticks: int = 0) -> str:
        """Return that an iteration does not fit into a fixed period, or into the longest (0); empty where it does."""
        period = ticks or self.longest_ticks
        if self.times.holds(period):
            return ""
        needed_s, which = self.times.slots + self.times.iteration, "" if ticks else "longest "
        return (
            f"the slot of the preparation and an iteration take {needed_s:.3g} s, and the {which}updating period is "
            f"{period * self.times.tick_s:g} s"
        )

    def is_enough(self, ticks: int) -> bool:
        """Return whether an answer of one iteration is there within an updating period of `ticks` ticks."""
        return self.answer_after_s(1) <= ticks * self.times.tick_s


class SolverSettings(ProcessSettings):
    """Settings of a solver."""

    alpha: PositiveFloat = PENALTY_WEIGHT
    """Weight of broken rows (paper, equation of the penalised cost); qpOASES, OSQP and DAQP know no penalty, and have
    their answers judged with it."""


class OdeSettings(SolverSettings):
    """Settings of the ODE-based solver."""

    cost_scale: Annotated[float, Field(gt=0, le=1.0)] = 1e-4
    """The flow is that of cost_scale * J: the rule for the first step size is not scale invariant."""
    tolerance: PositiveFloat = 1.0
    """Local error accepted in one step, in scaled variables."""
    growth: PositiveFloat = 5.0
    """Largest growth of the step size from one iteration to the next."""
    rejection: PositiveFloat = 0.5
    """Factor on the step size after a rejected step."""
    look_ahead_rows: bool = True
    """Whether rows that are active at the middle stage of a step are in the matrix of the next step, too. Not in the
    paper."""
    hold_at_bounds: bool = True
    """Whether variables pressed against a bound are held during a step, instead of being projected after it only. Not
    in the paper."""
    tau_1_s: PositiveFloat = declared(lambda process: 0.25 * process.share("ode"))
    """Time of an iteration at P = 1, s (paper, section IV-D)."""


class QpoasesSettings(SolverSettings):
    """Settings of throttled qpOASES."""

    tau_1_s: PositiveFloat = declared(lambda process: 0.475 * process.share("qpoases"))
    """120 us a recalculation, slowed down by 4000 (paper, section VI), are 0.48 s; with a slot of 0.25 s for the
    preparation the paper's 10 iterations in 5 s at P = 1 need this."""


class OsqpSettings(SolverSettings):
    """Settings of OSQP."""

    rho: PositiveFloat = 10.0
    """Step size of the multipliers: with less, truncated answers are worse, with more, convergence is slower."""
    relaxation: Annotated[float, Field(ge=0.1, lt=2.0)] = 1.6
    """Relaxation factor, OSQP's alpha: an iterate moves by this share."""
    tau_1_s: PositiveFloat = declared(lambda process: 0.05 * process.share("osqp"))
    """25,763 operations, dense, at 0.529 Mflop/s (`docs/budget.md`)."""


class FastGradientSettings(SolverSettings):
    """Settings of the fast gradient method."""

    adaptive_restart: bool = True
    """Whether the momentum is dropped when it points uphill."""
    tau_1_s: PositiveFloat = declared(lambda process: 0.03 * process.share("fast-gradient"))
    """14,811 operations, dense, at 0.529 Mflop/s are 0.028 s (`docs/budget.md`)."""


class DaqpSettings(SolverSettings):
    """Settings of DAQP."""

    primal_tolerance: PositiveFloat = 1e-9
    """Violation of a row up to which it counts as kept."""
    tau_1_s: PositiveFloat = declared(lambda process: 4.75 * process.share("daqp"))
    """One solve in an updating period of 5 s at P = 1: an oracle's time, not a measured one."""


class OutsideSettings(BaseModel, frozen=True, extra="forbid"):
    """Parts that are installed beside this package, by the names of entry points: `coldloop.solvers` and so on."""

    solver: str = ""
    """Used instead of `optimizer_plc.program.solver`."""
    rule: str = ""
    """Decides adaptive periods instead of `adaptive.rule`."""
    estimator: str = ""
    """Used instead of `estimator.kind`; `estimator.disturbances` says which constants there are to estimate."""
    alpha: PositiveFloat = PENALTY_WEIGHT
    """Weight that answers of the solver are judged with."""
    tau_1_s: PositiveFloat = 0.25
    """Time of an iteration of the solver at P = 1: measured or counted by its author."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entry points that are used."""
        return tuple(filter(None, (self.solver, self.rule, self.estimator)))


class Part(StrEnum):
    """Part of another project: a key of `optimizer_plc.program.outside`, and the group `coldloop.<part>s`."""

    SOLVER = "solver"
    RULE = "rule"
    ESTIMATOR = "estimator"


def made(part: Part, name: str, *given: object) -> Any:  # noqa: ANN401 the caller knows its protocol
    """Return what the entry point of this name makes of what it is given.

    Raises ConfigurationError if there is none, or if it cannot be made.
    """
    with in_its_name(part, name, "cannot be made: "):
        return loaded(part, name)(*given)


def loaded(part: Part, name: str) -> Any:  # noqa: ANN401 as above
    """Return the class or function of an entry point; ConfigurationError: there is none, or it cannot be imported."""
    group = f"coldloop.{part}s"
    there = entry_points(group=group)
    if name not in there.names:
        known = ", ".join(sorted(there.names)) or "none is installed"
        raise ConfigurationError(
            f"optimizer_plc.program.outside.{part}: no {part} '{name}' among the entry points {group}: {known}"
        )
    with in_its_name(part, name, "cannot be made: "):
        return there[name].load()


def in_its_name(part: Part, name: str, what: str = "") -> AbstractContextManager[None]:
    """Call what is not ours: what it raises is a `ConfigurationError` of one line, with its name unless it is one."""
    called = f"{part} {name}: {what}".removesuffix(": ")
    return foreign(called, "the optimiser ends here: mend it, or choose another", kind=ConfigurationError)


class InteriorPointSettings(SolverSettings):
    """Settings of the interior-point method."""

    first_mu: PositiveFloat = 3.0
    """mu that the guess is put on the central path for, as a share of its J over the number of rows and variables: a
    guess that costs much is far from the optimum, and needs a path that begins far from the bounds."""
    least_mu: PositiveFloat = 1.0
    """It is never less than this."""
    margin: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.1
    """Share of the box's width by which the guess is at least moved away from its bounds."""
    tau_1_s: PositiveFloat = declared(lambda process: 0.17 * process.share("interior-point"))
    """From an upper bound of our code's 78,769 operations, 0.149 s at 0.529 Mflop/s (`docs/budget.md`)."""


class HybridSettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of the choice between the interior-point method and the ODE-based solver."""

    switch: Annotated[float, Field(gt=1.0)] = 2.0
    """Cost of a guess over that of the last answer from which on the interior-point method gets the problem."""
