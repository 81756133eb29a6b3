"""Single precision: no double is computed with on line, little is lost by it, and the loop works."""

import importlib
import pkgutil
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

import optimizer_plc
from coldloop.limits import InputLimits
from coldloop.lti_model import LtiModel
from coldloop.registers.control_plc import Update, Verdict
from optimizer_plc.arithmetic import real_of
from optimizer_plc.computing_settings import Arithmetic, EstimatorKind, EstimatorSettings, OdeSettings
from optimizer_plc.costs import augmented_cost
from optimizer_plc.problem import PredictiveProblem, QuadraticProblem
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.settings import SINGLE_PRECISION_SOLVERS, ProgramSettings, SolverName
from optimizer_plc.solvers.ode import ode_solver

if TYPE_CHECKING:
    from tests.optimizer_plc.conftest import Jump, PenalisedOptimum

Array = NDArray[np.float64]

SINGLE = real_of(Arithmetic.FLOAT32)

ROWS = "array(float32, 2d, C)"
ON_LINE = {
    "add_product", "add_transposed_product", "assess", "augmented_cost", "cholesky", "cholesky_solve", "correct",
    "corrected", "cost_with_excess", "decide", "decouple", "deliver", "descend", "deviation_cost",
    "excess_by_columns", "follow", "gradient", "gradient_with_excess", "hold_at_bounds", "inputs_of", "instance",
    "is_far", "largest_violation", "plan", "pose", "positive_squares", "predict", "predicted_indicators",
    "problem_at", "quadratic_cost", "respond", "row_excess", "shifted", "solve", "stage_matrix", "step", "velocity",
    "violation_cost", "warm_start", "with_floor", "write_rows",
}  # fmt: skip


def kernels() -> dict[str, Any]:
    found = {}
    for info in pkgutil.walk_packages(optimizer_plc.__path__, "optimizer_plc."):
        if not info.name.endswith("__main__"):
            module = importlib.import_module(info.name)
            own = (value for value in vars(module).values() if isinstance(value, Dispatcher))
            found |= {f"{value.py_func.__module__}.{value.py_func.__name__}": value for value in own}
    return found


def body(kernel: Dispatcher, signature: tuple[Any, ...]) -> str:
    """Return the LLVM code of a kernel for a signature, without the wrapper that turns its results into Python's."""
    fresh = numba.njit(error_model="numpy")(kernel.py_func)
    fresh.compile(signature)
    functions = fresh.inspect_llvm(fresh.signatures[0]).split("\ndefine ")[1:]
    own = [text for text in functions if "cpython" not in text.split("(")[0] and "cfunc" not in text.split("(")[0]]
    assert own
    return "\n".join(own)


def in_single(types: str) -> bool:
    """Tell whether a kernel was compiled for single precision; the rows of a sequence are single in either."""
    return "float32" in types.replace(ROWS, "") or ("float32" in types and "float64" not in types)


def compiled_in_single() -> set[tuple[str, str]]:
    return {
        (name, str(signature))
        for name, kernel in kernels().items()
        for signature in kernel.signatures
        if in_single(str(signature))
    }


def single_program(
    model: LtiModel, kind: EstimatorKind = EstimatorKind.KALMAN, solver: SolverName = SolverName.ODE
) -> OptimizerProgram:
    chosen = ProgramSettings(arithmetic=Arithmetic.FLOAT32, estimator=EstimatorSettings(kind=kind), solver=solver)
    return OptimizerProgram(model, chosen, InputLimits())


def update_twice(program: OptimizerProgram, model: LtiModel) -> None:
    """Answer two updates of a plant that is away from its operating point."""
    u, y, x = (tuple(values.tolist()) for values in (model.u0 + 1.0, model.y0 * 1.01, model.x0 * 1.01))
    program.restart(0.0)
    for number, tick in enumerate((0, 10)):
        program.plan(Update(number, tick, 0, number, load=model.w0 + 100.0, u_before=u, u=u, y=y, x=x))
        program.solve()
        program.report(Verdict.NONE)


