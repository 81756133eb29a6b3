"""Settings of the optimiser PLC, checked when they are made and immutable after. Nothing slow is imported.

The constrained predictive controller has weights, bands, instants (paper, section IV), penalties and presets. The paper
leaves weights and scaling open; `docs/science.md` lists those of this project. The augmented cost J = J_0 + alpha sum
max(Gamma z - gamma, 0)^2 + box alpha sum max(z - high, low - z, 0)^2 is the paper's eq. augmentedJ with mu = 2;
`docs/penalties.md` says what its weights do to costs and figures.
"""

from collections.abc import Mapping
from enum import StrEnum
from math import inf
from typing import Annotated, Any, ClassVar, Final, Self

import pydantic
from pydantic import AfterValidator, BaseModel, Field, FiniteFloat, PositiveFloat, ValidationInfo

from coldloop.config import as_toml, flattened
from coldloop.modbus.settings import CONTROL_PORT, OPTIMIZER_PORT, Endpoint, ServerSettings
from coldloop.process import cold_box, declaration, sections, updating_periods
from coldloop.process import settings as per
from coldloop.process.settings import InputLimits, ProcessSettings, RootSettings, declared, settings_process, stretched
from coldloop.registers.codec import WordOrder
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop.service.settings import MetricsSettings, TelemetrySettings
from coldloop.session import SessionSettings
from coldloop_optimizer_plc import computing_settings as computing

Instants = Annotated[tuple[int, ...], AfterValidator(sections.rising_instants)]
FURTHEST_SCALE: Final = 100.0
"""Largest factor between a scale and the process's own. With scales of inputs that are 1e-3 of it the first step of the
ODE-based solver is so short that the inputs of the cold box hardly move."""


class Target(StrEnum):
    """Target of the cost: where the plant should come to rest."""

    OPERATING_POINT = "operating-point"
    MISMATCH = "mismatch"
    """Where the plant, as it is estimated to be, rests at the operating point's load."""
    LOAD = "load"
    """Where it rests at the present load."""


Numbers = float | tuple[float, ...]
SCALES: Final = ("input_scale", "pressure_scale", "level_scale", "temperature_scale")
WEIGHTS: Final = ("input_weight", "state_weight", "violation_weight")


def _numbers(value: Numbers) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


class ControlDesign(ProcessSettings):
    """The constrained control problem: what has a number for each input or band is in their order in the process."""

    decision_instants: Instants = declared(lambda process: process.decision_instants)
    """Sampling periods at which inputs are free; the last one is the horizon."""
    constraint_instants: Instants = declared(lambda process: process.constraint_instants)
    """Sampling periods at which bands count."""
    output_low: per.PerBand = declared(lambda process: tuple(band.low for band in process.bands))
    """Bands: of the cold box those of L1 (%) and T5 (K)."""
    output_high: per.PerBand = declared(lambda process: tuple(band.high for band in process.bands))
    """Upper ends of the bands."""
    band_margin: per.PerBand = declared(lambda process: tuple(band.margin for band in process.bands))
    """How far inside the bands the rows of the problem are: soft rows let an output rest beyond them."""
    input_scale: per.PerInput = declared(lambda process: tuple(one.scale for one in process.inputs))
    """Size of each input in the problem."""
    input_weight: per.PerInput = declared(lambda process: tuple(one.weight for one in process.inputs))
    """Diagonal of R, on deviations from the operating point."""
    pressure_scale: PositiveFloat = 2000.0
    """Size of a pressure in the cost, Pa."""
    level_scale: PositiveFloat = 1.0
    """Size of a level in the cost, % of the vessel."""
    temperature_scale: PositiveFloat = 1.0
    """Size of a temperature in the cost, K."""
    state_weight: PositiveFloat = 0.1
    """Weight of the states in the cost."""
    violation_weight: per.PositivePerBand = declared(lambda process: tuple(band.weight for band in process.bands))
    """rho, per sample and square of what a band is missed by: of the cold box per %^2 of L1 and K^2 of T5."""
    target: Target = Target.OPERATING_POINT

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.input_scale)

    @property
    def n_slacks(self) -> int:
        """Number of slack inputs: below and above each band; of the paper L1 low, L1 high, T5 low, T5 high."""
        return 2 * len(self.output_low)

    @property
    def horizon(self) -> int:
        """N_p, in sampling periods."""
        return self.decision_instants[-1]

    @pydantic.field_validator(*SCALES, *WEIGHTS)
    @classmethod
    def _near_the_process(cls, value: Numbers, info: ValidationInfo) -> Numbers:
        name = str(info.field_name)
        furthest = FURTHEST_SCALE if name in SCALES else sections.FURTHEST_WEIGHT
        for own, given in zip(
            _numbers(cls.model_fields[name].get_default(call_default_factory=True)), _numbers(value), strict=True
        ):
            if not own / furthest <= given <= own * furthest:
                raise ValueError(f"each must be from {own / furthest:g} to {own * furthest:g}, around {own:g}: "
                                 "beyond that single precision loses the other terms of the cost")  # fmt: skip
        return value

    @pydantic.model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.target is not Target.OPERATING_POINT and settings_process().bath is None:
            raise ValueError("target: a process without a bath has only operating-point")
        if self.constraint_instants[-1] > self.horizon:
            raise ValueError("constraint_instants end behind the last of decision_instants, which is the horizon")
        bands = list(zip(self.output_low, self.output_high, self.band_margin, strict=True))
        if any(low >= high for low, high, _ in bands):
            raise ValueError("each output_low must be below its output_high")
        if any(not 0.0 <= margin <= (high - low) / 2.0 for low, high, margin in bands):
            raise ValueError(
                "each band_margin, that of the preset too, must be at least 0 and at most half of its band"
            )
        return self


