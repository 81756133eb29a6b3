"""A process file made into a model file: the linear model of its plant, and the process that it completes."""

import hashlib
import json
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from coldloop.errors import ModelFileError, UsageError
from coldloop.process import lti_model, sections
from coldloop.process.declaration import Process
from coldloop.text import file_digest
from coldloop_plant import equilibrium, own_plants
from coldloop_plant.fmu import DOUBLE, Fmu, FmuSimulation, Wiring
from coldloop_rig.plc_sizing.operations import ProblemSizes, iteration_shares
from coldloop_rig.process_file import linear_model, reading, step_test
from coldloop_rig.process_file.linear_model import STEP, Array, Linearised, Record, operating_point

REGISTERS_OF_A_REQUEST: Final = 125
"""Registers of one Modbus read at most: the latched update, and the rack's measurement, are one read each."""
TINY: Final = 1e-12
TOLD_APART: Final = 1e-6
"""Least singular value, of columns of size 1, with which biases are observable separately from states."""
USUAL_WALK: Final = 0.01
"""Process noise of a state over what it moves by when each input makes its largest step, held for the horizon."""
SINGULAR: Final = 1e-9
"""Least singular value over the largest, of equations with rows and columns of size 1, that still have a solution."""
SEEN: Final = 0.1  # gain over the largest of an output, from which on a record must show it
ALIKE: Final = (0.5, 2.0)  # gains of a record's model over those of the plant


@dataclass(frozen=True)
class Made:
    """Model and process that are made from a process file."""

    model: lti_model.LtiModel
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
    """Return the model of a process file. Raises ColdloopError: one line that names file, key and remedy."""
    said = reading.read_process_file(path)
    file = with_units(said, path.parent)
    linear = linearised(file, path.parent)
    sensors = (  # disturbances that are measured are the last outputs
        sections.Output(name=one.name, unit=one.unit, range=one.span, noise=one.noise)
        for one in file.disturbances
        if one.noise is not None
    )
    every = zip((*file.outputs, *sensors), linear.y0.tolist(), strict=True)
    file = file.model_copy(update={"outputs": tuple(one.model_copy(update={"at": at}) for one, at in every)})
    shown = [*file.input_names, *file.output_names, *(["load"] if file.has_load else [])]
    knots, outputs = len(file.prediction.decision_instants), len(file.outputs)
    bands = sum(one.edges is not None for one in file.outputs)
    ahead = knots * sum(one.forecast is not None for one in file.outside)
    states = len(linear.states) + outputs + ahead  # as many outputs at most have a constant, and the load a mismatch
    instants = len(file.prediction.constraint_instants)
    process = file.model_copy(update={
        "states": _states(file, linear), "constants": file.constants or _constants(file, linear),
        "iterations": iteration_shares(ProblemSizes(knots, len(file.inputs), outputs, bands, instants, states)),
        "forecasts": reading.forecasts_of(file, path.parent),
        "drawing": reading.drawing_of(path.parent / file.mimic, shown) if file.mimic else "",
    })  # fmt: skip
    _check_fits(process, linear)
    matrices = equilibrium.Linear(linear.A, linear.B, linear.F[:, 0], linear.C, linear.D, linear.G[:, 0])
    model = equilibrium.model_of(
        matrices, linear.x0, linear.u0, float(linear.w0[0]), linear.y0, process, linear.states, linear.digest,
        plant=linear.kind, note=f"made from {path.name}", process=process.model_dump(mode="json"),
        plant_parameters=linear.parameters | reading.courses_of(file, path.parent),
        declaration_digest=declaration_digest(said, path.parent),
    )  # fmt: skip
    if process.bath is not None:
        _check_bath(file, model, process.bath)
    return Made(model, process, linear, len(file.disturbances))


