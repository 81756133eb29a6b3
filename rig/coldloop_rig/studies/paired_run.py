"""A solver and the problems of a converged loop, one after the other, which `studies.paper.open_loop` compares."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.budget import PlcBudget
from coldloop_optimizer_plc.qp.costs import indicators
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_optimizer_plc.solvers import Solver, make_solver
from coldloop_rig.results.indicators import Indicators
from coldloop_rig.studies.problem_sequence import ProblemSequence

Array = NDArray[np.float64]
Columns = dict[str, list[float]]

INTERIOR_POINT_ITERATIONS: Final = (2, 4, 6, 8)
"""Counts of the interior-point solver whose PLC time every solver gets on a harsh problem."""
HARSH: Final = 10.0
"""A problem is harsh when its guess costs more than this times the lowest cost."""
FLOOR: Final = 1.0
"""Cost added to both, as the program adds it: in quiet a ratio of nearly nothing to nearly nothing says nothing."""
SETTLING: Final = {SolverName.QPOASES: 500, SolverName.OSQP: 400}
"""Iterations after each problem for solvers that keep something of it, so that harsh problems find them settled."""


def paired_run(sequence: ProblemSequence, program: ProgramSettings) -> Columns:
    """Let a solver go through all problems with its own hot starts; return costs as played, a row a problem."""
    solver, problem, penalised = make_solver(program), sequence.problem, sequence.solved_with(program)
    z = problem.hold(np.zeros(len(problem.design.input_scale)))
    columns: Columns = {name: [] for name in ("iterations", "j_dev", "j_cst", "violation", "lowest")}
    for (parameters, _), lowest in zip(sequence.recorded, sequence.lowest.tolist(), strict=True):
        qp, ticks = problem.at(parameters), parameters.elapsed_ticks
        iterations = PlcBudget(program.budget, solver.tau_1_s).iterations(ticks)
        answer = solver.solve(penalised.at(parameters), problem.shifted(z, ticks), (iterations,))
        z = penalised.within_first_rate(answer.z, parameters)
        cost = sequence.profiles.cost(qp, z, parameters)
        violation = float(indicators(problem, qp, z, parameters).violation)
        for name, value in zip(columns, (answer.iterations[-1], *cost, violation, lowest), strict=True):
            columns[name].append(float(value))
    return columns


def harsh_run(sequence: ProblemSequence, program: ProgramSettings) -> Columns:
    """Let a solver begin each harsh problem at the same guess; return its costs after equal PLC times.

    The guess is the shifted profile that the converged loop played; `count_2` ... say how many iterations the time of
    2, 4, 6 and 8 of the interior-point solver holds, `after_2` ... what the profile then costs.
    """
    solver, problem, penalised = make_solver(program), sequence.problem, sequence.solved_with(program)
    counts = equal_counts(program, solver)
    names = ("lowest", "guess", *(f"{what}_{k}" for k in counts for what in ("count", "after")))
    columns: Columns = {name: [] for name in names}
    before = problem.hold(np.zeros(len(problem.design.input_scale)))
    for (parameters, z), lowest in zip(sequence.recorded, sequence.lowest.tolist(), strict=True):
        qp = problem.at(parameters)
        guess = problem.shifted(before, parameters.elapsed_ticks)
        at_guess = sequence.profiles.cost(qp, guess, parameters).total
        before, settling = z, SETTLING.get(program.solver, 0)
        harsh = at_guess + FLOOR > HARSH * (lowest + FLOOR)
        if not harsh and not settling:
            continue
        looked_at = tuple(counts.values()) if harsh else ()
        last = looked_at[-1] if harsh else 0
        answer = solver.solve(penalised.at(parameters), guess, (*looked_at, last + settling))
        if harsh:
            row = [lowest, at_guess]
            for count, point in zip(looked_at, answer.points, strict=False):
                row += [count, sequence.profiles.cost(qp, point, parameters).total]
            for name, value in zip(columns, row, strict=True):
                columns[name].append(float(value))
    return columns


def equal_counts(program: ProgramSettings, solver: Solver) -> dict[int, int]:
    """Return the iterations of a solver that take as long as 2, 4, 6 and 8 of the interior-point solver."""
    iteration_s = program.interior_point.tau_1_s
    return {k: math.floor(k * iteration_s / solver.tau_1_s + 1e-9) for k in INTERIOR_POINT_ITERATIONS}


def paired_indicators(columns: Columns, period_s: float) -> Indicators:
    """Return the indicators that problems without a loop have; the others are not numbers."""
    none: dict[str, Any] = {**dict.fromkeys(Indicators._fields, math.nan), "outside_band_pct": {}}
    if not columns.get("j_dev"):
        return Indicators(**none)
    j_dev, j_cst, violation = (np.array(columns[name]) for name in ("j_dev", "j_cst", "violation"))
    return Indicators(**none | {
        "J_dev": float(j_dev.sum()), "J_cst": float(j_cst.sum()), "J_open_mean": float((j_dev + j_cst).mean()),
        "c1": float(violation.max()), "c2": float(violation.mean()), "tau_u_mean": period_s,
        "tau_u_mean_per_update": period_s, "iterations_total": round(sum(columns["iterations"])),
    })  # fmt: skip
