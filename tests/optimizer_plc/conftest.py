"""The controller's problem, random situations to solve, exact optima, and jumps recorded from the closed loop."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import coldloop_optimizer_plc.program
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits
from coldloop.registers.control_plc import Verdict
from coldloop.registers.plant import Measurement
from coldloop.safety.writers import InputSequence
from coldloop_control_plc.program import make_program
from coldloop_control_plc.settings import ControlSection
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.settings import ControlDesign, Preset, ProgramSettings
from coldloop_optimizer_plc.solvers import Answer, Solver, make_solver
from coldloop_plant.cold_box import ColdBoxProgram
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.load import find_load
from tests.harness.records import as_transmitted
from tests.harness.reference_qp import solved_by_daqp

Array = NDArray[np.float64]
Situations = Callable[[np.random.Generator], QpParameters]
Optimum = Callable[[QuadraticProblem], Array]
PenalisedOptimum = Callable[[QuadraticProblem, float], Array]


class Jump(NamedTuple):
    """What the solver was given in the updating period that began just after a load jump."""

    problem: QuadraticProblem
    guess: Array


@pytest.fixture(scope="session")
def model() -> LtiModel:
    return load(DEFAULT_MODEL_FILE)


@pytest.fixture(scope="session")
def prediction(model: LtiModel) -> PredictionModel:
    return PredictionModel(model)


@pytest.fixture(scope="session")
def problem(prediction: PredictionModel) -> PredictiveProblem:
    return PredictiveProblem(prediction, ControlDesign(), InputLimits())


@pytest.fixture(scope="session")
def situations(model: LtiModel) -> Situations:
    """Draw situations: states some kPa, % and K away, loads and inputs anywhere in reach."""
    scale = np.full(len(model.x0), 1.0)
    scale[0], scale[1] = 2000.0, 1.0 / model.C[0, 1]

    def draw(rng: np.random.Generator) -> QpParameters:
        x = scale * rng.normal(size=len(scale)) * rng.choice([0.2, 0.5, 1.0])
        return QpParameters(x, float(rng.uniform(-150, 200)), rng.uniform([-8, -60, -8], [8, 60, 8]))

    return draw


@pytest.fixture(scope="session")
def optimum() -> Optimum:
    """Solve an instance under its hard constraints."""

    def solve(qp: QuadraticProblem) -> Array:
        low = np.concatenate([qp.low, np.full(len(qp.gamma), -np.inf)])
        return solved_by_daqp(2.0 * qp.Phi, qp.phi, qp.Gamma, low, np.concatenate([qp.high, qp.gamma]))

    return solve


@pytest.fixture(scope="session")
def penalised_optimum() -> PenalisedOptimum:
    """Minimise the augmented cost over the box; each penalty is a variable s >= 0 with Gamma z - s <= gamma."""

    def solve(qp: QuadraticProblem, alpha: float) -> Array:
        n, m = len(qp.phi), len(qp.gamma)
        H = np.zeros((n + m, n + m))
        H[:n, :n], H[n:, n:] = 2.0 * qp.Phi, 2.0 * alpha * np.eye(m)
        low = np.concatenate([qp.low, np.zeros(m), np.full(m, -np.inf)])
        high = np.concatenate([qp.high, np.full(m, np.inf), qp.gamma])
        rows = np.hstack([qp.Gamma, -np.eye(m)])
        z = solved_by_daqp(H, np.concatenate([qp.phi, np.zeros(m)]), rows, low, high)[:n]
        return np.clip(z, qp.low, qp.high)

    return solve


class Recorder:
    """A solver that remembers what it was started with."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.alpha, self.tau_1_s = solver.alpha, solver.tau_1_s
        self.started: Jump | None = None

    def reset(self) -> None:
        self._solver.reset()

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        self.started = Jump(deepcopy(problem), guess.copy())
        return self._solver.solve(problem, guess, counts)


def recorded_jumps(model: LtiModel, hour: str, minutes: float) -> list[Jump]:
    """Run the closed loop at an updating period of 5 s; return what followed each load jump of more than 40 W."""
    recorder = Recorder(make_solver(ProgramSettings(preset=Preset.PAPER)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coldloop_optimizer_plc.program, "make_solver", lambda _settings: recorder)
        settings = ProgramSettings(preset=Preset.PAPER, updating_period_s=5.0)
        optimizer = OptimizerProgram(model, settings, InputLimits())
    control = make_program(read_header(DEFAULT_MODEL_FILE), ControlSection(), InputLimits())
    control.restart(session=1)
    plant = ColdBoxProgram(
        box=REFERENCE, x0=model.x0.tolist(), u0=model.u0.tolist(), load=find_load(hour, model.w0, COLD_BOX), noise=None
    )
    jumps: list[Jump] = []
    jumped, load_before = False, model.w0
    for _ in range(round(minutes * 240)):
        if control.awaiting_sequence:
            header, rows = optimizer.solve()
            if jumped and recorder.started:
                jumps.append(recorder.started)
            answer = control.offer(InputSequence(header, [as_transmitted(row) for row in rows]))
            assert answer.verdict == Verdict.ACCEPTED
        plant.apply(as_transmitted(control.begin_scan()).u)
        measurement = as_transmitted(Measurement(plant.tick, plant.load, plant.measure(), plant.state, 1, (0.0,) * 3))
        plant.advance()
        update = control.end_scan(measurement)
        if update is not None:
            assert control.accept_plan(optimizer.plan(as_transmitted(update)))
            jumped, load_before = abs(update.load - load_before) > 40, update.load
    return jumps


@pytest.fixture(scope="session")
def harsh_jumps(model: LtiModel) -> list[Jump]:
    """Every jump of more than 40 W of the two densest hours."""
    return recorded_jumps(model, "e", 60) + recorded_jumps(model, "f", 60)
