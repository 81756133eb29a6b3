"""Loops in one process: the three programs, by direct calls, and one without a PLC's limits.

What would cross the bus is rounded as the bus would round it.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from coldloop.errors import LoadFileError
from coldloop.kernels.cache import kernels_of
from coldloop.process import declaration, load_profile, lti_model
from coldloop.registers import Maps, codec, control_plc, maps_of
from coldloop.registers.plant import LoadStep, Measurement, PlantSample, plant_map
from coldloop_control_plc.output_limits import OutputGuard
from coldloop_control_plc.program import ControlProgram
from coldloop_control_plc.program import make_program as make_control_program
from coldloop_optimizer_plc.computing_settings import EstimatorKind
from coldloop_optimizer_plc.estimator import begin_prediction, correct, estimator_of, no_belief, predict
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_optimizer_plc.qp.prediction import prediction_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.solvers.outside_libraries import DaqpSolver
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.program import PlantProgram
from coldloop_plant.settings import PlantKind
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from coldloop_rig.cosim.compiled.stretches import CompiledStretches

SHORT: Final = 10_000
"""Ticks below which the programs are done before a loop would be compiled."""


class Programs(NamedTuple):
    """The programs of a session, connected by calls."""

    plant: PlantProgram
    control: ControlProgram
    optimizer: OptimizerProgram
    maps: Maps

    def tick(self, recorder: Recorder) -> None:
        """Do one tick, recorded as it would cross the bus."""
        plant, control, optimizer, to_plant = self.plant, self.control, self.optimizer, self.maps.plant
        if control.awaiting_sequence:
            answer = control.offer(optimizer.solve())
            optimizer.answered(late=False)
            recorder.update(
                codec.as_transmitted(optimizer.report(control_plc.Verdict(answer.verdict)), self.maps.optimizer_plc)
            )
        if not control.player.invited:
            control.optimizer_seen()  # an optimiser that idles goes on to send heartbeats
        actuators = codec.as_transmitted(control.begin_scan(), to_plant)
        u = actuators.u
        plant.apply(u)
        measured = Measurement(plant.tick, plant.load, plant.measure(), plant.state, actuators.session, u)
        measurement = codec.as_transmitted(measured, to_plant)
        if plant.station is not None:
            recorder.station(codec.as_transmitted(plant.station, to_plant))
        recorder.sample(PlantSample(plant.tick, measurement.load, u, measurement.y, measurement.x))
        plant.advance()
        self.plan(control.end_scan(measurement))

    def plan(self, update: control_plc.Update | None) -> None:
        """Let the optimiser plan an update, if one was latched."""
        if update is not None:
            to_control = self.maps.control_plc
            plan = self.optimizer.plan(codec.as_transmitted(update, to_control))
            self.control.accept_plan(codec.as_transmitted(plan, to_control))


def load_table(load: load_profile.LoadProfile, process: declaration.Process) -> load_profile.LoadProfile:
    """Return a load of a process as the plant's table has it after crossing the bus.

    Raises:
        LoadFileError: The table does not take it.
    """
    registers = plant_map(process)
    steps = [codec.as_transmitted(LoadStep(*step), registers) for step in zip(load.times, load.watts, strict=True)]
    low, high = process.load.stored_span
    if not all(low <= step.watts <= high for step in steps):
        raise LoadFileError(f"a load is outside {low:g} to {high:g} {process.load.unit}")
    return load_profile.LoadProfile(tuple(step.tick for step in steps), tuple(step.watts for step in steps))


class OneProcessRig:
    """Plant, control PLC and optimiser PLC, connected by calls.

    Args:
        settings: Configuration.
        compiled: Whether ordinary ticks are done in compiled loops, with the same bits; by default where these have
            been compiled already, and where the run is not `SHORT`.
    """

    def __init__(self, settings: Settings, *, compiled: bool | None = None) -> None:
        self._settings, self._compiled = settings, compiled
        self._header = own_header(settings.model.file)
        program = settings.optimizer_plc.program
        with self._kernels():
            self.optimizer = OptimizerProgram(lti_model.load(settings.model.file), program, settings.limits)
        self.control = make_control_program(self._header, settings.control_plc, settings.limits)

    def run(self, scenario: Scenario, recorder: Recorder) -> None:
        """Run a scenario from the operating point, in lock-step."""
        with self._kernels():
            load = load_table(scenario.load, self._settings.process)
            plant = self._plant(load, scenario.seed)
            programs = Programs(plant, self.control, self.optimizer, maps_of(self._settings.process))
            self.optimizer.restart(scenario.updating_period_s)
            noted = self.control.journal.count
            self.control.restart(session=1)
            stretches = self._stretches(plant, load, scenario.ticks)
            recorder.begin()
            while self.control.tick < scenario.ticks:
                stretch = stretches.ahead(scenario.ticks) if stretches else None
                if stretch is None:
                    programs.tick(recorder)
                else:
                    recorder.stretch(stretch.block, stretch.updates)
                    programs.plan(stretch.latched)
                for event in self.control.journal.since(noted):
                    recorder.event(event)
                    noted = event.number

    def _kernels(self) -> AbstractContextManager[None]:
        """Announce what is compiled as the kernels of a run like this one."""
        kind, solver = self._settings.plant.kind, self._settings.optimizer_plc.program.solver_name
        plant = kind if kind is PlantKind.REFRIGERATOR else self._settings.process.name
        return kernels_of(f"the {plant.replace('-', ' ')} and the {solver} solver in one process", about_s=50)

    def _plant(self, load: load_profile.LoadProfile, seed: int) -> PlantProgram:
        return plant_maker(self._header, self._settings.plant)(load, seed)

    def _stretches(self, plant: PlantProgram, load: load_profile.LoadProfile, ticks: int) -> "CompiledStretches | None":
        """Return what runs ahead in compiled loops, where there are any."""
        if self._compiled is False:
            return None
        from coldloop_rig.cosim.compiled.plants import compiled_plant  # noqa: PLC0415 only where something is compiled
        from coldloop_rig.cosim.compiled.stretches import CompiledStretches  # noqa: PLC0415

        compiled = compiled_plant(plant)
        if compiled is None:
            return None
        may_compile = self._compiled is True or ticks >= SHORT
        return CompiledStretches(plant, compiled, self.control, self.optimizer, load, may_compile=may_compile)


Solved = Callable[[QuadraticProblem, Array, Array], None]
"""Takes a problem, the guess that a solver would begin with (the shifted optimum of the last one), and its optimum."""


def run_ideal_loop(
    settings: Settings, scenario: Scenario, recorder: Recorder, ticks: int, solved: Solved | None = None
) -> None:  # fmt: skip
    """Run a scenario from the operating point in the loop of a PLC without limits: all problems are solved at once.

    The inputs go through the control PLC's guard: bounds, rates and the slew limit hold as for everybody.

    Args:
        settings: Of plant, limits, model, estimator and design; solver, budget, rule, `outside` have no effect.
        scenario: Its updating period has no effect.
        recorder: Takes the samples; there are no updates.
        ticks: From one instant to the next, 1 to 20.
        solved: Called with each problem.
    """
    header, model = own_header(settings.model.file), lti_model.load(settings.model.file)
    program = settings.optimizer_plc.program
    prediction = prediction_of(model, program.estimator.disturbed, program.design)
    problem = PredictiveProblem(prediction, program.design, settings.limits)
    kalman = program.estimator.model_copy(update={"kind": EstimatorKind.KALMAN})
    estimator, belief = estimator_of(prediction, kalman), no_belief(prediction.n_states, len(prediction.y0))
    solver = DaqpSolver(program.daqp)
    plant = plant_maker(header, settings.plant)(scenario.load, scenario.seed)
    applied = codec.as_transmitted(
        control_plc.SequenceRow(tuple(model.u0.tolist())), control_plc.control_map(settings.process)
    ).u
    guard = OutputGuard(settings.limits, applied)
    z = problem.hold(np.zeros(len(applied)))
    recorder.begin()
    for tick in range(scenario.ticks):
        y, x, watts = plant.measure(), plant.state, plant.load
        wanted = applied
        instant = tick % ticks == 0
        if instant:
            correct(estimator, belief, np.array(applied), watts, np.array(y), np.array(x))
            u = np.array(applied) - model.u0
            parameters = QpParameters(belief.x.copy(), float(belief.numbers[0]["w"]), u, ticks)
            qp, guess = problem.at(parameters), problem.shifted(z, ticks)
            z = solver.solve(qp, guess, (1,)).z
            if solved is not None:
                solved(qp, guess, z)
            wanted = tuple(problem.inputs(z, 1)[0].tolist())
        applied = guard.admit(tick, wanted, update=instant)
        if instant:
            begin_prediction(belief)
            predict(estimator, belief, np.array(applied) - model.u0, ticks)
        plant.apply(applied)
        recorder.sample(PlantSample(tick, watts, applied, y, x))
        plant.advance()
