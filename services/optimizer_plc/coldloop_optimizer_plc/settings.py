"""Configuration of the optimiser PLC, checked when it is made and immutable after."""

from collections.abc import Mapping
from enum import StrEnum
from math import inf
from typing import Annotated, Any, ClassVar, Final, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationInfo, field_validator, model_validator

from coldloop.config import as_toml, flattened
from coldloop.modbus.settings import CONTROL_PORT, OPTIMIZER_PORT, Endpoint, ServerSettings
from coldloop.process.sections import FURTHEST_WEIGHT
from coldloop.process.settings import InputLimits, ProcessSettings, RootSettings, declared, settings_process, within
from coldloop.process.updating_periods import SHORTEST_TICKS, TOLERANCE, whole_ticks
from coldloop.registers.codec import WordOrder
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop.service.metrics_settings import MetricsSettings
from coldloop.service.telemetry_settings import TelemetrySettings
from coldloop.session.settings import SessionSettings
from coldloop_optimizer_plc.computing_settings import (
    Arithmetic,
    BudgetSettings,
    DaqpSettings,
    EstimatorKind,
    EstimatorSettings,
    FastGradientSettings,
    HybridSettings,
    InteriorPointSettings,
    OdeSettings,
    OsqpSettings,
    OutsideSettings,
    PlausibilitySettings,
    QpoasesSettings,
)
from coldloop_optimizer_plc.qp.design import (
    OF_ALPHA,
    OF_PRESETS,
    SCALES,
    UNMEASURED,
    WEIGHTS,
    ColdEndSettings,
    ControlDesign,
    PenaltySettings,
    Preset,
    alpha_of,
    filled,
    presets_of,
)

SHOWN: Final = ("limits", "optimizer_plc.program")
"""Keys of the configuration that decide results; the registers show them."""
ADAPTIVE = 0
LARGEST: Final = 1e18
"""Largest number in the program's settings."""
WITH_ALPHA: Final = ("ode", "qpoases", "osqp", "fast_gradient", "interior_point", "daqp", "outside")
"""Sections that have a weight of broken constraints."""


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


class ContractionSettings(BaseModel):
    """Parameters of the contraction rule, chosen on the draws 101 to 103 of the six families of hours."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.q_rest > self.q_max:
            raise ValueError("q_rest is above q_max")
        return self


class AdaptiveSettings(BaseModel):
    """Rule that adapts the updating period, and its parameters; those by their names are Algorithm 1's."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.q_min <= self.q_first <= self.q_max:
            raise ValueError("q_min <= q_first <= q_max does not hold")
        return self


def left_out(key: str, estimator: EstimatorSettings) -> str:
    """Return why this estimator cannot have a preset's value of a key of `optimizer_plc.program`; empty: it can."""
    if estimator.kind is EstimatorKind.STATE_FEEDBACK and key.startswith(("estimator.", "plausibility.")):
        return "state-feedback estimates nothing"
    return ""


