"""One iteration of the ODE-based solver against one LAPACK Cholesky factorisation of the same size.

Both are timed on problems recorded from the closed loop, each as a batch; problems that stall within the iterations
timed are left out, since a stalled solver does nothing.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
from qp_solvers import RecordedProblem, record
from scipy.linalg import lapack

from coldloop_optimizer_plc.computing_settings import OdeSettings
from coldloop_optimizer_plc.solvers.ode import ode_solver

ITERATIONS = 10
"""Of each problem."""
FLOOR_US = 1.0
"""Nothing of this size takes less: a smaller figure is a mistake of this program."""


def lively(problems: list[RecordedProblem]) -> list[RecordedProblem]:
    """Return the problems that do not stall."""
    solver = ode_solver(OdeSettings())
    return [one for one in problems if solver.solve(*one, (ITERATIONS + 1,)).iterations[-1] > ITERATIONS]


def microseconds(work: Callable[[], object], times: int) -> float:
    """Return the time of a call."""
    start = time.perf_counter()
    for _ in range(times):
        work()
    return (time.perf_counter() - start) / times * 1e6


def iteration_us(problems: list[RecordedProblem]) -> float:
    """Return the mean time of an iteration."""
    solver, total = ode_solver(OdeSettings()), 0.0
    for one in problems:
        start, whole = (microseconds(lambda q=q: solver.solve(*one, (q,)), 1) for q in (0, ITERATIONS))  # noqa: B023
        total += whole - start
    return total / ITERATIONS / len(problems)


def cholesky_us(problems: list[RecordedProblem]) -> float:
    """Return the mean time of LAPACK's factorisation of Phi + I, without the copy."""
    matrices = [np.asfortranarray(problem.Phi + np.eye(len(problem.Phi))) for problem, _ in problems]
    return statistics.fmean(microseconds(lambda M=M: lapack.dpotrf(M), 10) for M in matrices)


def measured(problems: int, minutes: float, repeat: int) -> tuple[float, float, int]:
    """Return the medians of an iteration and of a factorisation, us, and how many problems were timed."""
    chosen = lively(record("e", minutes, 1.0))[:problems]
    pairs = [(iteration_us(chosen), cholesky_us(chosen)) for _ in range(repeat)]
    iteration, cholesky = (statistics.median(each) for each in zip(*pairs, strict=True))
    if min(iteration, cholesky) < FLOOR_US:
        raise SystemExit(f"the machine is too busy to measure: {iteration:.2f} us and {cholesky:.2f} us are no times")
    return iteration, cholesky, len(chosen)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problems", type=int, default=300)
    parser.add_argument("--minutes", type=float, default=20.0, help="of load e that they are recorded from")
    parser.add_argument("--repeat", type=int, default=5, help="the medians are printed")
    options = parser.parse_args()
    iteration, cholesky, count = measured(options.problems, options.minutes, options.repeat)
    print(f"{count} problems: ODE iteration {iteration:.2f} us, LAPACK Cholesky {cholesky:.2f} us (n = 49): "
          f"ratio {iteration / cholesky:.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