def linearised(file: Process, folder: Path) -> Linearised:
    """Return the model of the plant. Raises ColdloopError: it cannot be read, does not rest, or does not fit."""
    plant = file.plant
    if plant.python is not None:
        found = linear_model.from_equations(file, plant.python, *reading.source_of(folder, plant.python))
    elif plant.installed is not None:
        found = linear_model.from_equations(file, plant.installed, *reading.installed_source(plant.installed))
    elif plant.matrices is not None:
        found = linear_model.from_matrices(file, folder, plant.matrices)
    elif plant.step_test is not None:
        found = step_test.from_step_test(file, folder / plant.step_test)
    elif plant.fmu is not None:
        found = from_fmu(file, folder, plant.fmu)
    else:
        found = linear_model.from_lags(file, plant)
    if not len(found.A):
        raise UsageError(
            "plant: it has no states, so there is nothing to predict; give the dynamics of its actuators at least"
        )
    if file.prediction.step_test is not None:
        found = _by_record(file, found, folder / file.prediction.step_test)
    for name in ("A", "B", "F", "C", "D", "G", "x0", "y0"):
        if not np.isfinite(getattr(found, name)).all():
            raise UsageError(f"plant: {name} of the linear model is not finite; look at the plant's equations there")
    return linear_model.with_disturbances(file, found)


def _by_record(file: Process, plant: Linearised, path: Path) -> Linearised:
    """Return the model of a record, for a plant that hides its states; warn where gains after the horizon differ."""
    model = step_test.from_step_test(file, path)
    hidden = dict(plant.parameters)
    if plant.kind == own_plants.PYTHON:
        hidden["rest"] = plant.x0.tolist()
    elif plant.kind == own_plants.FMU:
        hidden["wiring"] = {**hidden["wiring"], "states": ()}
    true, found = (
        one.C @ lti_model.discretise(one.A, one.B, one.F[:, 0], file.horizon_s).B + one.D for one in (plant, model)
    )
    seen = np.abs(true) > SEEN * np.abs(true).max(axis=1, keepdims=True)
    warnings = [
        f"warning    gain: of {file.outputs[i].name} by {file.inputs[j].name} {found[i, j]:.3g}, of the plant itself "
        f"{true[i, j]:.3g}; is the record of this plant, in the units of this file?"
        for i, j in np.argwhere(seen)
        if not ALIKE[0] <= found[i, j] / true[i, j] <= ALIKE[1]
    ]
    notes = (*plant.notes, *model.notes, *warnings, *step_test.record_compared(file, path, plant, model))
    return model._replace(kind=plant.kind, parameters=hidden, digest=plant.digest, notes=notes)


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
        source, _ = reading.installed_source(file.plant.installed)
        named[file.plant.installed] = hashlib.sha256(source.encode()).hexdigest()
    return hashlib.sha256(json.dumps([said, named], sort_keys=True).encode()).hexdigest()