@pytest.mark.slow
def test_no_kernel_computes_with_a_double_in_single_precision(model: LtiModel) -> None:
    for kind in EstimatorKind:
        update_twice(single_program(model, kind), model)
    for solver in SINGLE_PRECISION_SOLVERS:
        update_twice(single_program(model, solver=solver), model)
    checked: set[tuple[str, str]] = set()
    while unchecked := compiled_in_single() - checked:  # compiling a kernel afresh brings up those it calls
        for name, types in unchecked:
            kernel = kernels()[name]
            signature = next(one for one in kernel.signatures if str(one) == types)
            assert "float64" not in types, f"{name} is called with both types: {types}"
            assert not re.search(r"\bdouble\b", body(kernel, signature)), f"{name} computes with a double"
        checked |= unchecked
    assert {name.rpartition(".")[2] for name, _ in checked} >= ON_LINE, "other tests may have compiled more"


def test_the_check_finds_a_constant_in_double() -> None:
    def halved(x: NDArray[Any]) -> float:
        return float(x[0] * 0.3)

    kernel = numba.njit(halved)
    kernel(np.ones(1, np.float32))
    assert re.search(r"\bdouble\b", body(kernel, kernel.signatures[0]))


def rounded(qp: QuadraticProblem) -> QuadraticProblem:
    arrays = (M.astype(SINGLE) for M in qp[:-1])
    return QuadraticProblem(*arrays, constant=SINGLE(qp.constant))


def test_an_instance_in_single_precision_is_that_in_double_rounded(
    model: LtiModel, problem: PredictiveProblem, situations: Callable[..., Any]
) -> None:
    program = single_program(model)
    single = program.problem
    rng = np.random.default_rng(21)
    for _ in range(20):
        situation = situations(rng)
        cast = situation._replace(
            x=situation.x.astype(SINGLE), w=SINGLE(situation.w), u_before=situation.u_before.astype(SINGLE)
        )
        exact, rough = problem.at(situation), single.at(cast)
        for one, other in zip(exact, rough, strict=True):
            assert np.asarray(other).dtype == np.float32
            finite = np.isfinite(one)
            scale = np.abs(np.asarray(one)[finite]).max()
            assert np.allclose(one, other, rtol=1e-5, atol=3e-6 * scale)


def loss(qp: QuadraticProblem, guess: Array, iterations: int, best: float) -> tuple[float, float]:
    """Return how far above the optimum double and single precision end, both judged in double, relative to it."""
    alpha = OdeSettings().alpha
    ends = []
    for one, start in ((qp, guess), (rounded(qp), guess.astype(SINGLE))):
        z = ode_solver(OdeSettings()).solve(one, start, (iterations,)).z
        assert z.dtype == one.phi.dtype
        whole = np.clip(z.astype(np.float64), qp.low, qp.high)
        ends.append(augmented_cost(qp, whole, alpha) + qp.constant)
    return (ends[0] - best) / best, (ends[1] - best) / best


@pytest.mark.parametrize("iterations", [4, 19, 200])
def test_after_harsh_load_jumps_single_precision_loses_little(
    harsh_jumps: "list[Jump]", penalised_optimum: "PenalisedOptimum", iterations: int
) -> None:
    alpha = OdeSettings().alpha
    losses = []
    for qp, guess in harsh_jumps:
        best = augmented_cost(qp, penalised_optimum(qp, alpha), alpha) + qp.constant
        losses.append(loss(qp, guess, iterations, best))
    double, single = np.array(losses).T
    extra = single - double  # of either sign: a row that becomes active a step earlier changes the whole path
    assert abs(np.median(extra)) < 1e-3
    assert single.mean() < 1.2 * double.mean() + 0.03


def test_in_single_precision_the_cost_never_rises_however_long_one_iterates(harsh_jumps: "list[Jump]") -> None:
    for qp, guess in harsh_jumps[:10]:
        single = rounded(qp)
        answer = ode_solver(OdeSettings()).solve(single, guess.astype(SINGLE), range(601))
        assert (np.diff(answer.costs) <= 0.0).all()
        assert np.isfinite(answer.z).all()
        assert ((single.low <= answer.z) & (answer.z <= single.high)).all()
