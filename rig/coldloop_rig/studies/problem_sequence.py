"""One sequence of problems for all solvers: those of a converged closed loop, with the lowest cost of each."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.limits import InputLimits
from coldloop.process.lti_model import load as load_model
from coldloop.safety.sequence import InputSequence
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.prediction import PredictionModel, prediction_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.rules import UpdatingRule
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.studies.played_profiles import PlayedProfiles
from coldloop_rig.studies.settings import settings_of

Array = NDArray[np.float64]

OF_THE_SOLVER: Final = (
    "optimizer_plc.program.solver=", "optimizer_plc.program.budget.", "optimizer_plc.program.preset=",
    "optimizer_plc.program.penalties.", *(f"optimizer_plc.program.{name.replace('-', '_')}." for name in SolverName),
)  # fmt: skip
"""Settings that differ between the requests that one sequence serves. The loop that it is recorded in solves exactly,
so that no penalty has an effect there."""
CONVERGED: Final = ("optimizer_plc.program.solver=daqp", "optimizer_plc.program.budget.preparation_slots=0")


class LoopProblem(NamedTuple):
    """A problem of the converged loop."""

    parameters: QpParameters
    z: Array
    """The profile that the loop delivered: the optimum of the quadratic problem."""


class ProblemSequence(NamedTuple):
    """Problems in their order."""

    prediction: PredictionModel
    limits: InputLimits
    problem: PredictiveProblem
    """With the default penalties: what profiles are judged by."""
    profiles: PlayedProfiles
    recorded: Sequence[LoopProblem]
    lowest: Array
    """The lowest cost of a profile that can be played, for each problem."""

    def solved_with(self, program: ProgramSettings) -> PredictiveProblem:
        """Return the same problems with the penalties of a program, for its solver."""
        return PredictiveProblem(self.prediction, program.design, self.limits, penalties=program.penalties)


class _ListeningOptimizer(OptimizerProgram):
    """Keeps parameters and profile of every problem."""

    def restart(self, updating_period_s: float, rule: UpdatingRule | None = None) -> None:
        """Reset."""
        self.heard: list[LoopProblem] = []
        super().restart(updating_period_s, rule)

    def solve(self) -> InputSequence:
        """Solve, and keep what was solved."""
        sequence = super().solve()
        sent = self.state.sent
        w, ticks = float(sent.numbers[0]["w"]), int(sent.numbers[0]["ticks"])
        parameters = QpParameters(sent.x.copy(), w, sent.u_before.copy(), ticks, self.state.target.copy())
        self.heard.append(LoopProblem(parameters, sent.z.copy()))
        return sequence


def problem_sequence(scenario: Scenario, assignments: tuple[str, ...]) -> ProblemSequence:
    """Return the problems of a scenario, whichever solver is asked for; a worker keeps those of its last two."""
    return _recorded(scenario, tuple(one for one in assignments if not one.startswith(OF_THE_SOLVER)))


@lru_cache(maxsize=2)
def _recorded(scenario: Scenario, assignments: tuple[str, ...]) -> ProblemSequence:
    settings = settings_of((*assignments, *CONVERGED))
    program = settings.optimizer_plc.program
    model = load_model(settings.model.file)
    rig = OneProcessRig(settings, compiled=False)
    listening = rig.optimizer = _ListeningOptimizer(model, program, settings.limits)
    rig.run(scenario, Recorder(scenario.ticks, []))
    prediction = prediction_of(model, program.estimator.disturbed, program.design)
    problem = PredictiveProblem(prediction, program.design, settings.limits)
    profiles = PlayedProfiles(problem)
    return ProblemSequence(prediction, settings.limits, problem, profiles, listening.heard, np.array([
        _lowest(problem, profiles, recorded.parameters) for recorded in listening.heard
    ]))  # fmt: skip


def _lowest(problem: PredictiveProblem, profiles: PlayedProfiles, parameters: QpParameters) -> float:
    qp = problem.at(parameters)
    return profiles.cost(qp, profiles.optimum(qp, parameters), parameters).total
