"""What a state estimator that is not ours keeps of what the rig relies on, on a plant that is the prediction model."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.process.declaration import Process
from coldloop.process.lti_model import load
from coldloop_optimizer_plc.outside_estimator import Measured, OutsideCorrection, PlantModel, plant_model
from coldloop_optimizer_plc.qp.prediction import prediction_of
from coldloop_rig.settings import Settings
from coldloop_rig.testing.requirement import Requirement

Array = NDArray[np.float64]
Made = Callable[[PlantModel], OutsideCorrection]
Estimate = tuple[Array, float]

SEEDS: Final = range(5)
PERIODS: Final = 400
"""Updating periods of a session; of half a sampling period each, as far as ticks go."""
AHEAD: Final = 60
"""Periods over which outputs are predicted from an estimate."""
LEFT: Final = 0.1
"""Share of the first error of these predictions that may be left at the end."""
LOST: Final = range(20, 40)
"""Periods in which readings are lost, the first one alone at first and all of them in the middle one."""


def estimator_requirements(make: Made, settings: Settings) -> list[Requirement]:
    """Return what the estimators that are made keep, in a session each of several plants."""
    program = settings.optimizer_plc.program
    prediction = prediction_of(load(settings.model.file), program.estimator.disturbed, program.design)

    def model() -> PlantModel:
        return plant_model(prediction, program.estimator)

    failed = dict.fromkeys(
        ("returns a finite state of n numbers and a mismatch", "does so where readings are missing",
         "leaves the prediction and the measurement as they were", "converges on a plant that is its model",
         "gives the same bits for the same measurements", "begins a session as if there had been none before"), 0,
    )  # fmt: skip
    finite, missing, left, converges, same, fresh = failed
    for seed in SEEDS:
        world, lossy = (World(model(), settings.process, seed, loses=loses) for loses in (False, True))
        twin = make(model())
        first = world.session(make(model()))
        failed[finite] += not all(is_estimate(one, world.n) for one in first)
        failed[missing] += not all(is_estimate(one, world.n) for one in lossy.session(make(model())))
        failed[left] += world.touched
        failed[converges] += not world.left <= LEFT
        failed[same] += not equal(first, world.session(twin))
        failed[fresh] += not equal(first, world.session(make(model())))
    return [Requirement(text, failures, len(SEEDS)) for text, failures in failed.items()]


def is_estimate(estimate: Estimate, n: int) -> bool:
    """Return whether this is a finite state (n,) and mismatch."""
    x, mismatch = estimate
    return np.shape(x) == (n,) and bool(np.isfinite(x).all()) and math.isfinite(mismatch)


def equal(some: list[Estimate], others: list[Estimate]) -> bool:
    """Return whether estimates have the same bits."""
    return all(np.array_equal(x, y) and v == w for (x, v), (y, w) in zip(some, others, strict=True))


class World:
    """A plant that is the model, and begins elsewhere than the estimator believes; nothing disturbs it.

    Its inputs move; its constant errors are some of its sensors' standard deviations, and a part of its load is unseen.
    """

    def __init__(self, model: PlantModel, process: Process, seed: int, *, loses: bool) -> None:
        self._process, self._ticks = process, process.ticks_per_sample // 2
        self._model, self._seed, self._loses = model, seed, loses
        self.n = len(model.A)
        self.touched = False
        """Whether an estimator has changed what it was given."""
        self.left = math.inf
        """Error of the outputs predicted from the last estimate, over that from nothing."""

    def session(self, estimator: OutsideCorrection) -> list[Estimate]:
        """Return the estimates of a session; what is none is followed by the prediction, as in the program."""
        m, random = self._model, np.random.default_rng(self._seed)
        A, B, F = over(m, self._ticks)
        scale = math.sqrt(self._process.ticks_per_sample) * m.walks
        x = random.normal(size=self.n) * 10.0 * scale[:-1]
        unseen = float(random.normal()) * 10.0 * scale[-1] * self._process.has_load
        size = np.array([0.02 * (one.high - one.low) for one in self._process.inputs])
        predicted, mismatch, found = np.zeros(self.n), 0.0, []
        before = self._error(x, unseen, predicted, mismatch)
        u = np.zeros(len(size))
        for period in range(PERIODS):
            y = m.C @ x + m.D @ u + m.G[:, 0] * unseen
            if self._loses and period in LOST:
                y[: 1 if period != LOST[len(LOST) // 2] else None] = np.nan
            measured = Measured(self._ticks, u.copy(), 0.0, y.copy())
            given = predicted.copy()
            estimate = estimator.correct(given, mismatch, measured)
            self.touched |= not (
                np.array_equal(given, predicted) and np.array_equal(measured.y, y, equal_nan=True)
                and np.array_equal(measured.u, u)
            )  # fmt: skip
            found.append((np.array(estimate[0], np.float64), float(estimate[1])))
            if is_estimate(found[-1], self.n):
                predicted, mismatch = found[-1]
            self.left = self._error(x, unseen, predicted, mismatch) / before
            u = size * np.sin(0.1 * period + np.arange(len(size)))
            x = A @ x + B @ u + F[:, 0] * unseen
            predicted = A @ predicted + B @ u + F[:, 0] * mismatch
        return found

    def _error(self, x: Array, unseen: float, found: Array, mismatch: float) -> float:
        """Return the error of outputs predicted from an estimate, over the sensors' noise, root mean square."""
        m, (A, _, F) = self._model, over(self._model, self._ticks)
        e, w, errors = x - found, unseen - mismatch, []
        for _ in range(AHEAD):
            e = A @ e + F[:, 0] * w
            errors.append((m.C @ e + m.G[:, 0] * w) / m.noise)
        return float(np.sqrt(np.mean(np.square(errors))))


def over(model: PlantModel, ticks: int) -> tuple[Array, Array, Array]:
    """Return A, B and F over so many ticks."""
    A, B, F = np.eye(len(model.A)), np.zeros_like(model.B), np.zeros_like(model.F)
    for _ in range(ticks):
        A, B, F = model.A @ A, model.A @ B + model.B, model.A @ F + model.F
    return A, B, F
