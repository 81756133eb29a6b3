"""A process file made into a model file: the linear model of its plant, and the process that it completes."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.process.declaration import Process
from coldloop.process.lti_model import LtiModel, discretise
from coldloop.process.sections import Bath, Output, State
from coldloop_plant.equilibrium import Linear, model_of
from coldloop_plant.own.plants import FMU, PYTHON, file_digest
from coldloop_rig.plc_sizing.operations import ProblemSizes, iteration_shares
from coldloop_rig.process_file.fmu_model import from_fmu, with_units
from coldloop_rig.process_file.linear_model import (
    Linearised,
    from_equations,
    from_lags,
    from_matrices,
    with_disturbances,
)
from coldloop_rig.process_file.mimic import drawing_of
from coldloop_rig.process_file.reading import courses_of, forecasts_of, installed_source, read_process_file, source_of
from coldloop_rig.process_file.step_test import from_step_test, record_compared

Array = NDArray[np.float64]

REGISTERS_OF_A_REQUEST: Final = 125
"""Registers of one Modbus read at most: the latched update, and the rack's measurement, are one read each."""
TINY: Final = 1e-12
TOLD_APART: Final = 1e-6
"""Least singular value, of columns of size 1, with which biases are observable separately from states."""
USUAL_WALK: Final = 0.01
"""Process noise of a state over what it moves by when each input makes its largest step, held for the horizon."""
SINGULAR: Final = 1e-9
"""Least singular value over the largest, of equations with rows and columns of size 1, that still have a solution."""
SEEN: Final = 0.1
"""Gain over the largest of an output, from which on a record must show it."""
ALIKE: Final = (0.5, 2.0)
"""Gains of a record's model over those of the plant."""


@dataclass(frozen=True)
class Made:
    """Model and process that are made from a process file."""

    model: LtiModel
    process: Process
    linear: Linearised
    disturbances: int
    """States at the end that are disturbances."""

    @property
    def own_A(self) -> Array:
        """A (n, n) of the plant without disturbances."""
        n = len(self.linear.A) - self.disturbances
        return self.linear.A[:n, :n]


def made_from(path: Path) -> Made:
    """Return the model of a process file.

    Raises:
        ColdloopError: One line that names file, key and remedy.
    """
    said = read_process_file(path)
    file = with_units(said, path.parent)
    linear = linearised(file, path.parent)
    file = _with_sensors(file, linear.y0.tolist())
    process = file.model_copy(update={
        "states": _states(file, linear), "constants": file.constants or _constants(file, linear),
        "iterations": iteration_shares(_sizes(file, len(linear.states))),
        "forecasts": forecasts_of(file, path.parent), "drawing": _drawing(file, path.parent),
    })  # fmt: skip
    _check_room(process)
    _check_rest(file, linear)
    matrices = Linear(linear.A, linear.B, linear.F[:, 0], linear.C, linear.D, linear.G[:, 0])
    model = model_of(
        matrices, linear.x0, linear.u0, float(linear.w0[0]), linear.y0, process, linear.states, linear.digest,
        plant=linear.kind, note=f"made from {path.name}", process=process.model_dump(mode="json"),
        plant_parameters=linear.parameters | courses_of(file, path.parent),
        declaration_digest=declaration_digest(said, path.parent),
    )  # fmt: skip
    if process.bath is not None:
        _check_bath(file, model, process.bath)
    return Made(model, process, linear, len(file.disturbances))


def linearised(file: Process, folder: Path) -> Linearised:
    """Return the model of a process whose file is in a folder.

    Raises:
        ColdloopError: The plant cannot be read, does not rest, or does not fit the signals: one line.
    """
    plant = file.plant
    if plant.python is not None:
        found = from_equations(file, plant.python, *source_of(folder, plant.python))
    elif plant.installed is not None:
        found = from_equations(file, plant.installed, *installed_source(plant.installed))
    elif plant.matrices is not None:
        found = from_matrices(file, folder, plant.matrices)
    elif plant.step_test is not None:
        found = from_step_test(file, folder / plant.step_test)
    elif plant.fmu is not None:
        found = from_fmu(file, folder, plant.fmu)
    else:
        found = from_lags(file, plant)
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


def declaration_digest(file: Process, folder: Path) -> str:
    """Return the SHA-256 of what a process file says, and of all files that it names: the same on all machines.

    The matrices that are made from it may differ in their last bits by the versions of Python and NumPy.
    """
    named: dict[str, str] = {}

    def look(value: object) -> None:
        for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            look(each)
        if isinstance(value, str) and value and (folder / (place := value.partition(":")[0])).is_file():
            named[place] = file_digest(folder / place)

    said = file.model_dump(mode="json")
    look(said)
    if file.plant.installed:
        named[file.plant.installed] = hashlib.sha256(installed_source(file.plant.installed)[0].encode()).hexdigest()
    return hashlib.sha256(json.dumps([said, named], sort_keys=True).encode()).hexdigest()


def _drawing(file: Process, folder: Path) -> str:
    if file.mimic is None:
        return ""
    names = [*(one.name for one in file.inputs), *(one.name for one in file.outputs)]
    return drawing_of(folder / file.mimic, [*names, "load"] if file.has_load else names)


