"""Budget of a PLC in an updating period, and whether its memory holds the problem, as tables and in a sentence."""

from collections.abc import Callable
from itertools import chain
from math import floor
from typing import NamedTuple

import numpy as np

from coldloop.process.lti_model import load
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorKind, EstimatorSettings, PlcBudget
from coldloop_optimizer_plc.estimator import check_detectability, stationary_gains
from coldloop_optimizer_plc.plausibility import watched_output
from coldloop_optimizer_plc.qp.linear_algebra import real_of, rounded
from coldloop_optimizer_plc.qp.prediction import PredictionModel, prediction_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName, Target, trivial_design
from coldloop_rig.plc_sizing import operations
from coldloop_rig.plc_sizing.operations import ACTIVE_ROWS, SOLVERS, WORD, Operations, QpSizes
from coldloop_rig.plc_sizing.plc import MEMORY_BYTES, PlcProfile, cholesky_times, reference_curve, residuals, slow_down
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import aligned


def workspaces(n: int, m: int) -> dict[SolverName, int]:
    """Return the bytes of each solver's workspace besides the problem, for n variables and m rows; zeros are stored.

    Our own solvers as in their code, without copies of Phi and Gamma in another order; the others as their papers have
    them.
    """
    triangle = n * (n + 1) // 2
    held = {  # elements of matrices, vectors with an element for each variable, vectors with one for each row of Gamma
        # stage matrix; three points, four velocities, variables held; excess and three sets of active rows
        SolverName.ODE: (n * n, 8, 4),
        # Q, R, T; z, multipliers and data (gradient, bounds) with their steps, two products
        SolverName.QPOASES: (3 * n * n, 12, 6),
        # L; z and z~ with scaling, five vectors of the rows of Gamma and of the n bounds, D of L D L'
        SolverName.OSQP: (n * m + triangle, 10, 6),
        # z, the extrapolated point, gradient, change, step sizes; excess and active rows
        SolverName.FAST_GRADIENT: (0, 5, 2),
        # Newton matrix; point, step, predicted point (z and two multipliers each), distances of both points, products,
        # gradient, best point
        SolverName.INTERIOR_POINT: (n * n, 17, 8),
        # M, R^-1, L; nine vectors of variables, three of rows and bounds
        SolverName.DAQP: (n * m + 2 * triangle + n + 1, 12, 3),
    }
    sizes = {name: WORD * (matrices + by_variable * n + by_row * m)
             for name, (matrices, by_variable, by_row) in held.items()}  # fmt: skip
    return {**sizes, SolverName.HYBRID: max(sizes[SolverName.ODE], sizes[SolverName.INTERIOR_POINT])}


class Footprint(NamedTuple):
    """Bytes in single precision; what is needed for one part of the program each."""

    hessian: int
    """Phi alone."""
    problem: int
    """Gamma, the maps to phi, gamma, the bounds and the constant."""
    shift: int
    """One shift of the profile; its other shifts are computed when they are needed."""
    solver: int
    """Workspace of the solver."""
    estimator: int
    """Transitions, Kalman gains and inverse covariances of every updating period, output matrices, states beside."""
    sequence: int
    """Two buffers of the longest sequence: the one being played, the one being written."""

    @property
    def total(self) -> int:
        """All of it."""
        return sum(self)


def estimator_memory(prediction: PredictionModel, settings: EstimatorSettings, apart: int = 0) -> int:
    """Return the bytes of the estimator, with so many predictions beside the filter's."""
    real = real_of(Arithmetic.FLOAT32)
    steps = (*stationary_gains(prediction, settings), *prediction.outputs, *chain(*prediction.transitions.values()))
    states = WORD * apart * (2 * prediction.n_states + 1)
    return states + sum(rounded(M, real).nbytes for M in steps)


def footprint(problem: PredictiveProblem, estimator: int, solver: SolverName) -> Footprint:
    """Return what a problem made in single precision needs with a solver and an estimator of so many bytes."""
    if problem.Phi.dtype != np.float32:
        raise ValueError("the PLC computes in single precision")
    return Footprint(
        hessian=problem.Phi.nbytes, problem=problem.memory() - problem.Phi.nbytes, shift=problem.Phi.nbytes,
        solver=workspaces(problem.size, len(problem.Gamma))[solver], estimator=estimator,
        sequence=2 * SEQUENCE_ROWS * problem.design.n_inputs * WORD,
    )  # fmt: skip


