"""What the parameters of the warm components may be."""

from math import isfinite


class ParameterError(ValueError):
    """A parameter of a component is out of range; one line that names it, its value and its range."""


def require(component: str, name: str, value: float, low: float, high: float) -> None:
    """Check that a parameter is finite and from `low` (exclusive) to `high`.

    Raises:
        ParameterError: It is not.
    """
    if not (isfinite(value) and low < value <= high):
        raise ParameterError(f"{component}.{name} = {value:g}: take a number above {low:g} and at most {high:g}")
