"""All solvers side by side on one sequence of problems recorded from the closed loop.

Each begins every problem at the recorded guess, and keeps from one problem to the next what it keeps in operation. J is
the augmented cost with its constant and the program's floor of 1, J* its minimum over the box. Harsh problems are those
whose guess costs more than 10 J*. l is the smallest count of iterations after which J is never above what it was that
many iterations before (paper, Remark to Definition 1), or above what it was at the guess.
"""

import argparse
import time
from collections.abc import Sequence
from typing import NamedTuple

import daqp
import numpy as np
from numpy.typing import NDArray
from qp_peers import TO_THE_END, installed_peers, peer_answer

from coldloop.errors import ConfigurationError
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.lti_model import load
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_optimizer_plc.solvers import Answer, Solver, judged, make_solver
from coldloop_plant.load import find_load
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_studies.settings import settings_of

Array = NDArray[np.float64]

COUNTS = (2, 5, 10, 20)
FEW = (2, 4, 6, 8)
HARSH = 10.0
UNBOUNDED = 1e30
EQUAL = 1e-9
"""Relative rise of J that is rounding."""


class RecordedProblem(NamedTuple):
    """Problem and guess of a solve."""

    problem: QuadraticProblem
    guess: Array


class RecordingSolver:
    """A solver that records its problems and guesses."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.alpha, self.tau_1_s = solver.alpha, solver.tau_1_s
        self.heard: list[RecordedProblem] = []

    def reset(self) -> None:
        """Pass on."""
        self._solver.reset()

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Remember, and pass on."""
        self.heard.append(RecordedProblem(problem, guess.copy()))
        return self._solver.solve(problem, guess, counts)


def record(hours: str, minutes: float, period_s: float) -> list[RecordedProblem]:
    """Run the loop with the ODE-based solver; return its problems and guesses."""
    settings = settings_of(())
    heard: list[RecordedProblem] = []
    for hour in hours:
        rig = OneProcessRig(settings)
        listener = RecordingSolver(make_solver(settings.optimizer_plc.program))
        rig.optimizer.solver = listener
        ticks = round(240 * minutes)
        rig.run(
            Scenario(ticks, find_load(hour, load(settings.model.file).w0, COLD_BOX), period_s, seed=1), Recorder(ticks)
        )
        heard += listener.heard
    matrices = {"Phi": heard[0].problem.Phi, "Gamma": heard[0].problem.Gamma}
    floor = settings.optimizer_plc.program.adaptive.cost_floor
    return [RecordedProblem(qp._replace(**matrices, constant=qp.constant + floor), guess) for qp, guess in heard]


def lowest_cost(qp: QuadraticProblem, alpha: float) -> float:
    """Return the minimum of J over the box: each penalty is a variable s >= 0 with Gamma z - s <= gamma."""
    n, m = len(qp.phi), len(qp.gamma)
    H = np.zeros((n + m, n + m))
    H[:n, :n], H[n:, n:] = 2.0 * qp.Phi, 2.0 * alpha * np.eye(m)
    low = np.concatenate([np.maximum(qp.low, -UNBOUNDED), np.zeros(m), np.full(m, -UNBOUNDED)])
    high = np.minimum(np.concatenate([qp.high, np.full(m, UNBOUNDED), qp.gamma]), UNBOUNDED)
    rows = np.hstack([qp.Gamma, -np.eye(m)])
    _, lowest, flag, _ = daqp.solve(
        H, np.concatenate([qp.phi, np.zeros(m)]), rows, high, low, np.zeros(len(high), np.int32), primal_tol=1e-9
    )
    if flag != 1:
        raise RuntimeError(f"no optimum found: {flag}")
    return float(lowest) + qp.constant


def paths(solver: Solver, problems: list[RecordedProblem], iterations: int) -> Array:
    """Return J after 0, 1, ... iterations, a row for each problem."""
    costs = np.empty((len(problems), iterations + 1))
    for row, (problem, guess) in zip(costs, problems, strict=True):
        answer = solver.solve(problem, guess, range(iterations + 1))
        row[:] = answer.costs + problem.constant
    return costs


def smallest_l(costs: Array, starts: int | None) -> str:
    """Return the smallest l with J[k + l] <= J[k] for all problems and the first `starts` k, None for all."""
    for step in range(1, costs.shape[1]):
        before, after = costs[:, : costs.shape[1] - step][:, :starts], costs[:, step:][:, :starts]
        if (after <= before * (1.0 + EQUAL)).all():
            return str(step)
    return f"> {costs.shape[1] - 1}"


def times(solver: Solver, problems: list[RecordedProblem], count: int) -> tuple[float, float]:
    """Return the median times, in us, of a start and of `count` iterations."""
    starts, iterations = [], []
    for problem, guess in problems:
        before = time.perf_counter()
        solver.solve(problem, guess, (0,))
        between = time.perf_counter()
        solver.solve(problem, guess, (count,))
        starts.append(between - before)
        iterations.append(time.perf_counter() - between - starts[-1])
    return float(np.median(starts)) * 1e6, float(np.median(iterations)) * 1e6


