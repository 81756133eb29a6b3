"""Numbers as people read them, the same in sentences, tables, figures and, by `numbers.js`, on the operator's page."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

PLAIN: Final = range(-4, 7)
"""Decimal exponents of numbers that are written without one."""
LONGEST_FRACTION: Final = 7
"""Digits after the point of a mark; marks that need more have an exponent."""
NEAR: Final = 1e-3
"""Tolerance of the label of a mark, in steps of the marks."""


def number_text(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, at least those before the point."""
    if not math.isfinite(value):
        return str(value)
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if float(mantissa) == 0.0:
        return "0"
    if int(exponent) in PLAIN:
        return _trimmed(f"{value:.{max(0, digits - 1 - int(exponent))}f}")
    return f"{_trimmed(mantissa)}e{int(exponent)}"


def value_text(value: float, unit: str = "") -> str:
    """Return a value of a register, which has seven digits, with its unit."""
    return f"{number_text(value, 7)} {unit}".rstrip()


def ends_text(low: float, high: float) -> str:
    """Return a range of values in words."""
    return f"{value_text(low)} to {value_text(high)}"


def axis_labels(marks: Sequence[float]) -> list[str]:
    """Return labels of the marks of a linear axis: as many digits as their step needs, so that neighbours differ."""
    known = sorted({float(mark) for mark in marks if math.isfinite(mark)})
    step = min((after - before for before, after in pairwise(known)), default=0.0)
    if step == 0.0:
        return [number_text(mark, 7) for mark in marks]
    top = max(abs(known[0]), abs(known[-1]))
    if top < 10.0**PLAIN.stop:
        for places in range(LONGEST_FRACTION + 1):
            if all(abs(float(f"{mark:.{places}f}") - mark) <= NEAR * step for mark in known):
                return [_unsigned_zero(f"{mark:.{places}f}") for mark in marks]
    digits = 1
    while digits < 17 and any(abs(float(f"{mark:.{digits - 1}e}") - mark) > NEAR * step for mark in known):
        digits += 1
    return [number_text(mark, digits) for mark in marks]


def _trimmed(text: str) -> str:
    return _unsigned_zero(text.rstrip("0").rstrip(".") if "." in text else text)


def _unsigned_zero(text: str) -> str:
    return text.removeprefix("-") if float(text) == 0.0 else text
