"""A plant that a user has written in Python: a class with its equations. Its source is in the model file."""

import hashlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, Final, Protocol

import numpy as np

from coldloop.errors import ModelFileError
from coldloop.foreign import foreign
from coldloop.process.declaration import Process
from coldloop_plant.numeric import RealArray
from coldloop_plant.own.disturbances import NO_DISTURBANCES, Disturbances, DisturbedPlant, outside
from coldloop_plant.program import HeatLoad, MeasurementNoise

NAME: Final = r"[A-Za-z][A-Za-z0-9_]{0,31}"
"""Of a signal or a state."""


class Equations(Protocol):
    """What the class has: dx/dt = f(x, u, w) and y = h(x, u, w), in physical units and seconds."""

    states: Mapping[str, str]
    """Name and unit of each state, in order."""
    guess: Sequence[float]
    """Where the search for the operating point begins."""
    steps_per_tick: int
    """Steps of the integration in a tick."""

    def derivatives(self, x: RealArray, u: RealArray, w: float | RealArray) -> RealArray | Sequence[float]:
        """Return dx/dt."""

    def outputs(self, x: RealArray, u: RealArray, w: float | RealArray) -> RealArray | Sequence[float]:
        """Return y."""


def made_by(source: str, name: str, where: str) -> Any:  # noqa: ANN401 whatever the user has written
    """Return what a Python source calls by a name; `where` names it in messages.

    Raises:
        ModelFileError: The source does not run, or has nothing of this name: one line.
    """
    digest = hashlib.sha256(source.encode()).hexdigest()[:12]  # another file may have a class of this name
    module = ModuleType(f"coldloop_plant_{name}_{digest}")
    sys.modules[module.__name__] = module  # dataclasses look there
    with foreign(f"{where}: {name} cannot be made"):
        exec(compile(source, where, "exec"), vars(module))  # noqa: S102 it is what the user has written
        return getattr(module, name)


def equations_of(source: str, name: str, where: str) -> Equations:
    """Return an instance of a class of a Python source; `where` names it in messages.

    Raises:
        ModelFileError: The source does not run, or the class lacks something: one line.
    """
    kind = made_by(source, name, where)
    with foreign(f"{where}: {name} cannot be made"):
        made: Any = kind()
        made.steps_per_tick = int(getattr(made, "steps_per_tick", 1))
        states, guess = dict(made.states), np.array(made.guess, dtype=np.float64)
    for needed in ("derivatives", "outputs"):
        if not callable(getattr(made, needed, None)):
            raise ModelFileError(
                f"{where}: {name} has no {needed}(x, u, w); `coldloop docs your-plant` says what it needs"
            )
    if not isinstance(made.states, Mapping) or not all(re.fullmatch(NAME, str(each)) for each in states):
        raise ModelFileError(f'{where}: states of {name} are a dict of names and units, such as {{"T": "K"}}')
    if guess.shape != (len(states),):
        raise ModelFileError(f"{where}: guess of {name} has {guess.size} numbers, there are {len(states)} states")
    if made.steps_per_tick < 1:
        raise ModelFileError(f"{where}: steps_per_tick of {name} is {made.steps_per_tick}; it is 1 or more")
    found: Equations = made
    return found


def evaluated(function: Callable[..., Any], *at: Any, size: int, where: str) -> RealArray:  # noqa: ANN401
    """Return what derivatives() or outputs() give at a point, shape (size,).

    Raises:
        ModelFileError: It fails there, or returns something else: one line.
    """
    name = getattr(function, "__name__", "it")
    with foreign(f"{where}: {name}() fails"):
        found = np.asarray(function(*at), dtype=np.float64)
    if found.shape != (size,):
        raise ModelFileError(f"{where}: {name}() returns {found.size} numbers, not {size}")
    return found


def runge_kutta(equations: Equations, x: RealArray, u: RealArray, w: float | RealArray, tick_s: float) -> RealArray:
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


class PythonPlant(DisturbedPlant):
    """A user's plant, integrated tick by tick.

    Args:
        equations: The user's.
        x0: State at tick 0.
        u0: Inputs held until the first `apply`.
        load: The load over time.
        disturbances: Others than the load.
        noise: Noise on the measurements; None measures exactly.
        process: Whose plant it is.
    """

    def __init__(
        self,
        equations: Equations,
        *,
        x0: Sequence[float],
        u0: Sequence[float],
        load: HeatLoad,
        disturbances: Disturbances = NO_DISTURBANCES,
        noise: MeasurementNoise | None = None,
        process: Process,
    ) -> None:
        self._equations = equations
        self.whose = f"the plant's class {type(equations).__name__}"
        super().__init__(disturbances, x0=x0, u0=u0, load=load, noise=noise, process=process)

    def _seen(self, x: RealArray, w: RealArray) -> RealArray:
        return np.asarray(self._equations.outputs(x, self._u, outside(w)), dtype=np.float64)

    def _own_outputs(self, w: RealArray) -> RealArray:
        return self._seen(self._own, w)

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        x = runge_kutta(self._equations, self._own, self._u, outside(w), self.process.tick_s)
        return x, self._seen(x, w)


class HiddenPythonPlant(PythonPlant):
    """The same, where the model has other states: those of the equations are not shown, the model's are zeros.

    Args:
        rest: States of the equations at tick 0.
        equations: The user's.
        arguments: Of `PythonPlant`; `x0` is what is shown.
    """

    def __init__(self, equations: Equations, *, rest: Sequence[float], **arguments: Any) -> None:  # noqa: ANN401
        self._hidden = np.array(rest, dtype=np.float64)
        super().__init__(equations, **arguments)

    def _warm_up(self) -> None:
        """Do nothing: a tick would move what is hidden."""

    def _own_outputs(self, w: RealArray) -> RealArray:
        return self._seen(self._hidden, w)

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        self._hidden = runge_kutta(self._equations, self._hidden, self._u, outside(w), self.process.tick_s)
        return self._own, self._seen(self._hidden, w)

    def _saved(self) -> dict[str, Any]:
        return {"hidden": self._hidden.tolist()}

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        if saved is None or len(saved["hidden"]) != len(self._hidden):
            raise ValueError("the retained state is that of another plant")
        self._hidden = np.array(saved["hidden"], dtype=np.float64)