def report_cuts(name: str, problems: list[RecordedProblem], best: Array, harsh: NDArray[np.bool_]) -> None:
    """Print the accuracy on harsh problems when every problem of the sequence is cut off at the same count."""
    cells = []
    for count in COUNTS:
        solver = make_solver(ProgramSettings(solver=SolverName(name)))
        ratios, solutions = [], []
        for (problem, guess), lowest in zip(problems, best, strict=True):
            answer = solver.solve(problem, guess, (count,))
            ratios.append((answer.cost + problem.constant) / lowest)
            solutions.append(judged(problem, answer, solver.alpha))
        of_harsh = np.array(ratios)[harsh]
        cells.append(f"{np.median(of_harsh):9.3g} / {of_harsh.max():9.3g}")
    primal = np.median([solution.primal_residual for solution, hard in zip(solutions, harsh, strict=True) if hard])
    dual = np.median([solution.dual_residual for solution, hard in zip(solutions, harsh, strict=True) if hard])
    print(f"{name:14}", *cells, f"{primal:8.1e} {dual:8.1e}")


def report_paths(name: str, problems: list[RecordedProblem], harsh: NDArray[np.bool_], iterations: int) -> None:
    """Print times and monotonicity."""
    settings = ProgramSettings(solver=SolverName(name))
    warm_up = make_solver(settings)
    times(warm_up, problems[:2], 1)
    start, ten = times(make_solver(settings), problems, 10)
    _, ten_harsh = times(make_solver(settings), [p for p, hard in zip(problems, harsh, strict=True) if hard], 10)
    costs = paths(make_solver(settings), problems, iterations)
    rises = np.diff(costs, axis=1) > EQUAL * costs[:, :-1]
    changes = np.abs(np.diff(costs, axis=1)) > EQUAL * costs[:, :-1]
    share = 100.0 * rises.sum() / max(changes.sum(), 1)
    above = 100.0 * float((costs[:, -1] > costs[:, 0] * (1.0 + EQUAL)).mean())
    print(f"{name:14} {start:8.0f} {ten:9.0f} {ten_harsh / 10:9.1f} {share:8.1f} {above:10.1f} "
          f"{smallest_l(costs, None):>8} {smallest_l(costs, 1):>8} {smallest_l(costs[harsh], 1):>8}")  # fmt: skip


def main() -> None:
    """Record, solve and print."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", default="ef", help="one-hour loads to record, a letter each")
    parser.add_argument("--minutes", type=float, default=60, help="of each")
    parser.add_argument("--period", type=float, default=5.0, help="updating period recorded, s")
    parser.add_argument("--iterations", type=int, default=100, help="followed for the monotonicity")
    options = parser.parse_args()
    problems = record(options.hours, options.minutes, options.period)
    alpha = ProgramSettings().ode.alpha
    best = np.array([lowest_cost(problem, alpha) for problem, _ in problems])
    names = [name.value for name in SolverName if is_there(name)]
    guesses = paths(make_solver(ProgramSettings()), problems, 0)[:, 0] / best
    harsh = guesses > HARSH
    print(f"{len(problems)} problems, {harsh.sum()} of them harsh; J of their guesses / J*: median "
          f"{np.median(guesses[harsh]):.3g}, largest {guesses.max():.3g}")  # fmt: skip
    print(f"\nharsh problems, J / J* (median / largest), all cut off at     residuals at {COUNTS[-1]} (medians)")
    print(f"{'':14}", *(f"{count:21}" for count in COUNTS), f"{'primal':>8} {'dual':>8}")
    for name in names:
        report_cuts(name, problems, best, harsh)
    print(f"\n{'':14} start us  ten us  harsh us/it. rises %  end above %  l any k  l from 0  of harsh")
    for name in names:
        report_paths(name, problems, harsh, options.iterations)
    if harsh.any():
        print("\nharsh problems, J / J* (median / largest), begun at the guess or at their own point, cut off at")
        chosen = [one for one, hard in zip(problems, harsh, strict=True) if hard]
        report_interior_points(chosen, best[harsh], alpha)


def report_interior_points(problems: list[RecordedProblem], best: Array, alpha: float) -> None:
    """Print the accuracy of our interior point and of libraries after few iterations, each problem begun cold."""
    peers = installed_peers()
    print(f"\n{'':14}", *(f"{count:21}" for count in (*FEW, TO_THE_END)), " ms a solve")
    names = ["ode", "interior-point", *peers]
    for name in names:
        cells, spent = [], 0.0
        for count in (*FEW, TO_THE_END):
            before = time.perf_counter()
            if name in peers:
                costs = [
                    augmented_cost(qp, peer_answer(peers[name], qp, alpha, guess, count), alpha) + qp.constant
                    for qp, guess in problems
                ]
            else:
                costs = [cost_after(SolverName(name), qp, guess, count) for qp, guess in problems]
            spent = (time.perf_counter() - before) / len(problems)
            ratios = np.array(costs) / best
            cells.append(f"{np.median(ratios):9.4g} / {ratios.max():9.3g}")
        print(f"{name:14}", *cells, f"{1e3 * spent:10.2f}")


def cost_after(name: SolverName, qp: QuadraticProblem, guess: Array, count: int) -> float:
    """Return J after `count` iterations of one of our solvers."""
    solver = make_solver(ProgramSettings(solver=name))
    return solver.solve(qp, guess, (count,)).cost + qp.constant


def is_there(name: SolverName) -> bool:
    """Return whether a solver can be had here."""
    try:
        make_solver(ProgramSettings(solver=name))
    except ConfigurationError as error:
        print(error)
        return False
    return True


if __name__ == "__main__":
    main()
