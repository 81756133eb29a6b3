"""What the values of registers may be, by their declarations: the one check of all that comes from another side.

Servers check writes with it, clients what they read, and programs the records of a file.
"""

import math
import struct
from collections.abc import Sequence
from functools import cache
from typing import Any, Final, NamedTuple

from coldloop.registers.declaration import Block, Field, Kind

WIDEST: Final = {Kind.U16: (0, 0xFFFF), Kind.U32: (0, 0xFFFF_FFFF), Kind.F32: (-math.inf, math.inf)}
"""What a register can hold."""


class DomainError(ValueError):
    """A value that its register cannot have."""


class _Run(NamedTuple):
    """Neighbouring values with the same range."""

    start: int
    end: int
    low: float
    high: float


class Domain:
    """The ranges of a run of registers.

    Args:
        fields: Declaration of each register, one for each element of an array.
        names: Of the same registers, for messages.
    """

    def __init__(self, fields: Sequence[Field], names: Sequence[str]) -> None:
        self._fields = fields
        self._names = names
        self._runs = _runs_of(fields)

    def check(self, values: Sequence[Any]) -> None:
        """Check values, one for each register.

        Raises:
            DomainError: One is out of its range, or not finite where it has to be.
        """
        if math.isfinite(sum(values)):  # one pass instead of a look at each
            for start, end, low, high in self._runs:
                run = values[start:end]
                if min(run) < low or max(run) > high:
                    break
            else:
                return
        for value, field, name in zip(values, self._fields, self._names, strict=True):
            _check_value(value, field, name)


def _runs_of(fields: Sequence[Field]) -> list[_Run]:
    """Return the runs of values whose range is narrower than what their registers can hold."""
    runs: list[_Run] = []
    for place, field in enumerate(fields):
        low, high = _stored_range(field)
        if (low, high) == WIDEST[field.kind]:
            continue
        if runs and runs[-1][1:] == (place, low, high):
            runs[-1] = runs[-1]._replace(end=place + 1)
        else:
            runs.append(_Run(place, place + 1, low, high))
    return runs


def _stored_range(field: Field) -> tuple[float, float]:
    """Return the range as values are rounded: 0.01 is stored as a little less, and is still in a range from 0.01."""
    lowest, highest = WIDEST[field.kind]
    low, high = lowest if field.low is None else field.low, highest if field.high is None else field.high
    if field.kind is Kind.F32:
        low, high = struct.unpack("2f", struct.pack("2f", low, high))
    return low, high


def _check_value(value: float, field: Field, name: str) -> None:
    if not math.isfinite(value):
        if field.finite:
            raise DomainError(f"{name} is not a finite number")
        return
    low, high = _stored_range(field)
    if value < low:
        raise DomainError(f"{name} = {value:g} is below {field.low:g} {field.unit}".rstrip())
    if value > high:
        raise DomainError(f"{name} = {value:g} is above {field.high:g} {field.unit}".rstrip())


@cache
def domain_of(block: Block) -> Domain:
    """Return the (shared) domain of the rows of a block."""
    names, fields = zip(*block.elements, strict=True)
    return Domain(fields, names)
