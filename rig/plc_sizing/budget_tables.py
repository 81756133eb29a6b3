"""What the reference PLC can do in an updating period, and whether its memory holds the problem, as text."""

from collections.abc import Sequence

import numpy as np

from coldloop.process.lti_model import load
from coldloop.process.signals import TICK_S
from optimizer_plc.budget import PlcBudget
from optimizer_plc.computing_settings import Arithmetic
from optimizer_plc.estimator import check_detectability
from optimizer_plc.qp.arithmetic import real_of
from optimizer_plc.qp.design import N_SLACKS, trivial_design
from optimizer_plc.qp.prediction import PredictionModel
from optimizer_plc.qp.problem import PredictiveProblem
from optimizer_plc.settings import ProgramSettings
from rig.plc_sizing import operations
from rig.plc_sizing.memory import Footprint, estimator_memory, footprint
from rig.plc_sizing.operations import Operations
from rig.plc_sizing.reference_plc import (
    ACTIVE_ROWS,
    MEMORY_BYTES,
    QPOASES_ON_LAPTOP_S,
    WORKING_SET,
    SpeedCurve,
    cholesky_times,
    fitted,
    residuals,
    slow_down,
)
from rig.settings import Settings
from rig.text_tables import aligned

POWERS = (0.2, 0.4, 0.6, 1.0, 2.0, 5.0, 10.0, 25.0)
PERIODS_S = (1.0, 2.0, 3.0, 4.0, 5.0)


def budget_tables(settings: Settings, power: float | None, period_s: float | None) -> str:
    """Return the tables as text, for one power and one updating period or for several."""
    powers = POWERS if power is None else (power,)
    periods = PERIODS_S if period_s is None else (period_s,)
    program = settings.optimizer_plc.program
    prediction = PredictionModel(load(settings.model.file)).with_disturbances(program.estimator.disturbed)
    check_detectability(prediction)
    real = real_of(Arithmetic.FLOAT32)
    problem = PredictiveProblem(prediction, program.design, settings.limits, real, program.penalties)
    trivial = PredictiveProblem(prediction, trivial_design(program.design), settings.limits, real, program.penalties)
    curve = fitted(cholesky_times())
    estimator = estimator_memory(prediction, program.estimator)
    parts = [
        _speed(curve, problem.size),
        _operations(problem, prediction, curve),
        _iterations(program, powers, periods),
        _memory([footprint(one, estimator) for one in (problem, trivial)], [problem.size, trivial.size]),
    ]
    return "\n".join(parts)


def _speed(curve: SpeedCurve, size: int) -> str:
    errors = np.abs(residuals(curve, cholesky_times()))
    return (
        f"Cholesky factorisation on the PLC: {curve.c1 * 1e6:.3g} n + {curve.c2 * 1e6:.3g} n^2 "
        f"+ {curve.c3 * 1e6:.3g} n^3 us, within {100 * errors.max():.2f} % of 25 times\n"
        f"speed in loops of length {size}: {curve.flops_per_s(size) / 1e6:.3f} Mflop/s; "
        f"slow-down against the laptop: {slow_down(cholesky_times(), size):.0f}\n"
    )


def _operations(problem: PredictiveProblem, prediction: PredictionModel, curve: SpeedCurve) -> str:
    n, m, mean = problem.size, len(problem.Gamma), ACTIVE_ROWS.mean
    sizes = operations.PreparationSizes(
        n, m, m - 4 * len(problem.design.constraint_instants), problem.n_knots, prediction.n_states,
        prediction.D.shape[1], prediction.D.shape[0], segments=1, samples=1,
    )  # fmt: skip
    counts: dict[str, Operations] = {
        "ODE, no row active": operations.ode(n, m, 0),
        f"ODE, {mean:g} rows active (mean)": operations.ode(n, m, mean),
        f"ODE, {mean:g} rows active (mean), velocity kept": operations.ode_kept(n, m, mean),
        f"ODE, {ACTIVE_ROWS.worst:g} rows active (worst seen)": operations.ode(n, m, ACTIVE_ROWS.worst),
        f"ODE, all {m} rows active": operations.ode(n, m, m),
        f"qpOASES, {WORKING_SET:g} constraints held": operations.qpoases(n, m, WORKING_SET),
        "OSQP": operations.osqp(n, m),
        f"fast gradient, {mean:g} rows active": operations.fast_gradient(n, m, mean),
        "interior point": interior_point(problem),
        f"DAQP, {WORKING_SET:g} constraints held": operations.daqp(n, m, WORKING_SET),
        "preparation, once an updating period": operations.preparation(sizes, mean),
    }
    speed = curve.flops_per_s(n)
    rows = [("one iteration", "operations", "kB moved", "s at P = 1")]
    rows += [
        (name, f"{count.flops:,.0f}", f"{count.bytes / 1e3:.1f}", f"{count.flops / speed:.3f}")
        for name, count in counts.items()
    ]
    rows.append(("qpOASES, as in the paper", "", "", f"{QPOASES_ON_LAPTOP_S * slow_down(cholesky_times(), n):.3f}"))
    return aligned(rows, numbers=True)


def interior_point(problem: PredictiveProblem) -> Operations:
    """Return the operations of an iteration of the interior-point method, its J included."""
    n, m, inputs = problem.size, len(problem.Gamma), problem.n_inputs
    k = np.count_nonzero(problem.Gamma, axis=1)
    rows = operations.SparseRows(float(k.sum()), float((k * (k + 1) / 2).sum()))
    factorisation = operations.slacks_first(n, n - inputs, N_SLACKS)
    step = operations.interior_point(n, m, inputs, rows, factorisation)
    return step.plus(operations.augmented_cost(n, m, ACTIVE_ROWS.mean))


def _iterations(program: ProgramSettings, powers: Sequence[float], periods: Sequence[float]) -> str:
    """Return the iterations with the tau_1 that runs use."""
    tau_1_s = {
        "ODE": program.ode.tau_1_s,
        "qpOASES": program.qpoases.tau_1_s,
        "OSQP": program.osqp.tau_1_s,
        "fast gradient": program.fast_gradient.tau_1_s,
        "interior point": program.interior_point.tau_1_s,
        "DAQP": program.daqp.tau_1_s,
    }
    rows = [("iterations", "s", "P", *(f"tau_u {period:g} s" for period in periods))]
    for solver, seconds in tau_1_s.items():
        for power in powers:
            plc = PlcBudget(program.budget.model_copy(update={"power": power}), seconds)
            done = (str(plc.iterations(round(period / TICK_S))) for period in periods)
            rows.append((solver, f"{seconds:.3f}", f"{power:g}", *done))
    return aligned(rows, numbers=True)


def _memory(footprints: Sequence[Footprint], sizes: Sequence[int]) -> str:
    names = {"hessian": "Phi", "problem": "Gamma and maps", "shift": "shift of the profile", "solver": "ODE solver",
             "estimator": "estimator", "sequence": "sequence buffers"}  # fmt: skip
    rows = [("bytes in single precision", *(f"n = {size}" for size in sizes))]
    rows += [(text, *(f"{getattr(one, name):,}" for one in footprints)) for name, text in names.items()]
    rows.append(("total", *(f"{one.total:,}" for one in footprints)))
    rows.append(("share of 2 MB", *(f"{100 * one.total / MEMORY_BYTES:.1f} %" for one in footprints)))
    return aligned(rows, numbers=True)
