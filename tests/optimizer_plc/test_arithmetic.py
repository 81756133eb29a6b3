"""Single precision: no double is computed with on line, little is lost by it, and the loop works."""

import json
from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorKind, OdeSettings
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.linear_algebra import real_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QuadraticProblem
from coldloop_optimizer_plc.settings import SINGLE_PRECISION_SOLVERS, Preset, ProgramSettings
from coldloop_optimizer_plc.solvers.ode import ode_solver
from tests.harness.processes import Processes
from tests.optimizer_plc.single_precision import code, has_double

if TYPE_CHECKING:
    from tests.optimizer_plc.conftest import Jump, PenalisedOptimum

Array = NDArray[np.float64]

SINGLE = real_of(Arithmetic.FLOAT32)

ON_LINE = {"qp.problem.instance", "qp.problem.write_inputs", "decisions.take_update", "scheme.solve"}
"""Kernels that the program calls; those that they call, solvers and rules among them, are part of their code."""


@pytest.mark.night
def test_no_kernel_computes_with_a_double_in_single_precision(processes: Processes) -> None:
    """In an interpreter of its own, which has compiled nothing for other tests: all kernels are compiled there."""
    cases = list(product(SINGLE_PRECISION_SOLVERS, EstimatorKind))
    names = [(solver.value, estimator.value) for solver, estimator in cases]
    program = f"from tests.optimizer_plc.single_precision import main; main({names})"
    called, faults = json.loads(processes.run_python(program)[0])
    assert not faults
    assert set(called) >= {f"coldloop_optimizer_plc.{name}" for name in ON_LINE}
    assert called.count("coldloop_optimizer_plc.scheme.solve") == len({solver for solver, _ in cases}), (
        "one method a solver"
    )


@numba.njit
def halved(x: NDArray[Any]) -> float:
    return float(x[0] * 0.3)


@numba.njit
def halved_twice(x: NDArray[Any]) -> float:
    return halved(x) + halved(x)


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("kernel", [halved, halved_twice])
def test_the_check_finds_a_constant_in_double(kernel: Any) -> None:  # noqa: ANN401 - numba has no types
    kernel(np.ones(1, np.float32))
    assert has_double(code(kernel, kernel.signatures[0]))


@pytest.mark.usefixtures("compiles")
def test_the_check_finds_nothing_in_single_precision() -> None:
    def halved_in_single(x: NDArray[Any]) -> Any:  # noqa: ANN401
        return x[0] * np.float32(0.3)

    kernel = numba.njit(halved_in_single)
    kernel(np.ones(1, np.float32))
    assert not has_double(code(kernel, kernel.signatures[0]))


def rounded(qp: QuadraticProblem) -> QuadraticProblem:
    arrays = (M.astype(SINGLE) for M in qp[:-1])
    return QuadraticProblem(*arrays, constant=SINGLE(qp.constant))


def test_an_instance_in_single_precision_is_that_in_double_rounded(
    model: LtiModel, problem: PredictiveProblem, situations: Callable[..., Any]
) -> None:
    program = OptimizerProgram(
        model, ProgramSettings(preset=Preset.PAPER, arithmetic=Arithmetic.FLOAT32), InputLimits()
    )
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


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("iterations", [19, *(pytest.param(n, marks=pytest.mark.night) for n in (4, 200))])
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


@pytest.mark.usefixtures("compiles")
def test_in_single_precision_the_cost_never_rises_however_long_one_iterates(harsh_jumps: "list[Jump]") -> None:
    for qp, guess in harsh_jumps[:10]:
        single = rounded(qp)
        answer = ode_solver(OdeSettings()).solve(single, guess.astype(SINGLE), range(601))
        assert (np.diff(answer.costs) <= 0.0).all()
        assert np.isfinite(answer.z).all()
        assert ((single.low <= answer.z) & (answer.z <= single.high)).all()
