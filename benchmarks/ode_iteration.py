"""One iteration of the ODE-based solver against one LAPACK Cholesky factorisation of the same size."""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
from scipy.linalg import lapack

from coldloop.limits import InputLimits
from coldloop.lti_model import load
from coldloop.model_settings import DEFAULT_MODEL_FILE
from optimizer_plc.computing_settings import OdeSettings
from optimizer_plc.design import ControlDesign
from optimizer_plc.prediction import PredictionModel
from optimizer_plc.problem import PredictiveProblem, Situation
from optimizer_plc.solvers.ode import OdeSolver


def microseconds(work: Callable[[], object], rounds: int) -> float:
    """Return the median time of a call."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5000)
    rounds = parser.parse_args().rounds
    prediction = PredictionModel(load(DEFAULT_MODEL_FILE))
    problem = PredictiveProblem(prediction, ControlDesign(), InputLimits())
    qp = problem.at(Situation(np.zeros(prediction.n_states), 150.0, np.zeros(3)))
    solver = OdeSolver(OdeSettings())
    solver.start(qp, np.zeros(problem.size))
    solver.iterate(1)
    matrix = np.asfortranarray(problem.Phi + np.eye(problem.size))
    iteration = microseconds(lambda: solver.iterate(1), rounds)
    cholesky = microseconds(lambda: lapack.dpotrf(matrix), rounds)
    print(f"ODE iteration {iteration:.1f} us, LAPACK Cholesky {cholesky:.1f} us (n = {problem.size}): "
          f"ratio {iteration / cholesky:.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