def _with_sensors(file: Process, y0: Sequence[float]) -> Process:
    """Return a file with the disturbances that are measured as its last outputs, and where outputs (n_y,) rest."""
    sensors = tuple(
        Output(name=one.name, unit=one.unit, range=one.span, noise=one.noise, at=one.at)
        for one in file.disturbances
        if one.noise is not None
    )
    every = zip((*file.outputs, *sensors), y0, strict=True)
    return file.model_copy(update={"outputs": tuple(one.model_copy(update={"at": at}) for one, at in every)})


def _states(file: Process, linear: Linearised) -> tuple[State, ...]:
    given: dict[str, float | None] = {one.name: one.walk for one in file.disturbances}
    given |= {state.name: state.walk for state in file.states}
    unknown = set(given) - set(linear.states)
    if unknown:
        raise UsageError(f"states: {min(unknown)} is no state of the plant: {', '.join(linear.states)}")
    sample_s = file.tick_s * file.ticks_per_sample
    steps = [(one.high - one.low) / 4 for one in file.inputs]
    moves = np.abs(discretise(linear.A, linear.B, linear.F[:, 0], sample_s).B) @ steps
    usual = USUAL_WALK * np.maximum(moves, 1e-6 * max(moves.max(), 1e-12))
    return tuple(
        State(name=name, unit=unit, walk=given.get(name, float(walk)))
        for (name, unit), walk in zip(linear.states.items(), usual, strict=True)
    )


def _constants(file: Process, linear: Linearised) -> tuple[str, ...]:
    """Return the outputs whose bias is observable separately from states, load and each other.

    Hautus' test at the integrator: (A, F; C, G) and a column of ones for each constant have no direction of zeros
    (Pannocchia and Rawlings, AIChE J. 49, 2003). Those with bands come last; of equals first the one that is told apart
    best, as a load that moves one output by much and another by next to nothing hardly differs from an error of the
    first.
    """
    with_load = (linear.F, linear.G) if file.has_load else (linear.F[:, :0], linear.G[:, :0])
    modes = np.vstack([np.hstack([linear.A, with_load[0]]), np.hstack([linear.C, with_load[1]])])
    found: list[int] = []
    sensors = {one.name for one in file.disturbances}  # whose errors their effects would be blamed for
    own = [place for place, one in enumerate(file.outputs) if one.name not in sensors]
    for is_banded in (False, True):
        left = [place for place in own if (file.outputs[place].edges is not None) == is_banded]
        while left and modes.shape[1] < len(modes):
            wider = [np.hstack([modes, np.eye(len(modes))[:, [len(linear.A) + place]]]) for place in left]
            apart = [_told_apart(each) for each in wider]
            best = int(np.argmax(apart))
            if apart[best] <= TOLD_APART:
                break
            modes = wider[best]
            found.append(left.pop(best))
    return tuple(file.outputs[place].name for place in sorted(found))


def _told_apart(columns: Array) -> float:
    """Return the least singular value of columns scaled to size 1."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), TINY)
    return float(np.linalg.svd(scaled, compute_uv=False)[-1])


def _sizes(file: Process, states: int) -> ProblemSizes:
    bands = sum(output.edges is not None for output in file.outputs)
    constants = len(file.outputs)  # as many at most have one, and the load a mismatch
    ahead = len(file.prediction.decision_instants) * sum(one.forecast is not None for one in file.outside)
    return ProblemSizes(
        len(file.prediction.decision_instants), len(file.inputs), len(file.outputs), bands,
        len(file.prediction.constraint_instants), states + constants + ahead,
    )  # fmt: skip


def _check_room(process: Process) -> None:
    """Check that what the link exchanges in each scan and update fits into one request (`UsageError`)."""
    inputs, outputs, states = len(process.inputs), len(process.outputs), len(process.states)
    words = {
        "the latched update": 12 + 2 * (2 * inputs + outputs + states),
        "the rack's measurement": 18 + 2 * (inputs + outputs + states),
    }
    longest = max(words, key=lambda name: words[name])
    if words[longest] > REGISTERS_OF_A_REQUEST:
        raise UsageError(
            f"{inputs} inputs, {outputs} outputs and {states} states are too many: {longest} is {words[longest]} "
            f"registers, and one Modbus request carries {REGISTERS_OF_A_REQUEST}"
        )


def _check_rest(file: Process, linear: Linearised) -> None:
    """Check that steady-state outputs are within the ranges of their sensors (`UsageError`)."""
    for one, value in zip(file.outputs, linear.y0, strict=True):
        if not one.range[0] <= value <= one.range[1]:
            raise UsageError(
                f"outputs: {one.name} rests at {value:.5g}, outside the range of its sensor, {one.range[0]:g} to "
                f"{one.range[1]:g}: every reading would be taken for a failed sensor"
            )


def _check_bath(file: Process, model: LtiModel, bath: Bath) -> None:
    """Check that the laws of a bath have an answer (`UsageError`)."""
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
