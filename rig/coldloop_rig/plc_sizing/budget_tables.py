"""What the reference PLC can do in an updating period, and whether its memory holds the problem, as text."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from coldloop.process.lti_model import load
from coldloop_optimizer_plc.budget import PlcBudget
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorKind
from coldloop_optimizer_plc.estimator import check_detectability
from coldloop_optimizer_plc.plausibility import watched_output
from coldloop_optimizer_plc.qp.arithmetic import real_of
from coldloop_optimizer_plc.qp.design import ControlDesign, Target, trivial_design
from coldloop_optimizer_plc.qp.prediction import PredictionModel, prediction_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_rig.plc_sizing import operations
from coldloop_rig.plc_sizing.memory import estimator_memory, footprint, workspaces
from coldloop_rig.plc_sizing.operations import Operations
from coldloop_rig.plc_sizing.profile import PlcProfile
from coldloop_rig.plc_sizing.reference_plc import (
    ACTIVE_ROWS,
    MEMORY_BYTES,
    WORKING_SET,
    SpeedCurve,
    cholesky_times,
    reference_curve,
    residuals,
    slow_down,
)
from coldloop_rig.plc_sizing.sizes import QpSizes, dense_sizes, sizes_without_zeros
from coldloop_rig.plc_sizing.solver_counts import SOLVERS
from coldloop_rig.plc_sizing.verdict import fits, power_of, verdict
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import aligned

SHARES: Final = (0.2, 0.5, 1.0)
"""Of a sampling period: updating periods that are shown."""
SOLVER_COLUMNS = ("solver", "paper s", "dense s", "without zeros s", "tau_1_s", "default follows")


class CountedSizes(NamedTuple):
    """The sizes of a problem, counted in both ways."""

    dense: QpSizes
    without_zeros: QpSizes


def budget_tables(settings: Settings, period_s: float | None, executed: Callable[[PredictiveProblem], str]) -> str:
    """Return the tables as text, for the configured power and one updating period or several.

    Args:
        settings: Of the optimiser.
        period_s: One updating period, or None for several.
        executed: Returns what an iteration as exported takes.
    """
    problem, prediction = problem_of(settings)
    program = settings.optimizer_plc.program
    limited, apart = program.cold_end.approach_k > 0.0, predicted_apart(program, prediction)
    return "\n".join([
        _speed(reference_curve(), problem.size),
        _operations(problem, prediction, apart, limited=limited) + executed(problem),
        _iterations(program, problem, period_s),
        _memory(settings, problem, prediction, MEMORY_BYTES),
    ])  # fmt: skip


def plc_tables(
    settings: Settings, period_s: float | None, profile: PlcProfile, costs: Callable[[Settings], str]
) -> str:
    """Return what a PLC can do as text: a sentence, what updating periods cost there, and the tables that differ.

    Args:
        settings: With any power: it becomes this PLC's.
        period_s: One updating period, or None for several.
        profile: The PLC.
        costs: Returns a sentence or nothing; it is asked where the controller runs there.
    """
    problem, prediction = problem_of(settings)
    settings = with_power(settings, power_of(profile, problem.size))
    program = settings.optimizer_plc.program
    apart = predicted_apart(program, prediction)
    needed = footprint(problem, estimator_memory(prediction, program.estimator, apart), program.solver)
    sentences = [verdict(profile, program, problem, needed)]
    if fits(profile, program, problem, needed):
        sentences += [costs(settings)]
    speed = (
        f"\nP = {program.budget.power:.3g}, {profile.flops_per_s(problem.size) / 1e6:.3g} Mflop/s in loops of length "
        f"{problem.size}: {profile.source}\n"
        f"for a run there: --set optimizer_plc.program.budget.power={program.budget.power:.4g}\n"
    )
    return "\n".join([
        *filter(None, sentences),
        speed,
        _iterations(program, problem, period_s),
        _memory(settings, problem, prediction, profile.memory_bytes),
    ])  # fmt: skip


def problem_of(settings: Settings) -> tuple[PredictiveProblem, PredictionModel]:
    """Return the configured problem in single precision, and the model it is made from."""
    program = settings.optimizer_plc.program
    prediction = prediction_of(load(settings.model.file), program.estimator.disturbed, program.design)
    check_detectability(prediction)
    return _problem(settings, prediction, program.design), prediction


def _problem(settings: Settings, prediction: PredictionModel, design: ControlDesign) -> PredictiveProblem:
    penalties = settings.optimizer_plc.program.penalties
    return PredictiveProblem(prediction, design, settings.limits, real_of(Arithmetic.FLOAT32), penalties)


def with_power(settings: Settings, power: float) -> Settings:
    """Return the settings for a PLC of this power."""
    return settings.with_program(budget=settings.optimizer_plc.program.budget.model_copy(update={"power": power}))


def counted_sizes(problem: PredictiveProblem) -> CountedSizes:
    """Return the sizes of a problem, counted in both ways."""
    return CountedSizes(
        dense_sizes(problem.size, len(problem.Gamma), problem.n_inputs),
        sizes_without_zeros(problem.Phi, problem.Gamma, np.isfinite(problem.maps.high)),
    )


def _speed(curve: SpeedCurve, size: int) -> str:
    errors = np.abs(residuals(curve, cholesky_times()))
    return (
        f"Cholesky factorisation on the PLC: {curve.c1 * 1e6:.3g} n + {curve.c2 * 1e6:.3g} n^2 "
        f"+ {curve.c3 * 1e6:.3g} n^3 us, within {100 * errors.max():.2f} % of 25 times\n"
        f"speed in loops of length {size}: {curve.flops_per_s(size) / 1e6:.3f} Mflop/s; "
        f"slow-down against the laptop: {slow_down(cholesky_times(), size):.0f}\n"
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
        f"qpoases, {WORKING_SET:g} constraints held": SOLVERS[SolverName.QPOASES].operations,
        "osqp": SOLVERS[SolverName.OSQP].operations,
        f"fast-gradient, {mean:g} rows active": SOLVERS[SolverName.FAST_GRADIENT].operations,
        "interior-point": SOLVERS[SolverName.INTERIOR_POINT].operations,
        f"daqp, {WORKING_SET:g} constraints held": SOLVERS[SolverName.DAQP].operations,
    }
    rows: list[tuple[str, ...]] = [("one iteration", "operations", "without zeros", "kB moved", "without zeros")]
    for name, count in variants.items():
        both = count(dense), count(without_zeros)
        rows.append((name, *(f"{one.flops:,.0f}" for one in both), *(f"{one.bytes / 1e3:.1f}" for one in both)))
    sizes = operations.PreparationSizes(
        dense, m - 4 * len(problem.design.constraint_instants), problem.n_knots, prediction.n_states,
        prediction.D.shape[1], prediction.D.shape[0], segments=1, samples=1,
        targets=problem.design.target is not Target.OPERATING_POINT, limited=limited, apart=apart,
    )  # fmt: skip
    once = operations.preparation(sizes, mean)
    rows.append(("preparation, once an updating period", f"{once.flops:,.0f}", "", f"{once.bytes / 1e3:.1f}", ""))
    return aligned(rows, numbers=True)


def solver_table(
    program: ProgramSettings, problem: PredictiveProblem, periods_s: Sequence[float]
) -> list[tuple[str, ...]]:  # fmt: skip
    """Return, solver by solver, times of an iteration at P = 1, periods of the ladder, iterations in some, and memory.

    The first row is the header.
    """
    sizes, speed = counted_sizes(problem), reference_curve().flops_per_s(problem.size)
    memory = workspaces(problem.size, len(problem.Gamma))
    rows: list[tuple[str, ...]] = [(*SOLVER_COLUMNS, "periods", *(f"in {period:g} s" for period in periods_s), "kB")]
    for name, solver in SOLVERS.items():
        tau_1_s = solver.tau_1_s(program)
        plc = PlcBudget(program.budget, tau_1_s)
        rows.append((
            name, "" if solver.paper_s is None else f"{solver.paper_s:.2f}",
            *(f"{solver.operations(one).flops / speed:.3f}" for one in sizes), f"{tau_1_s:g}", solver.default,
            str(len(plc.ladder)), *(str(plc.iterations(round(period / plc.times.tick_s))) for period in periods_s),
            f"{memory[name] / 1e3:.1f}",
        ))  # fmt: skip
    return rows


def _iterations(program: ProgramSettings, problem: PredictiveProblem, period_s: float | None) -> str:
    longest_s = program.process.sampling_period_s
    periods_s = [share * longest_s for share in SHARES] if period_s is None else [period_s]
    table = solver_table(program, problem, periods_s)
    return f"seconds at P = 1, iterations done at P = {program.budget.power:.3g}\n{aligned(table, numbers=True)}"


def _memory(
    settings: Settings, problem: PredictiveProblem, prediction: PredictionModel, memory_bytes: int
) -> str:  # fmt: skip
    program = settings.optimizer_plc.program
    estimator = estimator_memory(prediction, program.estimator, predicted_apart(program, prediction))
    problems = (problem, _problem(settings, prediction, trivial_design(program.design)))
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
