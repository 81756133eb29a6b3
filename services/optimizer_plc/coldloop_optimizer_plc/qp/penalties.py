"""What broken constraints cost in the augmented cost J, and presets; it imports nothing that takes time.

J = J_0 + alpha sum max(Gamma z - gamma, 0)^2 + box alpha sum max(z - high, low - z, 0)^2 is the paper's eq. augmentedJ
with mu = 2. `docs/penalties.md` says what each of these settings does to costs and figures.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Final

from pydantic import BaseModel, Field

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.declaration import Process
from coldloop.process.settings import PositivePerInput, ProcessSettings, declared
from coldloop_optimizer_plc.qp.design import ControlDesign


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
    """As good as this project knows how to make it: the paper's preset and an estimator of constant errors; of the cold
    box also a limit of CV155 where opening it further cools less, and rows that keep outputs inside their bands at
    rest."""
    PAPER = "paper"
    """The paper's problem and estimator, with the truncated solver as good as this project knows how to make it."""
    AS_PRINTED = "as-printed"
    """What the paper prints and no more. Of the numbers that it leaves open, alpha is rho, all rows have the same alpha
    in their own units, and cost_scale is the one whose costs come down with the iterations as in the paper's figure."""


UNMEASURED: Final = "unmeasured"
"""What section `estimator` of a process's preset `tuned` has instead where the load is not measured."""


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
