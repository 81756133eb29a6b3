"""The linear model of a plant at its operating point, before it is a model file, and what all ways to it share."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.process.declaration import Process
from coldloop_rig.process_file.identified import Identified, Record

Array = NDArray[np.float64]

STEP: Final = 1e-5
"""Of differences, over the size of the variable."""


class Linearised(NamedTuple):
    """dx/dt = A x + B u + F w, y = C x + D u + G w in deviations from (x0, u0, w0, y0); time in seconds.

    F and G have a column for the load and one for each other disturbance, which `with_disturbances` makes states.
    """

    A: Array
    B: Array
    F: Array
    C: Array
    D: Array
    G: Array
    x0: Array
    u0: Array
    w0: Array
    y0: Array
    states: dict[str, str]
    """Name and unit of each."""
    kind: str
    """Of the plant."""
    parameters: dict[str, Any]
    """What the plant is made from, in the model file."""
    digest: str
    """Of its source."""
    error: float
    """Of the derivatives: largest difference from those with steps twice as wide, over the largest of each column."""
    notes: tuple[str, ...] = ()
    """What there is to say of how it was found, a line each."""
    record: tuple[Record, Identified] | None = None
    """What it was identified from, if it was, and what was found there."""


def operating_point(file: Process) -> tuple[Array, Array]:
    """Return the inputs at the operating point, and load (0 without) and other disturbances there, shape (1 + k,)."""
    w = [file.load.at, *(one.at for one in file.disturbances)]
    return np.array([one.at for one in file.inputs]), np.array(w)


def with_disturbances(file: Process, found: Linearised) -> Linearised:
    """Return the model with the disturbances other than the load as states, which hold, and outputs if measured."""
    n, k = len(found.A), len(file.disturbances)
    F, G = (
        matrix if file.has_load else np.hstack([0.0 * matrix[:, :1], matrix[:, 1:]]) for matrix in (found.F, found.G)
    )
    shown = np.eye(k)[[one.noise is not None for one in file.disturbances]]
    zeros = np.zeros
    return found._replace(
        A=np.block([[found.A, F[:, 1:]], [zeros((k, n + k))]]),
        B=np.vstack([found.B, zeros((k, found.B.shape[1]))]),
        F=np.vstack([F[:, :1], zeros((k, 1))]),
        C=np.block([[found.C, G[:, 1:]], [zeros((len(shown), n)), shown]]),
        D=np.vstack([found.D, zeros((len(shown), found.D.shape[1]))]),
        G=np.vstack([G[:, :1], zeros((len(shown), 1))]),
        x0=np.append(found.x0, found.w0[1:]),
        w0=found.w0[:1],
        y0=np.append(found.y0, shown @ found.w0[1:]),
        states=found.states | {one.name: one.unit for one in file.disturbances},
    )


def given_outputs(file: Process) -> Array:
    """Return the outputs at the operating point, which the file gives.

    Raises:
        UsageError: It does not.
    """
    missing = next((one.name for one in file.outputs if one.at is None), None)
    if missing is not None:
        raise UsageError(f"outputs: {missing} needs at, its value at the operating point: this plant has no equations")
    return np.array([one.at for one in file.outputs], dtype=np.float64)


def jacobian(function: Callable[[Array], Array], at: Array, scale: Array) -> tuple[Array, float]:
    """Return central differences, shape (k, len(at)), and how far those of twice the step are from them.

    Steps are shares of the variables' sizes, `scale` (len(at)).
    """
    columns, errors = [], []
    for i, size in enumerate(scale):
        by_step = []
        for h in (STEP * size, 2 * STEP * size):
            up, down = at.copy(), at.copy()
            up[i] += h
            down[i] -= h
            by_step.append((function(up) - function(down)) / (2 * h))
        fine, coarse = by_step
        columns.append(fine)
        errors.append(np.abs(fine - coarse).max() / max(np.abs(fine).max(), 1e-300))
    return np.array(columns).T, float(max(errors))
