"""Settings of the constrained predictive controller: weights, bands, instants (paper, section IV), penalties, presets.

The paper leaves weights and scaling open; `docs/science.md` lists those of this project. Nothing slow is imported.
The augmented cost J = J_0 + alpha sum max(Gamma z - gamma, 0)^2 + box alpha sum max(z - high, low - z, 0)^2 is the
paper's eq. augmentedJ with mu = 2; `docs/penalties.md` says what its weights do to costs and figures.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Final, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    FiniteFloat,
    PositiveFloat,
    ValidationInfo,
    field_validator,
    model_validator,
)

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.declaration import Process
from coldloop.process.sections import FURTHEST_WEIGHT, rising_instants
from coldloop.process.settings import (
    PerBand,
    PerInput,
    PositivePerBand,
    PositivePerInput,
    ProcessSettings,
    declared,
    settings_process,
    stretched,
)

Instants = Annotated[tuple[int, ...], AfterValidator(rising_instants)]
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
    output_low: PerBand = declared(lambda process: tuple(band.low for band in process.bands))
    """Bands: of the cold box those of L1 (%) and T5 (K)."""
    output_high: PerBand = declared(lambda process: tuple(band.high for band in process.bands))
    """Upper ends of the bands."""
    band_margin: PerBand = declared(lambda process: tuple(band.margin for band in process.bands))
    """How far inside the bands the rows of the problem are: soft rows let an output rest beyond them."""
    input_scale: PerInput = declared(lambda process: tuple(one.scale for one in process.inputs))
    """Size of each input in the problem."""
    input_weight: PerInput = declared(lambda process: tuple(one.weight for one in process.inputs))
    """Diagonal of R, on deviations from the operating point."""
    pressure_scale: PositiveFloat = 2000.0
    """Size of a pressure in the cost, Pa."""
    level_scale: PositiveFloat = 1.0
    """Size of a level in the cost, % of the vessel."""
    temperature_scale: PositiveFloat = 1.0
    """Size of a temperature in the cost, K."""
    state_weight: PositiveFloat = 0.1
    """Weight of the states in the cost."""
    violation_weight: PositivePerBand = declared(lambda process: tuple(band.weight for band in process.bands))
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

    @field_validator(*SCALES, *WEIGHTS)
    @classmethod
    def _near_the_process(cls, value: Numbers, info: ValidationInfo) -> Numbers:
        name = str(info.field_name)
        furthest = FURTHEST_SCALE if name in SCALES else FURTHEST_WEIGHT
        for own, given in zip(
            _numbers(cls.model_fields[name].get_default(call_default_factory=True)), _numbers(value), strict=True
        ):
            if not own / furthest <= given <= own * furthest:
                raise ValueError(f"each must be from {own / furthest:g} to {own * furthest:g}, around {own:g}: "
                                 "beyond that single precision loses the other terms of the cost")  # fmt: skip
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.target is not Target.OPERATING_POINT and settings_process().bath is None:
            raise ValueError("target: a process without a bath has only operating-point")
        if self.constraint_instants[-1] > self.horizon:
            raise ValueError("constraint_instants end behind the last of decision_instants, which is the horizon")
        if any(low >= high for low, high in zip(self.output_low, self.output_high, strict=True)):
            raise ValueError("each output_low must be below its output_high")
        widths = (high - low for low, high in zip(self.output_low, self.output_high, strict=True))
        if any(not 0.0 <= margin <= width / 2.0 for margin, width in zip(self.band_margin, widths, strict=True)):
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

    @model_validator(mode="after")
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
    rate_rows: PositivePerInput = declared(lambda process: (16.0,) * len(process.inputs))
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


def presets_of(process: Process) -> Mapping[Preset, Mapping[str, Mapping[str, Any]]]:
    """Return the settings of each preset for a process, by section of `optimizer_plc.program`."""
    return {
        Preset.TUNED: {name: values for name, values in process.tuned.items() if name != UNMEASURED}
        or {"estimator": {"disturbances": ("outputs",)}},
        Preset.PAPER: {},
        Preset.AS_PRINTED: {
            "penalties": {
                "output_rows": 1.0,
                "rate_rows": tuple(one.scale**2 for one in process.inputs),
                "box": 1.0,
                "first_knot_in_box": False,
            },
            "ode": {"cost_scale": 1e-8, "look_ahead_rows": False, "hold_at_bounds": False},
        },
    }


OF_PRESETS: Final = tuple(
    f"{section}.{key}"
    for preset in presets_of(COLD_BOX).values()
    for section, values in preset.items()
    for key in values
)
"""Keys of `optimizer_plc.program` that a preset decides: the cold box's has all."""
OF_ALPHA: Final = ("penalties.output_rows", "design.violation_weight")
"""Keys that decide alpha: see `alpha_of`."""


def filled(section: object, values: Mapping[str, Any]) -> object:
    """Return a section, as it is given, with values for those of its keys that were not set; to be validated."""
    given = section.model_dump(exclude_unset=True) if isinstance(section, BaseModel) else section
    return {**values, **given} if isinstance(given, Mapping) else given