ROUNDING = 1e-9
MANY = 1000  # number of variables from which on it is not printed


def power_of(profile: PlcProfile, size: int) -> float:
    """Return P, the speed of a PLC over the reference PLC's, in loops as long as a problem has variables."""
    return profile.flops_per_s(size) / reference_curve().flops_per_s(size)


def capacity(size: int, needed: Footprint, memory_bytes: int, budget: PlcBudget) -> tuple[float, float]:
    """Return the most variables for which a PLC has memory, and time for one iteration in the longest period.

    A problem of `size` variables takes `needed` in memory, and the PLC has `memory_bytes`; `budget` is that of the PLC
    and the solver. Matrices grow with the square of the variables and the time of an iteration with their third power,
    as rows grow with them; the estimator, the sequences and the preparation stay.
    """
    fixed = needed.estimator + needed.sequence
    room = max(memory_bytes - fixed, 0)
    time_s = max(budget.longest_ticks * budget.times.tick_s - budget.times.slots, 0.0)
    by_time = size * (time_s / budget.times.iteration) ** (1 / 3)
    return size * (room / (needed.total - fixed)) ** (1 / 2), by_time


def verdict(
    profile: PlcProfile, program: ProgramSettings, problem: PredictiveProblem, needed: Footprint
) -> tuple[bool, str]:
    """Return whether a PLC has memory and time for a problem, and what it can do with it; `program` has its power."""
    budget = PlcBudget(program.budget, program.iteration_s)
    by_memory, by_time = capacity(problem.size, needed, profile.memory_bytes, budget)
    problem_text = f"the problem ({problem.size} variables, {len(problem.Gamma)} rows) with {program.solver_name}"
    if min(by_memory, by_time) + ROUNDING < problem.size:
        lacks = []
        if by_memory < problem.size:
            lacks.append(f"it takes {needed.total:,} of {profile.memory_bytes:,} bytes")
        if by_time < problem.size:
            lacks.append(budget.too_slow())
        return False, f"{profile.name}: {problem_text} does not fit: {', and '.join(lacks)}."
    memory = f"{needed.total / 1e3:,.0f} of {profile.memory_bytes / 1e3:,.0f} kB"
    ends = budget.ladder[0], budget.ladder[-1]
    first, then = sorted((("memory", by_memory), ("time", by_time)), key=lambda one: one[1])
    shortest_s, longest_s = (ticks * budget.times.tick_s for ticks in ends)
    soonest, most = (f"{count} iteration{'s' * (count != 1)}" for count in map(budget.iterations, ends))
    variables = [MANY if count >= MANY else floor(count + ROUNDING) for _, count in (first, then)]
    longest_call_s, what = max((budget.times.iteration, "an iteration"), (budget.times.preparation, "the preparation"))
    calls = ""
    if profile.cycle_s is not None and longest_call_s > profile.cycle_s:
        calls = (
            f"; {what} takes {longest_call_s:.3g} s and its cycle monitoring stops a program after {profile.cycle_s:g}"
            f" s: divide it over {-int(-longest_call_s // profile.cycle_s)} calls, or set that higher"
        )
    return True, (
        f"{profile.name}: {problem_text} fits, in {memory}; it updates every {shortest_s:g} s at the "
        f"soonest ({soonest}), {most} in {longest_s:g} s; {first[0]} gives way first, with more than {variables[0]} "
        f"variables ({then[0]} with more than {variables[1]}){calls}."
    )


