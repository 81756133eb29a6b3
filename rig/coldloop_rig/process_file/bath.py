"""What a process with a bath must be, beyond its declaration: by its operating point and its linear model."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.process.declaration import Process
from coldloop.process.lti_model import LtiModel
from coldloop.process.sections import Bath

Array = NDArray[np.float64]

SINGULAR: Final = 1e-9
"""Least singular value over the largest, of equations with rows and columns of size 1, that still have a solution."""
STILL: Final = 0.1
"""Part of itself that a mode may move by over the horizon and still integrate."""


def check_bath(file: Process, model: LtiModel, bath: Bath) -> None:
    """Check that the laws of a bath have an answer.

    Raises:
        UsageError: They have none: one line.
    """
    for name in bath.states:
        if name not in model.state_names:
            raise UsageError(f"bath: {name} is no state of the plant: {', '.join(model.state_names)}")
        if bath.states.count(name) > 1:
            raise UsageError(f"bath: {name} is named twice")
    level = model.C[model.output_names.index(bath.level)]
    if bath.level_state and not level[model.state_names.index(bath.level_state)]:
        raise UsageError(f"bath: {bath.level} does not show {bath.level_state}; name the state that is its level")
    disturbances = {one.name for one in file.disturbances}.intersection(bath.states)
    if disturbances:
        raise UsageError(f"bath: {min(disturbances)} is a disturbance, and no state of the bath; take it out")
    if bath.holdable_load is not None and not bath.holdable_load[0] <= model.w0 <= bath.holdable_load[1]:
        raise UsageError(f"bath: holdable_load is without the operating point, {model.w0:g}, which is held; widen it")
    if not _rests(model, bath):
        raise UsageError(
            f"bath: with constant inputs no load lets the states and {bath.level} rest: either the load does not move "
            "it, or something else does that never rests"
        )


def _rests(model: LtiModel, bath: Bath) -> bool:
    moved, level = model.moved, model.output_names.index(bath.level)
    equations = np.block([
        [model.A[np.ix_(moved, moved)], model.F[moved, None]], [model.C[[level]][:, moved], model.G[[[level]]]],
    ])  # fmt: skip
    for axis in (1, 0, 1, 0):
        size = np.abs(equations).max(axis=axis, keepdims=True)
        if not size.all():
            return False
        equations = equations / size
    sizes = np.linalg.svd(equations, compute_uv=False)
    return bool(sizes[-1] > SINGULAR * sizes[0])


def exchanged(model: LtiModel, bath: Bath, horizon_s: float) -> list[str]:
    """Return what a control engineer would want to know of the outputs that are named, in words."""
    values, modes = np.linalg.eig(model.A[np.ix_(model.moved, model.moved)])
    slowest = int(np.argmin(np.abs(values)))
    shown = np.abs(model.C[:, model.moved] @ modes[:, slowest])
    level, outlet = (shown[model.output_names.index(name)] for name in (bath.level, bath.turbine_outlet))
    if abs(values[slowest]) * horizon_s > STILL:
        return [f"bath: no mode integrates as a level does, so {bath.level} is none"]
    if level <= outlet:
        return [f"bath: {bath.turbine_outlet} integrates as a level does, {bath.level} less; are they exchanged?"]
    return []