class ProgramSettings(ProcessSettings):
    """Settings of the optimiser's program."""

    model_config = ConfigDict(validate_default=True)

    solver: SolverName = SolverName.ODE
    arithmetic: Arithmetic = Arithmetic.FLOAT64
    """Floating-point type of all that is computed on line; the PLC of the paper has float32 only."""
    updating_period_s: Annotated[float, within(lambda process: (0, process.sampling_period_s))] = ADAPTIVE
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
    budget: BudgetSettings = Field(default_factory=BudgetSettings)
    estimator: EstimatorSettings = Field(default_factory=EstimatorSettings)
    plausibility: PlausibilitySettings = Field(default_factory=PlausibilitySettings)
    """Plausibility check of readings; for the Kalman filter."""
    ode: OdeSettings = Field(default_factory=OdeSettings)
    qpoases: QpoasesSettings = Field(default_factory=QpoasesSettings)
    osqp: OsqpSettings = Field(default_factory=OsqpSettings)
    fast_gradient: FastGradientSettings = Field(default_factory=FastGradientSettings)
    interior_point: InteriorPointSettings = Field(default_factory=InteriorPointSettings)
    hybrid: HybridSettings = HybridSettings()
    daqp: DaqpSettings = Field(default_factory=DaqpSettings)
    outside: OutsideSettings = OutsideSettings()
    """Solver, rule and estimator of somebody else's, used instead of ours."""

    decides: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Keys that follow from other settings, by the key that decides, for `coldloop.config`; filled in below, from the
    fields."""

    @field_validator("updating_period_s")
    @classmethod
    def _whole_ticks(cls, value: float) -> float:
        tick_s = settings_process().tick_s
        if whole_ticks(value, tick_s) is None or 0 < value < SHORTEST_TICKS * tick_s * (1.0 - TOLERANCE):
            shortest = f"{SHORTEST_TICKS * tick_s:g} s"
            raise ValueError(f"an updating period is a multiple of {tick_s:g} s from {shortest} on, or 0 for adaptive")
        return value

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, given: Any) -> Any:  # noqa: ANN401 whatever is given
        """Take what was not set from the preset, before all of it is checked."""
        try:
            preset = Preset(given.get("preset", Preset.TUNED))
            estimator = EstimatorSettings.model_validate(given.get("estimator", {}))
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

    @field_validator(*WITH_ALPHA, mode="before")
    @classmethod
    def _with_alpha(cls, section: Any, others: ValidationInfo) -> Any:  # noqa: ANN401 whatever is given
        """Take alpha from the penalties where it was not set."""
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

    @model_validator(mode="after")
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
        most = FURTHEST_WEIGHT * alpha_of(PenaltySettings(), ControlDesign())
        for key in ALPHAS:
            alpha = getattr(self, key.partition(".")[0]).alpha
            if alpha > most:
                raise ValueError(f"{key} = {alpha:g}: at most {most:g}; it is penalties.output_rows times the largest "
                                 "design.violation_weight if it is not set")  # fmt: skip
        return self

    @model_validator(mode="after")
    def _load_steps_are_seen(self) -> Self:
        if self.interrupting_load_step_w and not self.estimator.load_known:
            raise ValueError("interrupting_load_step_w needs a load that is measured, estimator.load_known = true")
        return self

    @field_validator("holdable_load_w")
    @classmethod
    def _least_first(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            raise ValueError("give the least load that can be held, then the largest")
        return value

    @model_validator(mode="after")
    def _one_cost(self) -> Self:
        if self.solver is SolverName.HYBRID and self.ode.alpha != self.interior_point.alpha:
            raise ValueError("hybrid needs one cost for both of its solvers: set ode.alpha = interior_point.alpha")
        return self

    @property
    def solver_name(self) -> str:
        """Name of the solver in use."""
        return self.outside.solver or self.solver

    @property
    def iteration_s(self) -> float:
        """Time of an iteration of the solver in use, at P = 1."""
        if self.outside.solver:
            return self.outside.tau_1_s
        if self.solver is SolverName.HYBRID:
            return max(self.ode.tau_1_s, self.interior_point.tau_1_s)
        return float(getattr(self, self.solver.replace("-", "_")).tau_1_s)

    @model_validator(mode="after")
    def _own_arithmetic(self) -> Self:
        if self.arithmetic is Arithmetic.FLOAT32 and self.outside.names:
            raise ValueError(f"{', '.join(self.outside.names)}: what is not ours computes in double precision")
        if self.arithmetic is Arithmetic.FLOAT32 and self.solver not in SINGLE_PRECISION_SOLVERS:
            raise ValueError(
                f"{self.solver} computes in double precision; choose one of {', '.join(SINGLE_PRECISION_SOLVERS)}"
            )
        return self


ALPHAS: Final = tuple(f"{name}.alpha" for name in WITH_ALPHA)
"""The weight of broken constraints, by solver: keys of `optimizer_plc.program` that follow from the penalties."""
ProgramSettings.decides = {
    "preset": (*OF_PRESETS, *ALPHAS),
    "estimator.kind": ("estimator.disturbances",),
    "estimator.load_known": ("estimator.load_walk_w",),
    **dict.fromkeys(OF_ALPHA, ALPHAS),
}


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
