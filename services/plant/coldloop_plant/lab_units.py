"""Sections of plant files: parameters in a lab's units, which the end of a key names, and what they are in SI."""

from typing import Final

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

IN_SI: Final = {
    "_g_sqrt_k_per_s_bar": (1.0, 1e8),  # kg sqrt(K)/(s Pa)
    "_bar": (1e5, 1.0),
    "_mm2": (1.0, 1e6),
    "_l": (1.0, 1e3),
    "_l_per_s": (1.0, 1e3),
    "_g_per_s": (1.0, 1e3),
    "_kj_per_k": (1e3, 1.0),
}
"""A unit's multiple of that of SI, as numerator and denominator; the first unit counts that a key ends with."""


def within(low: float, high: float) -> FieldInfo:
    """Return the range of a number; texts and truth values are none."""
    info: FieldInfo = Field(strict=True, ge=low, le=high)
    return info


class Section(BaseModel):
    """A section of a plant file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @property
    def si(self) -> tuple[float, ...]:
        """Its values in the order of its keys, in SI."""
        return tuple(_in_si(key, value) for key, value in self)


def _in_si(key: str, value: float) -> float:
    for unit, (numerator, denominator) in IN_SI.items():
        if key.endswith(unit):
            return value * numerator / denominator
    return value