class ColdEndSettings(ProcessSettings):
    """How far the feed of a bath may be opened: where helium before it is warmer than the bath, more of it cools less.

    The linear model does not know that. Of the cold box it is CV155, and T2 - T1 is measured whatever the valves pass
    and the exchangers transfer.
    """

    approach_k: Annotated[float, Field(ge=0.0)] = 0.0
    """T2 - T1 at which the feed is opened no further; 0 is any. Capacity of the cold box is largest at 0.3 K with CV156
    at 36 %."""
    opening_per_k: PositiveFloat = 70.0
    """How far the feed may be from where it is, in % for each K that T2 - T1 is from it. Less slows load steps."""
    following_s: PositiveFloat = stretched(60.0)
    """Time constant with which the limit follows T2 - T1, as it is estimated: noise of 0.03 K would move it by 2 %."""
    opening_from: FiniteFloat = 50.0
    """Opening, %, that is allowed in any case: should T1 or T2 be wrong."""

    @pydantic.model_validator(mode="after")
    def _of_a_bath(self) -> Self:
        if self.approach_k and settings_process().bath is None:
            raise ValueError("approach_k limits the feed of a bath, and the process has none; leave it out")
        return self


def trivial_design(design: ControlDesign) -> ControlDesign:
    """Return the same problem with every sample a decision and a constraint instant: 700 variables, 1000 rows."""
    every = tuple(range(1, design.horizon + 1))
    return design.model_copy(update={"decision_instants": every, "constraint_instants": every})


class PenaltySettings(ProcessSettings):
    """Weights of the penalties, relative to one another and to the cost weights."""

    output_rows: Annotated[float, Field(gt=0.0, le=1e6)] = 30.0
    """alpha over rho, the weight of a band violation. A violation v is shared between its slack and its row: the row
    keeps v / (1 + output_rows), and J has output_rows / (1 + output_rows) rho v^2 for it."""
    rate_rows: per.PositivePerInput = declared(lambda process: (16.0,) * len(process.inputs))
    """Weight of the rate rows over alpha, per square of `design.input_scale`. With the squares of `input_scale` the
    rows are in % and W, all with the same alpha, as the paper prints it."""
    box: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0
    """Weight of the box over alpha, per square of a scaled variable. Iterates are projected into the box whatever this
    is; it acts at the middle stage of a step of the ODE-based solver only, which with 1e5 hardly moves."""
    first_knot_in_box: bool = True
    """Whether the first knot keeps the rate from the input before it as a bound of the box, too, and not as a row only.
    Where it does not, its input is moved to within that rate before it is sent."""


