"""Actuator of a valve: the opening follows its command with a lag and no faster than the drive can."""

from typing import NamedTuple

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.parameters import require
from coldloop_plant.numeric import at_least, at_most


class Actuator(NamedTuple):
    """A pneumatic drive with its positioner."""

    lag: float
    """Time constant, s; 0.5 or more, for a step of 0.25 s."""
    fastest: float
    """Largest speed, %/s."""


@kernel
def opening_rate(actuator: Actuator, opening: float, command: float) -> float:
    """Return how fast an opening (%) moves towards its command (%, held within 0 and 100), in %/s."""
    aim = at_most(at_least(command, 0.0), 100.0)
    return at_most(at_least((aim - opening) / actuator.lag, -actuator.fastest), actuator.fastest)


def check_actuator(name: str, actuator: Actuator) -> None:
    """Refuse parameters that no drive has, or that are too fast for a step of 0.25 s (`ParameterError`)."""
    require(name, "lag", actuator.lag, 0.499999, 1e3)
    require(name, "fastest", actuator.fastest, 0.0, 1e3)
