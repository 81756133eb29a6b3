"""Somebody else's solver, rule or estimator, by an entry point: nothing is edited here to use it.

An estimator, of the group `coldloop.estimators`, corrects the state that the prediction model has reached since the
last measurement; predictions are the model's. For the others see `solvers.interface` and `rules`.
"""

import math
from contextlib import AbstractContextManager
from enum import StrEnum
from importlib.metadata import entry_points
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError, foreign
from coldloop_optimizer_plc.computing_settings import EstimatorSettings
from coldloop_optimizer_plc.estimator import Belief, Estimator, walks_of
from coldloop_optimizer_plc.qp.prediction import PredictionModel

Array = NDArray[np.float64]


class Part(StrEnum):
    """Part of another project: a key of `optimizer_plc.program.outside`, and the group `coldloop.<part>s`."""

    SOLVER = "solver"
    RULE = "rule"
    ESTIMATOR = "estimator"


def made(part: Part, name: str, *given: object) -> Any:  # noqa: ANN401 the caller knows its protocol
    """Return what the entry point of this name makes of what it is given.

    Raises:
        ConfigurationError: There is none, or it cannot be made.
    """
    with in_its_name(part, name, "cannot be made: "):
        return loaded(part, name)(*given)


def loaded(part: Part, name: str) -> Any:  # noqa: ANN401 as above
    """Return what the entry point of this name points at, a class or a function.

    Raises:
        ConfigurationError: There is none, or it cannot be imported.
    """
    group = f"coldloop.{part}s"
    there = entry_points(group=group)
    if name not in there.names:
        known = ", ".join(sorted(there.names)) or "none is installed"
        raise ConfigurationError(
            f"optimizer_plc.program.outside.{part}: no {part} '{name}' among the entry points {group}: {known}"
        )
    with in_its_name(part, name, "cannot be made: "):
        return there[name].load()


def in_its_name(part: Part, name: str, what: str = "") -> AbstractContextManager[None]:
    """Call what is not ours: what it raises is a `ConfigurationError` of one line, with its name unless it is one."""
    called = f"{part} {name}: {what}".removesuffix(": ")
    return foreign(called, "the optimiser ends here: mend it, or choose another", kind=ConfigurationError)


class PlantModel(NamedTuple):
    """x' = A x + B u + F w over a tick, y = C x + D u + G w, as deviations from the operating point.

    The last states are the constants that `estimator.disturbances` names: nothing moves them, and C adds them.
    """

    A: Array
    B: Array
    F: Array
    """Shape (n, 1)."""
    C: Array
    D: Array
    G: Array
    """Shape (n_y, 1)."""
    tick_s: float
    constants: int
    """How many of the states are constants."""
    noise: Array
    """Standard deviation of each sensor, shape (n_y,)."""
    walks: Array
    """Process noise of the states and, last, of the load's mismatch, per square root of a tick; shape (n + 1,)."""


class Measured(NamedTuple):
    """Measurement at an updating instant, as deviations from the operating point."""

    ticks: int
    """Since the last measurement."""
    u: Array
    """Inputs applied until now, shape (m,)."""
    load: float
    """Load that is measured; 0 where it is not."""
    y: Array
    """Outputs, shape (n_y,); not a number where a reading is bad."""


class OutsideCorrection(Protocol):
    """Estimator that an entry point makes for each session; the same measurements give the same bits."""

    def __init__(self, model: PlantModel) -> None:
        """Begin at the operating point."""

    def correct(self, predicted: Array, mismatch: float, measured: Measured) -> tuple[Array, float]:
        """Return the state (n,) and the load's mismatch after a measurement, from those that were predicted for it.

        The load that acts is `measured.load` plus the mismatch, which is the share that no sensor sees.
        """


class OutsideEstimator:
    """One of these: what it returns is checked; what is no estimate, or not finite, leaves the prediction as it is."""

    def __init__(self, name: str, prediction: PredictionModel, settings: EstimatorSettings) -> None:
        self.name = name
        self._n_states = prediction.n_estimated
        self._estimator: OutsideCorrection = made(Part.ESTIMATOR, name, plant_model(prediction, settings))

    def correct(self, c: Estimator, belief: Belief, u_before: Array, load: float, y: Array) -> None:
        """Take a measurement (u_before (m,), load, y (n_y,), in physical units), as `estimator.correct` does.

        Raises:
            ConfigurationError: The estimator raises, or returns something else than a state and a number.
        """
        b, predicted = belief.numbers[0], belief.predicted[: self._n_states]
        known = load - c.w0 if c.load_known else 0.0
        measured = Measured(int(b["since"]), u_before - c.u0, known, y - c.y0)
        with in_its_name(Part.ESTIMATOR, self.name):
            x, mismatch = self._estimator.correct(predicted.copy(), float(b["mismatch"]), measured)
            x, mismatch = np.asarray(x, np.float64), float(mismatch)
        if x.shape == predicted.shape and np.isfinite(x).all() and math.isfinite(mismatch):
            predicted[:], b["mismatch"] = x, mismatch
        belief.x[:] = belief.predicted
        b["w"] = known + b["mismatch"]


def plant_model(prediction: PredictionModel, settings: EstimatorSettings) -> PlantModel:
    """Return what an outside estimator is given of the model: copies, which it may change."""
    n, step, process = prediction.n_estimated, prediction.transitions[1], prediction.process
    A, B, F = step.A[:n, :n].copy(), step.B[:n].copy(), step.F[:n].copy()
    C, D, G = prediction.C[:, :n].copy(), prediction.D.copy(), prediction.G.copy()
    walks = walks_of(prediction, settings) * math.sqrt(process.tick_s / process.sampling_period_s)
    return PlantModel(A, B, F, C, D, G, process.tick_s, len(prediction.disturbances), np.array(settings.sensors), walks)