def alpha_of(penalties: PenaltySettings, design: ControlDesign) -> float:
    """Return alpha, which the output of the larger rho has; the rows of the other one are scaled to theirs."""
    return penalties.output_rows * max(design.violation_weight)


class Preset(StrEnum):
    """Sets of settings by name; what is set explicitly in the same place comes before the preset's."""

    TUNED = "tuned"
    """As good as this project knows how to make it: the paper's preset and an estimator of biases; of the cold
    box also a limit of CV155 where opening it further cools less, and rows that keep outputs inside their bands at
    rest."""
    PAPER = "paper"
    """The paper's problem and estimator, with the truncated solver as good as this project knows how to make it."""
    AS_PRINTED = "as-printed"
    """The paper's printed values and no more. Of the numbers that it leaves open, alpha is rho, all rows have the same
    alpha in their own units, and cost_scale is the one whose costs come down with the iterations as in the paper's
    figure."""


UNMEASURED: Final = "unmeasured"
"""Key that section `estimator` of a process's preset `tuned` has instead where the load is not measured."""


def presets_of(process: declaration.Process) -> Mapping[Preset, Mapping[str, Mapping[str, Any]]]:
    """Return the settings of each preset for a process, by section of `optimizer_plc.program`."""
    return {
        Preset.TUNED: {name: values for name, values in process.tuned.items() if name != UNMEASURED}
        or {"estimator": {"disturbances": ("outputs",)}},
        Preset.PAPER: {},
        Preset.AS_PRINTED: {
            "penalties": {"output_rows": 1.0, "rate_rows": tuple(one.scale**2 for one in process.inputs),
                          "box": 1.0, "first_knot_in_box": False},
            "ode": {"cost_scale": 1e-8, "look_ahead_rows": False, "hold_at_bounds": False},
        },
    }  # fmt: skip


OF_PRESETS: Final = tuple(
    f"{name}.{key}"
    for preset in presets_of(cold_box.COLD_BOX).values()
    for name, values in preset.items()
    for key in values
)
"""Keys of `optimizer_plc.program` that a preset decides: the cold box's has all."""
OF_ALPHA: Final = ("penalties.output_rows", "design.violation_weight")
"""Keys that decide alpha: see `alpha_of`."""


def filled(section: object, values: Mapping[str, Any]) -> object:
    """Return a section, as it is given, with values for those of its keys that were not set; to be validated."""
    given = section.model_dump(exclude_unset=True) if isinstance(section, BaseModel) else section
    return {**values, **given} if isinstance(given, Mapping) else given


SHOWN: Final = ("limits", "optimizer_plc.program")
"""Keys of the configuration that decide results; the registers show them."""
ADAPTIVE = 0
LARGEST: Final = 1e18
"""Largest number in the program's settings."""
WITH_ALPHA: Final = ("ode", "qpoases", "osqp", "fast_gradient", "interior_point", "daqp", "outside")
"""Sections that have a weight of broken constraints."""
ALPHAS: Final = tuple(f"{name}.alpha" for name in WITH_ALPHA)
"""The weight of broken constraints, by solver: keys of `optimizer_plc.program` that follow from the penalties."""


class SolverName(StrEnum):
    """Names of the solvers."""

    ODE = "ode"
    QPOASES = "qpoases"
    OSQP = "osqp"
    FAST_GRADIENT = "fast-gradient"
    INTERIOR_POINT = "interior-point"
    HYBRID = "hybrid"
    DAQP = "daqp"


BORROWED_SOLVERS: Final = (SolverName.QPOASES, SolverName.OSQP, SolverName.DAQP)
"""Solvers of other projects, which compute in double precision."""
SINGLE_PRECISION_SOLVERS: Final = tuple(name for name in SolverName if name not in BORROWED_SOLVERS)
"""Solvers that are kernels of our own."""


class RuleName(StrEnum):
    """Rules of the adaptive updating period."""

    ALGORITHM_1 = "algorithm-1"
    CONTRACTION = "contraction"


