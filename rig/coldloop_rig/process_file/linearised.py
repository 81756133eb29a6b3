"""The linear model of a process file's plant at its operating point, whichever way the plant is given."""

import warnings
from math import factorial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.process.declaration import Process
from coldloop.process.lti_model import discretise
from coldloop.process.sections import Lag, PlantSource
from coldloop_plant.own.disturbances import outside
from coldloop_plant.own.maker import FMU, PYTHON, TRANSFER_FUNCTIONS
from coldloop_plant.own.python_class import Equations, equations_of, evaluated
from coldloop_rig.process_file.fmu_model import from_fmu
from coldloop_rig.process_file.linear_model import (
    Linearised,
    given_outputs,
    jacobian,
    operating_point,
    with_disturbances,
)
from coldloop_rig.process_file.matrices import from_matrices
from coldloop_rig.process_file.source import installed_source, source_of
from coldloop_rig.process_file.step_test import from_step_test, record_compared

Array = NDArray[np.float64]

AT_REST: Final = 1e-8
"""Largest change of a state in a sampling period, over its size, that still counts as rest."""
SEEN: Final = 0.1
"""Gain over the largest of an output, from which on a record must show it."""
ALIKE: Final = (0.5, 2.0)
"""Gains of a record's model over those of the plant."""
PADE_ORDER: Final = 2
"""Of the approximation of a dead time in the prediction model; the simulated plant has it exactly."""


def linearised(file: Process, folder: Path) -> Linearised:
    """Return the model of a process whose file is in a folder.

    Raises:
        ColdloopError: The plant cannot be read, does not rest, or does not fit the signals: one line.
    """
    plant = file.plant
    if plant.python is not None:
        found = _from_equations(file, plant.python, *source_of(folder, plant.python))
    elif plant.installed is not None:
        found = _from_equations(file, plant.installed, *installed_source(plant.installed))
    elif plant.matrices is not None:
        found = from_matrices(file, folder, plant.matrices)
    elif plant.step_test is not None:
        found = from_step_test(file, folder / plant.step_test)
    elif plant.fmu is not None:
        found = from_fmu(file, folder, plant.fmu)
    else:
        found = _from_lags(file, plant)
    if not len(found.A):
        raise UsageError(
            "plant: it has no states, so there is nothing to predict; give the dynamics of its actuators at least"
        )
    if file.prediction.step_test is not None:
        found = _by_record(file, found, folder / file.prediction.step_test)
    for name in ("A", "B", "F", "C", "D", "G", "x0", "y0"):
        if not np.isfinite(getattr(found, name)).all():
            raise UsageError(f"plant: {name} of the linear model is not finite; look at the plant's equations there")
    return with_disturbances(file, found)


def _by_record(file: Process, plant: Linearised, path: Path) -> Linearised:
    """Return the model of a record, for a plant that hides its states."""
    model = from_step_test(file, path)
    hidden = dict(plant.parameters)
    if plant.kind == PYTHON:
        hidden["rest"] = plant.x0.tolist()
    elif plant.kind == FMU:
        hidden["wiring"] = {**hidden["wiring"], "states": ()}
    compared = (*_gains_compared(file, plant, model), *record_compared(file, path, plant, model))
    notes = (*plant.notes, *model.notes, *compared)
    return model._replace(kind=plant.kind, parameters=hidden, digest=plant.digest, notes=notes)


def _gains_compared(file: Process, plant: Linearised, model: Linearised) -> list[str]:
    """Return which gains of a record's model, after the horizon, are far from those of the plant that it is for."""
    true, found = (one.C @ discretise(one.A, one.B, one.F[:, 0], file.horizon_s).B + one.D for one in (plant, model))
    seen = np.abs(true) > SEEN * np.abs(true).max(axis=1, keepdims=True)
    return [
        f"warning    gain: of {file.outputs[i].name} by {file.inputs[j].name} {found[i, j]:.3g}, of the plant itself "
        f"{true[i, j]:.3g}; is the record of this plant, in the units of this file?"
        for i, j in np.argwhere(seen)
        if not ALIKE[0] <= found[i, j] / true[i, j] <= ALIKE[1]
    ]


# -- a class with equations ------------------------------------------------------------------------------------------


def _from_equations(file: Process, place: str, source: str, name: str) -> Linearised:
    equations = equations_of(source, name, place)
    u, w = operating_point(file)
    n, m = len(equations.states), len(u)
    x = _rest(equations, u, w, place, file.tick_s * file.ticks_per_sample) if n else np.zeros(0)
    y = evaluated(equations.outputs, x, u, outside(w), size=len(file.outputs), where=place)

    def flow(v: Array) -> Array:
        return evaluated(equations.derivatives, v[:n], v[n : n + m], outside(v[n + m :]), size=n, where=place)

    def read(v: Array) -> Array:
        return evaluated(equations.outputs, v[:n], v[n : n + m], outside(v[n + m :]), size=len(y), where=place)

    at = np.array([*x, *u, *w])
    steps = [(one.high - one.low) / 4 for one in file.inputs]
    scale = np.array([*_sizes(x, equations), *steps, *_outside_sizes(file)])
    (J, one), (H, other) = jacobian(flow, at, scale), jacobian(read, at, scale)
    parameters = {"file": place.partition(":")[0], "class": name, "source": source}
    return Linearised(
        J[:, :n], J[:, n : n + m], J[:, n + m :], H[:, :n], H[:, n : n + m], H[:, n + m :], x, u, w, y,
        dict(equations.states), PYTHON, parameters, "", max(one, other),
    )  # fmt: skip