def _states(file: Process, linear: Linearised) -> tuple[sections.State, ...]:
    given: dict[str, float | None] = {one.name: one.walk for one in file.disturbances}
    given |= {state.name: state.walk for state in file.states}
    unknown = set(given) - set(linear.states)
    if unknown:
        raise UsageError(f"states: {min(unknown)} is no state of the plant: {', '.join(linear.states)}")
    sample_s = file.tick_s * file.ticks_per_sample
    steps = [(one.high - one.low) / 4 for one in file.inputs]
    moves = np.abs(lti_model.discretise(linear.A, linear.B, linear.F[:, 0], sample_s).B) @ steps
    usual = USUAL_WALK * np.maximum(moves, 1e-6 * max(moves.max(), 1e-12))
    return tuple(
        sections.State(name=name, unit=unit, walk=given.get(name, float(walk)))
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
            sized = (each / np.maximum(np.linalg.norm(each, axis=0), TINY) for each in wider)
            apart = [float(np.linalg.svd(each, compute_uv=False)[-1]) for each in sized]
            best = int(np.argmax(apart))
            if apart[best] <= TOLD_APART:
                break
            modes = wider[best]
            found.append(left.pop(best))
    return tuple(file.outputs[place].name for place in sorted(found))


def _check_fits(process: Process, linear: Linearised) -> None:
    """Check that scan and update fit a request each, and sensors show the plant at rest; else raise UsageError."""
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
    for one, value in zip(process.outputs, linear.y0, strict=True):
        if not one.range[0] <= value <= one.range[1]:
            raise UsageError(
                f"outputs: {one.name} rests at {value:.5g}, outside the range of its sensor, {one.range[0]:g} to "
                f"{one.range[1]:g}: every reading would be taken for a failed sensor"
            )


def _check_bath(file: Process, model: lti_model.LtiModel, bath: sections.Bath) -> None:
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
    moved, row = model.moved, model.output_names.index(bath.level)
    equations = np.block([
        [model.A[np.ix_(moved, moved)], model.F[moved, None]], [model.C[[row]][:, moved], model.G[[[row]]]],
    ])  # fmt: skip
    for axis in (1, 0, 1, 0):
        size = np.abs(equations).max(axis=axis, keepdims=True)
        equations = equations / np.where(size > 0.0, size, 1.0)  # a row or a column of zeros stays one
    sizes = np.linalg.svd(equations, compute_uv=False)
    if not sizes[-1] > SINGULAR * sizes[0]:
        raise UsageError(
            f"bath: with constant inputs no load lets the states and {bath.level} rest: either the load does not move "
            "it, or something else does that never rests"
        )


STILL: Final = 1e-6
"""Move of an output within a horizon, over the range of its sensor, that counts as rest."""
HORIZONS_TO_REST: Final = 24
"""Horizons after which a plant counts as one without a steady state, unless the file says otherwise."""
STEP_SIZE: Final = 0.01
"""Steps of the step test to both sides of the operating point, over the range of the input or the span of the load."""
SAMPLES: Final = 400  # least number of samples of the step test; ten horizons if that is more
MOST_FINDINGS: Final = 5  # largest number of violations of the standard in a model description that are reported


def with_units(file: Process, folder: Path) -> Process:
    """Return a process file with units of its FMU where it gives none. Raises ModelFileError: it lacks a variable."""
    if file.plant.fmu is None:
        return file
    fmu = Fmu(folder / file.plant.fmu)

    def unit(section: Any) -> Any:  # noqa: ANN401 any kind of signal
        variable = section.variable or section.name
        fmu.port(variable)
        declared = fmu.variables.get(variable) or fmu.variables[variable.rpartition("[")[0]]  # an array has one unit
        return section if section.unit else section.model_copy(update={"unit": declared.unit or ""})

    named = {name: tuple(map(unit, getattr(file, name))) for name in ("inputs", "outputs", "disturbances")}
    return file.model_copy(update={**named, "load": unit(file.load) if file.has_load else file.load})


def from_fmu(file: Process, folder: Path, name: str) -> Linearised:
    """Return the linear model of an FMU at steady state: by its derivatives, by differences, or from a step test of it.

    Raises ColdloopError: it cannot be run, or does not come to rest.
    """
    fmu = Fmu(folder / name)
    simulation, wiring = _at_rest(file, fmu, _wiring(file, fmu))
    y, x = simulation.read(simulation.outputs), simulation.read(simulation.states)
    notes = [f"warning    FMU: {finding}" for finding in fmu.findings[:MOST_FINDINGS]]
    notes += [
        f"warning    FMU: {one} is of type {fmu.port(one).type}: what it is given is rounded"
        for one in filter(None, [*wiring.inputs, wiring.load, *wiring.disturbances])
        if fmu.port(one).is_discrete
    ]
    try:
        found = _differentiated(file, fmu, wiring, simulation)
    except ModelFileError as error:  # and the instance may be of no more use
        notes.append(f"warning    FMU: {error}; a step test of it makes the model instead")
        found, (simulation, wiring) = None, _at_rest(file, fmu, wiring)
    if found is None:
        tested = step_test.identified(_step_tested(file, simulation, str(fmu.path)))
        wiring = replace(wiring, states=())
        model = step_test.model_identified(file, tested, y, file.outside)
    else:
        u, w = operating_point(file)
        J, how = found
        names = [re.sub(r"[^A-Za-z0-9]", "_", name).strip("_") for name in wiring.states]  # as names of signals are
        if len({name.lower() for name in names}) < len(names) or not all(name[:1].isalpha() for name in names):
            names = [f"x{i}" for i in range(1, len(names) + 1)]
        units = (fmu.variables[state].unit or "" for state in wiring.states)
        states, how_made = dict(zip(names, units, strict=True)), (f"model      by {how} of the FMU",)
        model = Linearised(
            *equilibrium.Linear.of(J, len(x), len(u)), x, u, w, y, states, own_plants.FMU, {}, "", 0.0, how_made
        )
    rest_s = wiring.rest_ticks * file.tick_s
    rest = f"rest       after {rest_s:g} s from the FMU's start, which each session begins with"
    parameters, notes = {"file": str(fmu.path.resolve()), "wiring": asdict(wiring)}, [rest, *model.notes, *notes]
    return model._replace(kind=own_plants.FMU, parameters=parameters, digest=file_digest(fmu.path), notes=tuple(notes))


def _wiring(file: Process, fmu: Fmu) -> Wiring:
    for name in file.plant.start:
        fmu.port(name)
    for one in file.inputs:
        variable = fmu.variables.get(one.variable or one.name)
        if variable is not None and variable.causality != "input" and variable.variability != "tunable":
            raise UsageError(f"inputs: {variable.name} is no input of {fmu.path} but its {variable.causality}")
    load = file.load if file.has_load else None
    derivatives = [each.variable for each in fmu.description.derivatives]
    states = [each.derivative for each in derivatives]  # which it may hide, and what it calls so may be an input
    hidden = None in states or any(each.causality == "input" for each in [*derivatives, *states])
    return Wiring(
        inputs=[one.variable or one.name for one in file.inputs],
        outputs=[one.variable or one.name for one in file.outputs],
        load=(load.variable or load.name) if load else None,
        disturbances=[one.variable or one.name for one in file.disturbances],
        states=[] if hidden or any(each.dimensions for each in states) else [each.name for each in states],
        start=dict(file.plant.start),
        steps_per_tick=_steps_per_tick(file, fmu),
    )


def _steps_per_tick(file: Process, fmu: Fmu) -> int:
    slave, experiment = fmu.description.coSimulation, fmu.description.defaultExperiment
    fixed = slave.fixedInternalStepSize
    if not fixed and not slave.canHandleVariableCommunicationStepSize and experiment is not None:
        fixed = experiment.stepSize
    whole = file.tick_s / float(fixed) if fixed else 1.0
    steps = file.plant.steps_per_tick or max(1, round(whole))
    if fixed and (round(whole / steps) < 1 or abs(whole / steps - round(whole / steps)) > STILL):
        raise UsageError(
            f"{fmu.path}: does steps of {float(fixed):g} s only; choose tick_s and plant.steps_per_tick for whole ones"
        )
    return steps


def _sample(file: Process, simulation: FmuSimulation) -> Array:
    for _ in range(file.ticks_per_sample):
        simulation.tick()
    return simulation.read(simulation.outputs)


def _at_rest(file: Process, fmu: Fmu, wiring: Wiring) -> tuple[FmuSimulation, Wiring]:
    """Return the FMU at rest at the operating point, and how it gets there. Raises UsageError: it does not."""
    u, w = operating_point(file)
    simulation = FmuSimulation(fmu, wiring, file.tick_s)
    simulation.put(u, w)
    spans = np.array([one.range[1] - one.range[0] for one in file.outputs])
    windows = max(1, round(file.plant.rest_s / file.horizon_s)) if file.plant.rest_s else HORIZONS_TO_REST
    moved, horizon = spans, file.prediction.decision_instants[-1]
    for k in range(1, windows + 1):
        y = np.array([_sample(file, simulation) for _ in range(horizon)])
        if not np.isfinite(y).all():
            wrong = file.outputs[int(np.flatnonzero(~np.isfinite(y).all(axis=0))[0])].name
            raise UsageError(f"{fmu.path}: {wrong} is not finite with the inputs at their operating point")
        moved = np.ptp(y, axis=0)
        if (moved <= STILL * spans).all():
            return simulation, replace(wiring, rest_ticks=k * horizon * file.ticks_per_sample)
    worst = int(np.argmax(moved / spans))
    raise UsageError(
        f"{fmu.path}: does not come to rest with the inputs at their operating point: {file.outputs[worst].name} still"
        f" moves by {moved[worst]:.3g} in {file.horizon_s:g} s after {windows * file.horizon_s:g} s; give other values"
        " of at, plant.start nearer to rest, or a longer plant.rest_s"
    )


def _differentiated(file: Process, fmu: Fmu, wiring: Wiring, simulation: FmuSimulation) -> tuple[Array, str] | None:
    """Return derivatives of the states' rates and the outputs by states, inputs and load, and how; None without states.

    Raises ModelFileError: it says that it has, and fails.
    """
    names = [*wiring.states, *wiring.inputs, wiring.load, *wiring.disturbances]
    outputs = [fmu.port(name) for name in wiring.outputs]
    ports = [*outputs, *(fmu.port(name) for name in names if name is not None)]
    if not wiring.states or not all(port.type in DOUBLE and port.size == 1 for port in ports):
        return None
    rates = [fmu.port(each.variable.name) for each in fmu.description.derivatives]
    if fmu.has_derivatives:
        return simulation.derivatives([*rates, *outputs]), "directional derivatives"
    if fmu.is_single or any(fmu.variables[name].initial != "exact" for name in wiring.states):
        return None
    u, w = operating_point(file)

    def evaluated(v: Array) -> Array:
        values = {name: value for name, value in zip(names, v.tolist(), strict=True) if name is not None}
        start = {**wiring.start, **values}
        begun = FmuSimulation(fmu, replace(wiring, start=start), file.tick_s)
        return np.append(begun.read(rates), begun.read(begun.outputs))

    at = np.array([*simulation.read(simulation.states), *u, *w])
    spans = np.array([one.range[1] - one.range[0] for one in file.outputs])
    if not (np.abs(evaluated(at)[-len(outputs) :] - simulation.read(simulation.outputs)) <= 1e-3 * spans).all():
        return None  # its start values are not its states
    return equilibrium.central_differences(evaluated, at, STEP * np.maximum(1.0, np.abs(at)))[
        0
    ], "differences of start values"


def _step_tested(file: Process, simulation: FmuSimulation, where: str) -> Record:
    """Return what outputs do when inputs and load step at random about the operating point, for all lengths of time."""
    generator = np.random.default_rng(0)
    horizon = file.prediction.decision_instants[-1]
    count = max(SAMPLES, 10 * horizon)
    signals = [(one.name, one.at, (one.low, one.high)) for one in file.inputs]
    signals += [(one.name, one.at, one.span) for one in file.outside]
    steps = np.empty((count, len(signals)))
    for j, (_, at, (low, high)) in enumerate(signals):
        size = max(STEP_SIZE * (high - low), float(simulation.inputs[j].is_discrete))
        levels, k = (max(low, at - size), min(high, at + size)), 0
        while k < count:
            hold = int(np.exp(generator.uniform(0.0, np.log(max(2.0, horizon / 2)))))
            steps[k : k + hold, j] = levels[generator.integers(2)]
            k += hold
    outputs, after = np.empty((count, len(file.outputs))), simulation.read(simulation.outputs)
    for k, row in enumerate(steps):
        outputs[k] = after
        u, w = row[: len(file.inputs)], row[len(file.inputs) :]
        simulation.put(u, w if file.has_load else np.append(0.0, w))
        after = _sample(file, simulation)
    names = tuple(name for name, _, _ in signals)
    operating = np.array([value for _, value, _ in signals])
    return Record(file.tick_s * file.ticks_per_sample, steps, outputs, operating, names, f"the step test of {where}")