class ContractionSettings(BaseModel, frozen=True, extra="forbid"):
    """Parameters of the contraction rule, chosen on the draws 101 to 103 of the six families of hours."""

    q_rest: Annotated[int, Field(ge=1)] = 2
    """Least q, that of quiet."""
    q_max: Annotated[int, Field(ge=1)] = 5
    """Largest q, that of the first period and of one which begins with a load step."""
    band: Annotated[float, Field(ge=0)] = 10.0
    """Dead band of the size of ln K, over the usual size, its median."""
    least: Annotated[float, Field(gt=0)] = 5e-4
    """Least usual size of ln K, and the first."""
    change: Annotated[float, Field(ge=0, lt=1)] = 0.02
    """Share by which the usual size goes up or down in a period."""

    @pydantic.model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.q_rest > self.q_max:
            raise ValueError("q_rest is above q_max")
        return self


class AdaptiveSettings(BaseModel, frozen=True, extra="forbid"):
    """Rule that adapts the updating period, and its parameters; those by their names are Algorithm 1's."""

    rule: RuleName = RuleName.ALGORITHM_1
    contraction: ContractionSettings = ContractionSettings()

    q_first: Annotated[int, Field(ge=1)] = 9
    """q(t_0), the number of a period in the ladder: 1 is 0.5 s, 9 is 2.5 s at P = 1 and with an iteration of 0.25 s or
    less. The ladder has each period that holds more iterations than the one before (`coldloop budget`)."""
    q_min: Annotated[int, Field(ge=1)] = 2
    """Shortest period, as a number in the ladder of periods."""
    q_max: Annotated[int, Field(ge=1)] = 19
    """Longest period, likewise."""
    delta: Annotated[int, Field(ge=1)] = 2
    """Step of q."""
    cost_floor: Annotated[float, Field(gt=0)] = 1.0
    """Constant added to J, so that it is bounded below by a positive number (Assumption 1 of the paper)."""

    @pydantic.model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.q_min <= self.q_first <= self.q_max:
            raise ValueError("q_min <= q_first <= q_max does not hold")
        return self


def left_out(key: str, estimator: computing.EstimatorSettings) -> str:
    """Return why this estimator cannot have a preset's value of a key of `optimizer_plc.program`; empty: it can."""
    if estimator.kind is computing.EstimatorKind.STATE_FEEDBACK and key.startswith(("estimator.", "plausibility.")):
        return "state-feedback estimates nothing"
    return ""


