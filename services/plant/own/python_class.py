"""A plant that a user has written in Python: a class with its equations, in a file beside the process file."""

import hashlib
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from coldloop.errors import ModelFileError
from coldloop.process.signals import TICK_S
from plant.numeric import RealArray
from plant.program import HeatLoad, MeasurementNoise, PlantProgram


class Equations(Protocol):
    """What the class has: dx/dt = f(x, u, w) and y = h(x, u, w), in physical units and seconds."""

    states: Mapping[str, str]
    """Name and unit of each state, in order."""
    guess: Sequence[float]
    """Where the search for the operating point begins."""
    steps_per_tick: int
    """Steps of the integration in a tick."""

    def derivatives(self, x: RealArray, u: RealArray, w: float) -> RealArray | Sequence[float]:
        """Return dx/dt."""

    def outputs(self, x: RealArray, u: RealArray, w: float) -> RealArray | Sequence[float]:
        """Return y."""


def load_equations(file: Path, name: str) -> Equations:
    """Return an instance of the class of a file.

    Raises:
        ModelFileError: The file is not there or does not run, or the class lacks something.
    """
    spec = importlib.util.spec_from_file_location(f"coldloop_plant_{file.stem}", file)
    if spec is None or spec.loader is None or not file.is_file():
        raise ModelFileError(f"{file}: no such Python file; it is looked for beside the process file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        made: Any = getattr(module, name)()
    except Exception as error:
        raise ModelFileError(f"{file}: {name} cannot be made: {type(error).__name__}: {error}") from error
    for needed in ("states", "guess", "derivatives", "outputs"):
        if not hasattr(made, needed):
            raise ModelFileError(f"{file}: {name} has no {needed}; docs/your-plant.md says what it needs")
    made.steps_per_tick = int(getattr(made, "steps_per_tick", 1))
    found: Equations = made
    return found


def source_digest(file: Path, name: str) -> str:
    """Return the SHA-256 of a plant's source, in hexadecimal."""
    return hashlib.sha256(name.encode() + b"\n" + file.read_bytes()).hexdigest()


def runge_kutta(equations: Equations, x: RealArray, u: RealArray, w: float, tick_s: float) -> RealArray:
    """Return the state a tick ahead by the classical method of fourth order, in equal steps."""
    h = tick_s / equations.steps_per_tick

    def slope(at: RealArray) -> RealArray:
        return np.asarray(equations.derivatives(at, u, w), dtype=np.float64)

    for _ in range(equations.steps_per_tick):
        a = slope(x)
        b = slope(x + h / 2 * a)
        c = slope(x + h / 2 * b)
        d = slope(x + h * c)
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return x


class PythonPlant(PlantProgram):
    """A user's plant, integrated tick by tick.

    Args:
        equations: The user's.
        x0: State at tick 0.
        u0: Inputs held until the first `apply`.
        load: The load over time.
        noise: Noise on the measurements; None measures exactly.
    """

    def __init__(
        self,
        equations: Equations,
        *,
        x0: Sequence[float],
        u0: Sequence[float],
        load: HeatLoad,
        noise: MeasurementNoise | None = None,
    ) -> None:
        self._equations = equations
        super().__init__(x0=x0, u0=u0, load=load, noise=noise)

    def _read(self, w: float) -> RealArray:
        return np.asarray(self._equations.outputs(self._x, self._u, w), dtype=np.float64)

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        x = runge_kutta(self._equations, self._x, self._u, w, TICK_S)
        return x, np.asarray(self._equations.outputs(x, self._u, w), dtype=np.float64)
