"""Loops that show what a part of the real one costs: one without a PLC's limits, one with a plant that is its model."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load
from coldloop.process.lti_model import load as load_model
from coldloop.registers.codec import as_transmitted
from coldloop.registers.control_plc import SequenceRow, control_map
from coldloop.registers.plant import PlantSample
from coldloop_control_plc.output_limits import OutputGuard
from coldloop_optimizer_plc.computing_settings import EstimatorKind
from coldloop_optimizer_plc.estimator import begin_prediction, correct, estimator_of, no_belief, predict
from coldloop_optimizer_plc.qp.prediction import prediction_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.solvers.outside_libraries import DaqpSolver
from coldloop_plant.kinds import NO_MISMATCH, noise_of, own_header, plant_maker
from coldloop_plant.own_plants import LinearPlant
from coldloop_plant.program import PlantProgram
from coldloop_plant.settings import PlantKind
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

Array = NDArray[np.float64]

Solved = Callable[[QuadraticProblem, Array, Array], None]
"""Takes a problem, the guess that a solver would begin with (the shifted optimum of the last one), and its optimum."""


def run_ideal_loop(
    settings: Settings,
    scenario: Scenario,
    recorder: Recorder,
    ticks: int,
    solved: Solved | None = None,
) -> None:
    """Run a scenario from the operating point.

    The inputs go through the control PLC's guard: bounds, rates and the slew limit hold as for everybody.

    Args:
        settings: Of plant, limits, model, estimator and design; solver, budget, rule, `outside` have no effect.
        scenario: Its updating period has no effect.
        recorder: Takes the samples; there are no updates.
        ticks: From one instant to the next, 1 to 20.
        solved: Called with each problem.
    """
    header, model = own_header(settings.model.file), load(settings.model.file)
    program = settings.optimizer_plc.program
    prediction = prediction_of(model, program.estimator.disturbed, program.design)
    problem = PredictiveProblem(prediction, program.design, settings.limits)
    kalman = program.estimator.model_copy(update={"kind": EstimatorKind.KALMAN})
    estimator, belief = estimator_of(prediction, kalman), no_belief(prediction.n_states, len(prediction.y0))
    solver = DaqpSolver(program.daqp)
    plant = plant_maker(header, settings.plant)(scenario.load, scenario.seed)
    applied = as_transmitted(SequenceRow(tuple(model.u0.tolist())), control_map(settings.process)).u
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


class LinearRig(OneProcessRig):
    """Control PLC and optimiser PLC with a linear plant; its loop is not compiled.

    Raises:
        ConfigurationError: The plant is to differ from its model.
    """

    def __init__(self, settings: Settings) -> None:
        if settings.plant.kind is not PlantKind.COLD_BOX or settings.plant.mismatch != NO_MISMATCH:
            raise ConfigurationError("plant: the linear plant is a cold box without mismatch")
        super().__init__(settings, compiled=False)
        self._model = load_model(settings.model.file)

    def _plant(self, load: LoadProfile, seed: int) -> PlantProgram:
        return LinearPlant(self._model, load, noise_of(self._settings.plant.sensors, seed))
