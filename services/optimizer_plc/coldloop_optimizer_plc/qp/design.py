"""What the constrained predictive controller is asked to do: weights, bands and instants (paper, section IV).

The paper leaves weights and scaling open; `docs/science.md` lists those of this project.
"""

from enum import StrEnum
from itertools import pairwise
from typing import Annotated, Final, Self

from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    PositiveFloat,
    ValidationInfo,
    field_validator,
    model_validator,
)

from coldloop.process.sections import FURTHEST_WEIGHT
from coldloop.process.settings import (
    PerBand,
    PerInput,
    PositivePerBand,
    ProcessSettings,
    declared,
    settings_process,
    stretched,
)


def _rising_instants(instants: tuple[int, ...]) -> tuple[int, ...]:
    if not instants or instants[0] < 1 or any(b <= a for a, b in pairwise(instants)):
        raise ValueError("instants must be rising sample numbers of at least 1")
    return instants


Instants = Annotated[tuple[int, ...], AfterValidator(_rising_instants)]


FURTHEST_SCALE: Final = 100.0
"""Largest factor between a scale and the process's own. With scales of inputs that are 1e-3 of it the first step of the
ODE-based solver is so short that the inputs of the cold box hardly move."""


class Target(StrEnum):
    """What the cost is about: where the plant should come to rest."""

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
    """In % of the vessel."""
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