def _sizes(x: Array, equations: Equations) -> Array:
    """Return how large states are: their values at rest, or at the guess, or 1 where both are 0."""
    size = np.maximum(np.abs(x), np.abs(np.array(equations.guess, dtype=np.float64)))
    return np.where(size > 0.0, size, 1.0)


def _outside_sizes(file: Process) -> list[float]:
    spans = [file.load.span if file.has_load else (0.0, 4.0), *(one.span for one in file.disturbances)]
    return [0.25 * (high - low) for low, high in spans]


def _rest(equations: Equations, u: Array, w: Array, place: str, sample_s: float) -> Array:
    """Return the state that does not move: in a sample by no more than `AT_REST` of its size."""
    from scipy.optimize import root  # noqa: PLC0415

    guess = np.array(equations.guess, dtype=np.float64)
    size = _sizes(guess, equations)

    def motion(scaled: Array) -> Array:
        slope = evaluated(
            equations.derivatives, scaled * size, u, outside(w), size=len(size), where=f"{place}, near guess"
        )
        return sample_s * slope / size

    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = root(motion, guess / size, tol=1e-12)
        left = np.abs(motion(found.x)) / np.maximum(1.0, np.abs(found.x))
    if not np.all(left <= AT_REST):
        worst = list(equations.states)[int(np.argmax(np.where(np.isfinite(left), left, np.inf)))]
        raise UsageError(
            f"{place}: no state of rest with the inputs at their operating point: {worst} keeps moving; give other "
            "values of at, or a guess nearer to it"
        )
    return np.array(found.x * size, dtype=np.float64)


# -- transfer functions ----------------------------------------------------------------------------------------------


def _from_lags(file: Process, plant: PlantSource) -> Linearised:
    """Return the lags side by side: a state each, and before it as many as its dead time is approximated with."""
    lags, m = plant.transfer_functions or (), len(file.inputs)
    sources = {one.name: i for i, one in enumerate(file.inputs)} | ({file.load.name: m} if file.has_load else {})
    sources |= {one.name: i for i, one in enumerate(file.disturbances, m + 1)}
    outputs = {one.name: i for i, one in enumerate(file.outputs)}
    for lag in lags:
        if lag.source not in sources or lag.output not in outputs:
            unknown = lag.source if lag.source not in sources else lag.output
            raise UsageError(f"plant.transfer_functions: {unknown} is no signal of this file")
    parts = [lag_model(lag) for lag in lags]
    n = sum(len(a) for a, _, _ in parts)
    k = 1 + len(file.disturbances)
    A, B, C = np.zeros((n, n)), np.zeros((n, m + k)), np.zeros((len(outputs), n))
    states: dict[str, str] = {}
    first = 0
    for lag, (a, b, c) in zip(lags, parts, strict=True):
        place = slice(first, first + len(a))
        A[place, place], B[place, sources[lag.source]], C[outputs[lag.output], place] = a, b, c
        unit = file.outputs[outputs[lag.output]].unit
        states |= {f"{lag.output}_{lag.source}_{i}": unit for i in range(1, len(a) + 1)}
        first += len(a)
    u, w = operating_point(file)
    return Linearised(
        A, B[:, :m], B[:, m:], C, np.zeros((len(outputs), m)), np.zeros((len(outputs), k)), np.zeros(n), u, w,
        given_outputs(file), states, TRANSFER_FUNCTIONS, {"lags": [lag.model_dump() for lag in lags]}, "", 0.0,
    )  # fmt: skip


def lag_model(lag: Lag) -> tuple[Array, Array, Array]:
    """Return A (k, k), b (k,), c (k,) of one lag, its dead time by a Pade approximation, its state last."""
    rate = 1.0 / lag.time_constant_s
    if lag.delay_s == 0.0:
        return np.array([[-rate]]), np.array([lag.gain * rate]), np.ones(1)
    a, b, c, d = _dead_time(lag.delay_s)
    k = len(a)
    A = np.zeros((k + 1, k + 1))
    A[:k, :k], A[k, :k], A[k, k] = a, lag.gain * rate * c, -rate
    return A, np.array([*b, lag.gain * rate * d]), np.array([*np.zeros(k), 1.0])


def _dead_time(delay_s: float) -> tuple[Array, Array, Array, float]:
    """Return the state space of the diagonal Pade approximation of exp(-delay s), in companion form, scaled by time.

    Golub and Van Loan, Matrix Computations, section 9.3.
    """
    k = PADE_ORDER
    share = [
        factorial(2 * k - j) * factorial(k) / (factorial(2 * k) * factorial(j) * factorial(k - j)) for j in range(k + 1)
    ]
    above = np.array([(-1) ** j * share[j] for j in range(k + 1)]) / share[k]  # rising powers of s times the delay
    below = np.array(share) / share[k]
    d = above[k]
    a = np.zeros((k, k))
    a[:-1, 1:] = np.eye(k - 1)
    a[-1] = -below[:k]
    return a / delay_s, np.array([*np.zeros(k - 1), 1.0]) / delay_s, above[:k] - d * below[:k], d