def budget_tables(settings: Settings, period_s: float | None, executed: Callable[[PredictiveProblem], str]) -> str:
    """Return the tables as text, for the configured power and one updating period or several (None).

    `executed` returns what an iteration as exported takes.
    """
    problem, prediction = problem_of(settings)
    program = settings.optimizer_plc.program
    limited, apart = program.cold_end.approach_k > 0.0, predicted_apart(program, prediction)
    curve, times = reference_curve(), cholesky_times()
    speed = (
        f"Cholesky factorisation on the PLC: {curve.c1 * 1e6:.3g} n + {curve.c2 * 1e6:.3g} n^2 "
        f"+ {curve.c3 * 1e6:.3g} n^3 us, within {100 * np.abs(residuals(curve, times)).max():.2f} % of 25 times\n"
        f"speed in loops of length {problem.size}: {curve.flops_per_s(problem.size) / 1e6:.3f} Mflop/s; "
        f"slow-down against the laptop: {slow_down(times, problem.size):.0f}\n"
    )
    return "\n".join([
        speed,
        _operations(problem, prediction, apart, limited=limited) + executed(problem),
        _iterations(program, problem, period_s),
        _memory(settings, problem, prediction, MEMORY_BYTES),
    ])  # fmt: skip


def plc_tables(
    settings: Settings, period_s: float | None, profile: PlcProfile, costs: Callable[[Settings], str]
) -> str:
    """Return what a PLC can do as text: a sentence, what updating periods cost there, and the tables that differ.

    The power in the settings becomes this PLC's; `period_s` is one updating period, or None for several. `costs`
    returns a sentence or nothing, and is called where the controller runs there.
    """
    problem, prediction = problem_of(settings)
    settings = with_power(settings, power_of(profile, problem.size))
    program = settings.optimizer_plc.program
    apart = predicted_apart(program, prediction)
    needed = footprint(problem, estimator_memory(prediction, program.estimator, apart), program.solver)
    fits, sentence = verdict(profile, program, problem, needed)
    speed = (
        f"\nP = {program.budget.power:.3g}, {profile.flops_per_s(problem.size) / 1e6:.3g} Mflop/s in loops of length "
        f"{problem.size}: {profile.source}\n"
        f"for a run there: --set optimizer_plc.program.budget.power={program.budget.power:.4g}\n"
    )
    return "\n".join([
        *filter(None, [sentence, costs(settings) if fits else ""]),
        speed,
        _iterations(program, problem, period_s),
        _memory(settings, problem, prediction, profile.memory_bytes),
    ])  # fmt: skip


def problem_of(settings: Settings) -> tuple[PredictiveProblem, PredictionModel]:
    """Return the configured problem in single precision, and the model it is made from."""
    program = settings.optimizer_plc.program
    prediction = prediction_of(load(settings.model.file), program.estimator.disturbed, program.design)
    check_detectability(prediction)
    real = real_of(Arithmetic.FLOAT32)
    return PredictiveProblem(prediction, program.design, settings.limits, real, program.penalties), prediction


def with_power(settings: Settings, power: float) -> Settings:
    """Return the settings for a PLC of this power."""
    return settings.with_program(budget=settings.optimizer_plc.program.budget.model_copy(update={"power": power}))


def counted_sizes(problem: PredictiveProblem) -> tuple[QpSizes, QpSizes]:
    """Return the sizes of a problem: dense, and with its zeros left out."""
    return (
        operations.dense_sizes(problem.size, len(problem.Gamma), problem.n_inputs),
        operations.sizes_without_zeros(problem.Phi, problem.Gamma, np.isfinite(problem.maps.high)),
    )


def predicted_apart(program: ProgramSettings, prediction: PredictionModel) -> int:
    """Return how many predictions there are beside the filter's, without the watched reading."""
    kalman = program.estimator.kind is EstimatorKind.KALMAN
    return 2 * (kalman and watched_output(program.plausibility, prediction) >= 0)


