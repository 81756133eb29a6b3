"""Linear model of an FMU at steady state: by its own derivatives, by differences, or from a step test of it."""

import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ModelFileError, UsageError
from coldloop.process.declaration import Process
from coldloop_plant.equilibrium import Linear, central_differences
from coldloop_plant.own.fmu import DOUBLE, Fmu, FmuSimulation, Wiring
from coldloop_plant.own.plants import FMU, file_digest
from coldloop_rig.process_file.linear_model import STEP, Linearised, operating_point
from coldloop_rig.process_file.step_test import Record, identified, model_identified

Array = NDArray[np.float64]

STILL: Final = 1e-6
"""Move of an output within a horizon, over the range of its sensor, that counts as rest."""
HORIZONS_TO_REST: Final = 24
"""Horizons after which a plant counts as one without a steady state, unless the file says otherwise."""
STEP_SIZE: Final = 0.01
"""Steps of the step test to both sides of the operating point, over the range of the input or the span of the load."""
SAMPLES: Final = 400
"""Least number of samples of the step test; ten horizons if that is more."""
MOST_FINDINGS: Final = 5
"""Largest number of violations of the standard in a model description that are reported."""


def with_units(file: Process, folder: Path) -> Process:
    """Return a process file with units from its FMU's description where it gives none.

    Raises:
        ModelFileError: The FMU cannot be read, or a signal is no variable of it.
    """
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
    """Return the model of an FMU.

    Raises:
        ColdloopError: It cannot be run, or does not come to rest.
    """
    fmu = Fmu(folder / name)
    wiring = _wiring(file, fmu)
    simulation, wiring = _at_rest(file, fmu, wiring)
    y, x = simulation.outputs(), simulation.states()
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
        tested = identified(_step_tested(file, simulation, str(fmu.path)))
        wiring = replace(wiring, states=())
        model = model_identified(file, tested, y, file.outside)
    else:
        u, w = operating_point(file)
        J, how = found
        how_made = (f"model      by {how} of the FMU",)
        model = Linearised(*Linear.of(J, len(x), len(u)), x, u, w, y, _named(fmu, wiring), FMU, {}, "", 0.0, how_made)
    rest = (
        f"rest       after {wiring.rest_ticks * file.tick_s:g} s from the FMU's start, which each session begins with"
    )
    parameters = {"file": str(fmu.path.resolve()), "wiring": asdict(wiring)}
    return model._replace(
        kind=FMU, parameters=parameters, digest=file_digest(fmu.path), notes=(rest, *model.notes, *notes)
    )


def _wiring(file: Process, fmu: Fmu) -> Wiring:
    for name in file.plant.start:
        fmu.port(name)
    for one in file.inputs:
        variable = fmu.variables.get(one.variable or one.name)
        if variable is not None and variable.causality != "input" and variable.variability != "tunable":
            raise UsageError(f"inputs: {variable.name} is no input of {fmu.path} but its {variable.causality}")
    load = file.load if file.has_load else None
    return Wiring(
        inputs=[one.variable or one.name for one in file.inputs],
        outputs=[one.variable or one.name for one in file.outputs],
        load=(load.variable or load.name) if load else None,
        disturbances=[one.variable or one.name for one in file.disturbances],
        states=_shown_states(fmu),
        start=dict(file.plant.start),
        steps_per_tick=_steps_per_tick(file, fmu),
    )


def _shown_states(fmu: Fmu) -> list[str]:
    """Return the names of an FMU's states; none where it hides them, or where what it calls so is an input."""
    derivatives = [each.variable for each in fmu.description.derivatives]
    states = [each.derivative for each in derivatives]
    hidden = None in states or any(each.causality == "input" for each in [*derivatives, *states])
    return [] if hidden or any(each.dimensions for each in states) else [each.name for each in states]


def _steps_per_tick(file: Process, fmu: Fmu) -> int:
    slave, experiment = fmu.description.coSimulation, fmu.description.defaultExperiment
    fixed = slave.fixedInternalStepSize
    if not fixed and not slave.canHandleVariableCommunicationStepSize and experiment is not None:
        fixed = experiment.stepSize
    if not fixed:
        return file.plant.steps_per_tick or 1
    whole = file.tick_s / float(fixed)
    steps = file.plant.steps_per_tick or max(1, round(whole))
    if round(whole / steps) < 1 or abs(whole / steps - round(whole / steps)) > STILL:
        raise UsageError(
            f"{fmu.path}: does steps of {float(fixed):g} s only; choose tick_s and plant.steps_per_tick for whole ones"
        )
    return steps


def _sample(file: Process, simulation: FmuSimulation) -> Array:
    for _ in range(file.ticks_per_sample):
        simulation.tick()
    return simulation.outputs()


def _at_rest(file: Process, fmu: Fmu, wiring: Wiring) -> tuple[FmuSimulation, Wiring]:
    """Return the FMU at rest with the inputs of the operating point, and how it gets there.

    Raises:
        UsageError: It does not.
    """
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

    Raises:
        ModelFileError: It says that it has, and fails.
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
        return np.append(begun.read(rates), begun.outputs())

    at = np.array([*simulation.states(), *u, *w])
    spans = np.array([one.range[1] - one.range[0] for one in file.outputs])
    if not (np.abs(evaluated(at)[-len(outputs) :] - simulation.outputs()) <= 1e-3 * spans).all():
        return None  # its start values are not its states
    return central_differences(evaluated, at, STEP * np.maximum(1.0, np.abs(at)))[0], "differences of start values"


def _named(fmu: Fmu, wiring: Wiring) -> dict[str, str]:
    """Return names and units of the states, as names of signals are."""
    names = [re.sub(r"[^A-Za-z0-9]", "_", name).strip("_") for name in wiring.states]
    told_apart = len({name.lower() for name in names}) == len(names) and all(name[:1].isalpha() for name in names)
    unique = names if told_apart else [f"x{i}" for i in range(1, len(names) + 1)]
    return {name: fmu.variables[state].unit or "" for name, state in zip(unique, wiring.states, strict=True)}


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
    outputs, after = np.empty((count, len(file.outputs))), simulation.outputs()
    for k, row in enumerate(steps):
        outputs[k] = after
        u, w = row[: len(file.inputs)], row[len(file.inputs) :]
        simulation.put(u, w if file.has_load else np.append(0.0, w))
        after = _sample(file, simulation)
    names = tuple(name for name, _, _ in signals)
    operating = np.array([value for _, value, _ in signals])
    return Record(file.tick_s * file.ticks_per_sample, steps, outputs, operating, names, f"the step test of {where}")
