"""One predictive problem, as JSON for who solves it with something else, and the time that Coldloop takes for it.

The problem of a load step at the operating point, with every sample of the horizon a decision and a constraint instant:
so any tool can state it that knows linear models, bounds and soft constraints. Coldloop solves it by its interior-point
method to the end, and the problem with the paper's seven instants, too: that is what runs on line.
"""

import json
import statistics
import sys
import time
from typing import Any

import numpy as np

from coldloop.process.lti_model import load
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.qp.prediction import PredictionModel, state_weights
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.settings import ControlDesign, ProgramSettings, SolverName, trivial_design
from coldloop_optimizer_plc.solvers import make_solver
from coldloop_rig.settings import Settings

LOAD_STEP_W = 40.0
ITERATIONS = 200


def solved(prediction: PredictionModel, design: ControlDesign, limits: InputLimits) -> tuple[float, float]:
    """Return the time (s) that the problem takes, a median of five, and its cost."""
    problem = PredictiveProblem(prediction, design, limits)
    solver = make_solver(ProgramSettings(solver=SolverName.INTERIOR_POINT, design=design))
    at_rest = np.zeros(3)
    times = []
    for _ in range(6):
        start = time.perf_counter()
        qp = problem.at(QpParameters(np.zeros(prediction.n_states), LOAD_STEP_W, at_rest))
        answer = solver.solve(qp, problem.hold(at_rest), (ITERATIONS,))
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:]), answer.cost + float(qp.constant)


def described(prediction: PredictionModel, design: ControlDesign, limits: InputLimits) -> dict[str, Any]:
    """Return the problem: x' = A x + B u + F w, y = C x + D u + G w for each sample, as deviations from rest."""
    A, B, F = prediction.sample
    rows = list(prediction.constrained)
    y0, u0 = prediction.y0[rows], prediction.u0
    matrices = {
        "A": A, "B": B, "F": F[:, 0], "C": prediction.C[rows], "D": prediction.D[rows], "G": prediction.G[rows, 0],
        "Q": state_weights(prediction.model, design), "R": design.input_weight, "violation": design.violation_weight,
        "y_low": np.array(design.output_low) - y0, "y_high": np.array(design.output_high) - y0,
        "u_low": np.array(limits.low) - u0, "u_high": np.array(limits.high) - u0, "rate": limits.rate,
    }  # fmt: skip
    return {name: np.asarray(M).tolist() for name, M in matrices.items()} | {
        "horizon": design.horizon, "w": LOAD_STEP_W,
    }  # fmt: skip


def main() -> None:
    """Write the problem and our figures."""
    settings = Settings()
    design, limits = settings.optimizer_plc.program.design, settings.limits
    prediction = PredictionModel(load(settings.model.file))
    every = trivial_design(design)
    own = {name: solved(prediction, one, limits) for name, one in (("every sample", every), ("seven instants", design))}
    json.dump({"problem": described(prediction, design, limits), "own": own}, sys.stdout)


if __name__ == "__main__":
    main()