def _operations(problem: PredictiveProblem, prediction: PredictionModel, apart: int, *, limited: bool) -> str:
    dense, without_zeros = counted_sizes(problem)
    m, mean = dense.m, ACTIVE_ROWS.mean
    variants: dict[str, Callable[[QpSizes], Operations]] = {
        "ode, no row active": lambda sizes: operations.ode(sizes, 0),
        f"ode, {mean:g} rows active (mean)": lambda sizes: operations.ode(sizes, mean),
        f"ode, {mean:g} rows active (mean), velocity kept": lambda sizes: operations.ode_kept(sizes, mean),
        f"ode, {ACTIVE_ROWS.worst:g} rows active (worst seen)": lambda sizes: operations.ode(sizes, ACTIVE_ROWS.worst),
        f"ode, all {m} rows active": lambda sizes: operations.ode(sizes, m),
        f"qpoases, {operations.WORKING_SET:g} constraints held": SOLVERS[SolverName.QPOASES].operations,
        "osqp": SOLVERS[SolverName.OSQP].operations,
        f"fast-gradient, {mean:g} rows active": SOLVERS[SolverName.FAST_GRADIENT].operations,
        "interior-point": SOLVERS[SolverName.INTERIOR_POINT].operations,
        f"daqp, {operations.WORKING_SET:g} constraints held": SOLVERS[SolverName.DAQP].operations,
    }
    rows: list[tuple[str, ...]] = [("one iteration", "operations", "without zeros", "kB moved", "without zeros")]
    for name, count in variants.items():
        both = count(dense), count(without_zeros)
        rows.append((name, *(f"{one.flops:,.0f}" for one in both), *(f"{one.bytes / 1e3:.1f}" for one in both)))
    sizes = operations.PreparationSizes(
        dense, m - 4 * len(problem.design.constraint_instants), problem.n_knots, prediction.n_states,
        prediction.D.shape[1], prediction.D.shape[0],
        targets=problem.design.target is not Target.OPERATING_POINT, limited=limited, apart=apart,
    )  # fmt: skip
    once = operations.preparation(sizes, mean)
    rows.append(("preparation, once an updating period", f"{once.flops:,.0f}", "", f"{once.bytes / 1e3:.1f}", ""))
    return aligned(rows, numbers=True)


def _iterations(program: ProgramSettings, problem: PredictiveProblem, period_s: float | None) -> str:
    """Return times of an iteration, periods of the ladder, iterations in some, and memory, solver by solver."""
    longest_s = program.process.sampling_period_s
    periods_s = [share * longest_s for share in (0.2, 0.5, 1.0)] if period_s is None else [period_s]
    sizes, speed = counted_sizes(problem), reference_curve().flops_per_s(problem.size)
    memory = workspaces(problem.size, len(problem.Gamma))
    columns = ("solver", "paper s", "dense s", "without zeros s", "tau_1_s", "default follows")
    rows: list[tuple[str, ...]] = [(*columns, "periods", *(f"in {period:g} s" for period in periods_s), "kB")]
    for name, solver in SOLVERS.items():
        tau_1_s = program.iteration_of(name)
        plc = PlcBudget(program.budget, tau_1_s)
        rows.append((
            name, "" if solver.paper_s is None else f"{solver.paper_s:.2f}",
            *(f"{solver.operations(one).flops / speed:.3f}" for one in sizes), f"{tau_1_s:g}", solver.default,
            str(len(plc.ladder)), *(str(plc.iterations(round(period / plc.times.tick_s))) for period in periods_s),
            f"{memory[name] / 1e3:.1f}",
        ))  # fmt: skip
    return f"seconds at P = 1, iterations done at P = {program.budget.power:.3g}\n{aligned(rows, numbers=True)}"


def _memory(
    settings: Settings, problem: PredictiveProblem, prediction: PredictionModel, memory_bytes: int
) -> str:  # fmt: skip
    program = settings.optimizer_plc.program
    estimator = estimator_memory(prediction, program.estimator, predicted_apart(program, prediction))
    trivial = PredictiveProblem(
        prediction, trivial_design(program.design), settings.limits, real_of(Arithmetic.FLOAT32), program.penalties
    )
    problems = (problem, trivial)
    footprints = [footprint(one, estimator, program.solver) for one in problems]
    names = {"hessian": "Phi", "problem": "Gamma and maps", "shift": "shift of the profile", "solver": "solver",
             "estimator": "estimator", "sequence": "sequence buffers"}  # fmt: skip
    rows = [("bytes in single precision", *(f"n = {one.size}" for one in problems))]
    rows += [(text, *(f"{getattr(one, name):,}" for one in footprints)) for name, text in names.items()]
    rows.append(("total", *(f"{one.total:,}" for one in footprints)))
    rows.append((
        f"share of {memory_bytes / 1e6:g} MB", *(f"{100 * one.total / memory_bytes:.1f} %" for one in footprints)
    ))  # fmt: skip
    return aligned(rows, numbers=True)