class ProgramSettings(ProcessSettings, validate_default=True):
    """Settings of the optimiser's program."""

    solver: SolverName = SolverName.ODE
    arithmetic: computing.Arithmetic = computing.Arithmetic.FLOAT64
    """Floating-point type of all that is computed on line; the PLC of the paper has float32 only."""
    updating_period_s: Annotated[float, per.within(lambda process: (0, process.sampling_period_s))] = ADAPTIVE
    """Fixed updating period, a multiple of 0.25 s; 0 is adaptive."""
    interrupting_load_step_w: Annotated[float, Field(ge=0)] = 0.0
    """A load step of more than this ends an updating period at once, whatever decides its length; 0 is never."""
    holdable_load_w: tuple[FiniteFloat, FiniteFloat] = declared(
        lambda process: (process.bath and process.bath.holdable_load) or process.load.stored_span
    )
    """Loads that are held at rest within the bands, in the load's unit: of the cold box by runs of its nonlinear
    plant. With a bath, a load outside raises the alarm `capacity`."""
    capacity_reserve_w: Annotated[float, Field(ge=0)] = declared(
        lambda process: process.bath.load_reserve if process.bath else 0.0
    )
    """So does an estimated load this near the largest one that the linear model holds with the feed at its limit."""
    sequence_ticks: Annotated[int, Field(ge=2, le=SEQUENCE_ROWS)] = 18
    """Shortest sequence sent; 18 rows fit into one Modbus request with their header. It is never shorter than two
    updating periods: one to be played, one in case the next sequence is late; nor than the longest time until the next
    sequence of adaptive periods can arrive (`scheme.shortest_sequence`)."""
    adaptive: AdaptiveSettings = AdaptiveSettings()
    design: ControlDesign = Field(default_factory=ControlDesign)
    cold_end: ColdEndSettings = Field(default_factory=ColdEndSettings)
    preset: Preset = Preset.TUNED
    """Penalties, start of the ODE-based solver, disturbances, limit of the feed, margin of the bands, limit of
    residuals, if not set."""
    penalties: PenaltySettings = Field(default_factory=PenaltySettings)
    budget: computing.BudgetSettings = Field(default_factory=computing.BudgetSettings)
    estimator: computing.EstimatorSettings = Field(default_factory=computing.EstimatorSettings)
    plausibility: computing.PlausibilitySettings = Field(default_factory=computing.PlausibilitySettings)
    """Plausibility check of readings; for the Kalman filter."""
    ode: computing.OdeSettings = Field(default_factory=computing.OdeSettings)
    qpoases: computing.QpoasesSettings = Field(default_factory=computing.QpoasesSettings)
    osqp: computing.OsqpSettings = Field(default_factory=computing.OsqpSettings)
    fast_gradient: computing.FastGradientSettings = Field(default_factory=computing.FastGradientSettings)
    interior_point: computing.InteriorPointSettings = Field(default_factory=computing.InteriorPointSettings)
    hybrid: computing.HybridSettings = computing.HybridSettings()
    daqp: computing.DaqpSettings = Field(default_factory=computing.DaqpSettings)
    outside: computing.OutsideSettings = computing.OutsideSettings()
    """Solver, rule and estimator of somebody else's, used instead of ours."""

    decides: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "preset": (*OF_PRESETS, *ALPHAS),
        "estimator.kind": ("estimator.disturbances",),
        "estimator.load_known": ("estimator.load_walk_w",),
        **dict.fromkeys(OF_ALPHA, ALPHAS),
    }
    """Keys that follow from other settings, by the key that decides, for `coldloop.config`."""

    @pydantic.field_validator("updating_period_s")
    @classmethod
    def _whole_ticks(cls, value: float) -> float:
        tick_s = settings_process().tick_s
        shortest = updating_periods.SHORTEST_TICKS * tick_s
        is_short = 0 < value < shortest * (1.0 - updating_periods.TOLERANCE)
        if is_short or updating_periods.whole_ticks(value, tick_s) is None:
            least = f"{shortest:g} s"
            raise ValueError(f"an updating period is a multiple of {tick_s:g} s from {least} on, or 0 for adaptive")
        return value

    @pydantic.model_validator(mode="before")
    @classmethod
    def _with_preset(cls, given: Any) -> Any:  # noqa: ANN401 whatever is given
        """Take what was not set from the preset, before all of it is checked."""
        try:
            preset = Preset(given.get("preset", Preset.TUNED))
            estimator = computing.EstimatorSettings.model_validate(given.get("estimator", {}))
        except (AttributeError, ValueError):
            return given  # which is refused
        process = settings_process()
        if preset is Preset.TUNED and not estimator.load_known:
            given = {**given, "estimator": filled(given.get("estimator", {}), process.tuned.get(UNMEASURED, {}))}
        values = {
            section: {key: value for key, value in keys.items() if not left_out(f"{section}.{key}", estimator)}
            for section, keys in presets_of(process)[preset].items()
        }
        return {**given, **{section: filled(given.get(section, {}), keys) for section, keys in values.items()}}

    @pydantic.field_validator(*WITH_ALPHA, mode="before")
    @classmethod
    def _with_alpha(cls, section: Any, others: ValidationInfo) -> Any:  # noqa: ANN401 whatever is given
        if not {"penalties", "design"} <= others.data.keys():
            return section  # one of them is refused
        return filled(section, {"alpha": alpha_of(others.data["penalties"], others.data["design"])})

    @property
    def notes(self) -> dict[str, str]:
        """Values of the preset that are not applied, by key relative to this section, with the reason."""
        return {
            f"{section}.{key}": f"preset {self.preset} has {as_toml(value)}, not applied: {reason}"
            for section, keys in presets_of(self.process)[self.preset].items() for key, value in keys.items()
            if (reason := left_out(f"{section}.{key}", self.estimator))
        }  # fmt: skip

    @pydantic.model_validator(mode="after")
    def _within_single_precision(self) -> Self:
        near = {f"design.{name}" for name in (*SCALES, *WEIGHTS)}
        for key, value in flattened(self.model_dump(mode="json")).items():
            if key in near:  # to the process's own, whose units may be large or small
                continue
            largest = inf if key in ALPHAS else LARGEST
            for number in value if isinstance(value, list) else [value]:
                if isinstance(number, float) and not (number == 0.0 or 1.0 / LARGEST <= abs(number) <= largest):
                    raise ValueError(f"{key} = {number:g}: give 0 or a size from {1.0 / LARGEST:g} to {LARGEST:g}: "
                                     "single precision holds its square")  # fmt: skip
        most = sections.FURTHEST_WEIGHT * alpha_of(PenaltySettings(), ControlDesign())
        for key in ALPHAS:
            alpha = getattr(self, key.partition(".")[0]).alpha
            if alpha > most:
                raise ValueError(f"{key} = {alpha:g}: at most {most:g}; it is penalties.output_rows times the largest "
                                 "design.violation_weight if it is not set")  # fmt: skip
        return self

    @pydantic.field_validator("holdable_load_w")
    @classmethod
    def _least_first(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            raise ValueError("give the least load that can be held, then the largest")
        return value

    @property
    def solver_name(self) -> str:
        """Name of the solver in use."""
        return self.outside.solver or self.solver

    @property
    def iteration_s(self) -> float:
        """Time of an iteration of the solver in use, at P = 1."""
        return self.outside.tau_1_s if self.outside.solver else self.iteration_of(self.solver)

    def iteration_of(self, solver: SolverName) -> float:
        """Return the time of an iteration of a solver at P = 1, s."""
        if solver is SolverName.HYBRID:
            return max(self.ode.tau_1_s, self.interior_point.tau_1_s)
        return float(getattr(self, solver.replace("-", "_")).tau_1_s)

    @pydantic.model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.interrupting_load_step_w and not self.estimator.load_known:
            raise ValueError("interrupting_load_step_w needs a load that is measured, estimator.load_known = true")
        if self.solver is SolverName.HYBRID and self.ode.alpha != self.interior_point.alpha:
            raise ValueError("hybrid needs one cost for both of its solvers: set ode.alpha = interior_point.alpha")
        if self.arithmetic is computing.Arithmetic.FLOAT32 and self.outside.names:
            raise ValueError(f"{', '.join(self.outside.names)}: what is not ours computes in double precision")
        if self.arithmetic is computing.Arithmetic.FLOAT32 and self.solver not in SINGLE_PRECISION_SOLVERS:
            raise ValueError(
                f"{self.solver} computes in double precision; choose one of {', '.join(SINGLE_PRECISION_SOLVERS)}"
            )
        return self


class OptimizerServer(ServerSettings):
    """The optimiser PLC's server."""

    port: Annotated[int, Field(ge=0, le=0xFFFF)] = OPTIMIZER_PORT


class ControlEndpoint(Endpoint):
    """Address of the control PLC."""

    port: Annotated[int, Field(ge=1, le=0xFFFF)] = CONTROL_PORT
    """TCP port."""


class OptimizerSection(ProcessSettings):
    """Section `optimizer_plc` of the configuration."""

    server: OptimizerServer = OptimizerServer()
    word_order: WordOrder = WordOrder.HIGH_FIRST
    metrics: MetricsSettings = MetricsSettings()
    control_plc: ControlEndpoint = ControlEndpoint()
    program: ProgramSettings = Field(default_factory=ProgramSettings)


class OptimizerSettings(RootSettings):
    """Settings that the optimiser PLC reads of a configuration."""

    limits: InputLimits = Field(default_factory=InputLimits)
    session: SessionSettings = SessionSettings()
    optimizer_plc: OptimizerSection = Field(default_factory=OptimizerSection)
    telemetry: TelemetrySettings = TelemetrySettings()
