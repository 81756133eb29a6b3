"""Problems of a run in single precision, and what the ODE-based solver's kernels make of each: golden vectors."""

from pathlib import Path
from typing import Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from coldloop.config import load_configuration
from coldloop.process.lti_model import load as load_model
from coldloop.safety.sequence import InputSequence
from coldloop_optimizer_plc import scheme
from coldloop_optimizer_plc.computing_settings import Arithmetic
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.arithmetic import real_of
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.rules import UpdatingRule
from coldloop_optimizer_plc.solvers.interface import Answer, Costs
from coldloop_optimizer_plc.solvers.ode import OdeMethod, solve
from coldloop_plant.load import find_load
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.plc_export.kernels.ode_program import PER_PROBLEM
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

Array = NDArray[np.float64]

SINGLE: Final = (
    "optimizer_plc.program.preset=paper",
    "optimizer_plc.program.arithmetic=float32",
    "optimizer_plc.program.solver=ode",
)
"""What the run is made with: the paper's configuration in the arithmetic of its PLC."""
ITERATIONS: Final = 20
"""Of the solver for each recorded problem; each one is compared."""

TELLING: Final = 8
"""Golden vectors of an export; each takes 5 kB."""
LEAST_GAIN: Final = 1e-6
"""Of the cost: a problem at rest gains less, by rounding alone."""
TICKS, LOAD = 1440, "e"
"""Of the run that is recorded: six minutes, in which this load has a large step."""


class GoldenVector(NamedTuple):
    """A problem, the guess it is begun from, and the kernels' answer after 1, 2, ... `ITERATIONS` iterations."""

    problem: QuadraticProblem
    guess: Array
    answer: Answer


class GoldenVectors(NamedTuple):
    """Problems of one run, which have the same matrices, and the solver's constants."""

    method: OdeMethod
    vectors: list[GoldenVector]

    def telling(self, most: int = TELLING) -> list[GoldenVector]:
        """Return the problems that the solver lowers most, in their order; none that leave the inputs at rest."""
        gains = [float(each.answer.guessed) - float(each.answer.costs[-1]) for each in self.vectors]
        by_gain = sorted(range(len(gains)), key=lambda place: -gains[place])
        return [self.vectors[place] for place in sorted(by_gain[:most]) if gains[place] > LEAST_GAIN]


class _ListeningOptimizer(OptimizerProgram):
    """Keeps every problem with its guess."""

    def restart(self, updating_period_s: float, rule: UpdatingRule | None = None) -> None:
        """Reset."""
        self.heard: list[tuple[QuadraticProblem, Array]] = []
        super().restart(updating_period_s, rule)

    def solve(self) -> InputSequence:
        """Keep what is solved, and solve it: posing a problem twice gives the same bits."""
        qp, guess = scheme.pose(self.constants, self.state)
        self.heard.append((qp, guess))
        return super().solve()


def paper_settings(model: Path) -> Settings:
    """Return the settings of the paper's PLC with a model file."""
    options = {"model.file": (str(model), "model")}
    return load_configuration(Settings, environment={}, assignments=SINGLE, options=options).settings


def record(settings: Settings, ticks: int = TICKS, load: str = LOAD) -> GoldenVectors:
    """Return the problems of a run of so many ticks under a named load, adaptive updating period, with the answers."""
    model, rig = load_model(settings.model.file), OneProcessRig(settings, compiled=False)
    optimizer = rig.optimizer = _ListeningOptimizer(model, settings.optimizer_plc.program, settings.limits)
    rig.run(Scenario(ticks, find_load(load, model.w0, settings.process), 0.0, seed=1), Recorder(ticks, []))
    method = cast("OdeMethod", optimizer.method)
    return GoldenVectors(method, [answered(method, qp, guess) for qp, guess in optimizer.heard])


def answered(method: OdeMethod, problem: QuadraticProblem, guess: Array) -> GoldenVector:
    """Return a problem with what the kernels answer, in single precision."""
    real = real_of(Arithmetic.FLOAT32)
    none, counts = Costs(real(np.inf), real(np.inf)), np.arange(1, ITERATIONS + 1)
    return GoldenVector(problem, guess, solve(method, problem, guess, counts, none))


def arrays_in(vector: GoldenVector) -> dict[str, Array]:
    """Return the arrays of a golden vector by their names."""
    return {**{name: getattr(vector.problem, name) for name in PER_PROBLEM}, "guess": vector.guess,
            **{name: getattr(vector.answer, name).ravel() for name in ("points", "costs", "iterations")}}  # fmt: skip
