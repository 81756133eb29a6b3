"""Operations are counted by running the kernels' own Python code on numbers that count."""

import math
from typing import Any, SupportsFloat

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from coldloop_optimizer_plc.computing_settings import OdeSettings
from coldloop_optimizer_plc.qp import costs, linear_algebra
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QuadraticProblem
from coldloop_optimizer_plc.settings import PenaltySettings, SolverName
from coldloop_optimizer_plc.solvers import fast_gradient, interior_point, ode
from coldloop_optimizer_plc.solvers.ode import flow_in
from coldloop_rig.plc_sizing import operations
from coldloop_rig.plc_sizing.operations import ACTIVE_ROWS, SOLVERS, Pattern, QpSizes, dense_sizes, sizes_without_zeros
from coldloop_rig.plc_sizing.plc import QPOASES_ON_LAPTOP_S, cholesky_times, reference_curve, residuals, slow_down


class Counted:
    """A number whose arithmetic is counted, as the convention of `operations` has it."""

    done = 0

    def __init__(self, value: float) -> None:
        self.value = float(value)

    def _binary(self, value: float) -> "Counted":
        Counted.done += 1
        return Counted(value)

    def __add__(self, other: SupportsFloat) -> "Counted":
        return self._binary(self.value + float(other))

    def __sub__(self, other: SupportsFloat) -> "Counted":
        if isinstance(other, np.ndarray):
            return NotImplemented  # element by element
        return self._binary(self.value - float(other))

    def __rsub__(self, other: SupportsFloat) -> "Counted":
        return self._binary(float(other) - self.value)

    def __mul__(self, other: SupportsFloat) -> "Counted":
        if isinstance(other, np.ndarray):
            return NotImplemented  # element by element
        return self._binary(self.value * float(other))

    def __truediv__(self, other: SupportsFloat) -> "Counted":
        return self._binary(self.value / float(other))

    def __rtruediv__(self, other: SupportsFloat) -> "Counted":
        return self._binary(float(other) / self.value)

    def __pow__(self, other: SupportsFloat) -> "Counted":
        return self._binary(self.value ** float(other))

    __radd__, __rmul__ = __add__, __mul__

    def sqrt(self) -> "Counted":
        return self._binary(math.sqrt(self.value))

    def __neg__(self) -> "Counted":
        return Counted(-self.value)

    def __abs__(self) -> "Counted":
        return Counted(abs(self.value))

    def __float__(self) -> float:
        return self.value

    def __bool__(self) -> bool:
        return self.value != 0.0

    def __lt__(self, other: SupportsFloat) -> bool:
        return self.value < float(other)

    def __gt__(self, other: SupportsFloat) -> bool:
        return self.value > float(other)

    def __le__(self, other: SupportsFloat) -> bool:
        return self.value <= float(other)

    def __ge__(self, other: SupportsFloat) -> bool:
        return self.value >= float(other)

    def __eq__(self, other: object) -> bool:
        return self.value == float(other)  # type: ignore[arg-type]

    __hash__ = None  # type: ignore[assignment]


def counted(array: NDArray[np.float64]) -> NDArray[Any]:
    return np.vectorize(Counted, otypes=[object])(array)


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let kernels call each other's Python code."""
    for module in (ode, fast_gradient, interior_point, costs, linear_algebra):
        for name, value in list(vars(module).items()):
            if hasattr(value, "py_func"):
                monkeypatch.setattr(module, name, value.py_func)
    Counted.done = 0


def numbers(seed: int, pattern: Pattern) -> NDArray[np.float64]:
    return np.where(pattern, np.random.default_rng(seed).uniform(0.1, 1.0, size=pattern.shape), 0.0)


def convex(pattern: Pattern) -> NDArray[np.float64]:
    root = numbers(len(pattern), pattern)
    return root + root.T + 2.0 * len(pattern) * np.eye(len(pattern))


def full(n: int, m: int) -> tuple[Pattern, Pattern]:
    return np.ones((n, n), bool), np.ones((m, n), bool)


def blocks(count: int, size: int, rows: int) -> tuple[Pattern, Pattern]:
    """Blocks on the diagonals of Phi and Gamma, a row's a variable short: the kernels leave each of these zeros out."""
    within = np.ones((rows, size), bool)
    within[: rows // 2, -1] = within[rows // 2 :, 0] = False
    blocks = np.eye(count, dtype=bool)
    return np.kron(blocks, np.ones((size, size), bool)), np.kron(blocks, within)


PATTERNS = [full(3, 5), full(6, 9), full(49, 94), blocks(2, 4, 3), blocks(5, 3, 4)]


def sizes_of(Phi: Pattern, Gamma: Pattern, bounded: int) -> QpSizes:
    return sizes_without_zeros(Phi.astype(float), Gamma.astype(float), np.arange(len(Phi)) >= len(Phi) - bounded)


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("n", [1, 2, 7, 20])
def test_the_cholesky_factorisation_and_solve_are_counted_right(n: int) -> None:
    M, b = counted(convex(np.ones((n, n), bool))), counted(np.ones(n))
    skyline = linear_algebra.cholesky(M)
    assert Counted.done == pytest.approx(operations.dense_cholesky(n).flops)
    assert Counted.done == pytest.approx(n**3 / 3 + n**2 / 2 + 7 * n / 6)
    Counted.done = 0
    linear_algebra.cholesky_solve(M, skyline, b)
    assert Counted.done == operations.cholesky_solve(np.arange(n)).flops == 2 * n**2


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("active", [0, 2])
@pytest.mark.parametrize(("Phi", "Gamma"), PATTERNS)
def test_a_step_of_the_ode_solver_is_counted_right(Phi: Pattern, Gamma: Pattern, active: int) -> None:
    n, m = len(Phi), len(Gamma)
    gamma = np.where(np.arange(m) < active, -1e3, 1e3)  # far away: the same rows at all three points
    assert ode_step(convex(Phi), numbers(m, Gamma) * 1e-2, gamma) == pytest.approx(
        operations.ode_kept(sizes_of(Phi, Gamma, n), active).flops
    )


def ode_step(Phi: NDArray[np.float64], Gamma: NDArray[np.float64], gamma: NDArray[np.float64]) -> int:
    """Return the operations of a step that is accepted, after another one."""
    n, m, rng = len(Phi), len(Gamma), np.random.default_rng(1)
    qp = QuadraticProblem(
        counted(Phi), counted(rng.normal(size=n)), counted(Gamma), counted(gamma), np.full(n, -1e9), np.full(n, 1e9),
        0.0,
    )  # fmt: skip
    constants = flow_in(OdeSettings(), PenaltySettings(), np.float64)
    flow = ode.Flow(*(value if isinstance(value, bool) else Counted(value) for value in constants))  # type: ignore[arg-type]
    z = counted(rng.normal(size=n) * 1e-2)
    before = [float(value) for value in z]
    constant, v, pushing = costs.matrices_of(qp), counted(np.zeros(n)), np.zeros(m)
    ode.velocity(constant, qp, z, costs.excess_by_columns(constant, qp, z), flow, v, pushing)
    Counted.done = 0
    ode.step(constant, qp, z, v, pushing, np.zeros(m), Counted(1e30), Counted(1e-9), flow)  # type: ignore[arg-type]
    assert [float(value) for value in z] != before, "the step was accepted"
    return Counted.done


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("active", [0, 2])
@pytest.mark.parametrize(("Phi", "Gamma"), PATTERNS)
def test_a_step_of_the_fast_gradient_method_is_counted_right(Phi: Pattern, Gamma: Pattern, active: int) -> None:
    gamma = np.where(np.arange(len(Gamma)) < active, -1e3, 1e3)
    assert fast_gradient_step(convex(Phi), numbers(3, Gamma) * 1e-2, gamma) == pytest.approx(
        operations.fast_gradient(sizes_of(Phi, Gamma, len(Phi)), active).flops
    )


def fast_gradient_step(Phi: NDArray[np.float64], Gamma: NDArray[np.float64], gamma: NDArray[np.float64]) -> int:
    """Return the operations of a step that does not restart."""
    n = len(Phi)
    qp = QuadraticProblem(
        counted(Phi), counted(np.ones(n)), counted(Gamma), counted(gamma), np.full(n, -1e9), np.full(n, 1e9), 0.0
    )
    z = counted(np.zeros(n))
    constant, steps = costs.matrices_of(qp), counted(np.full(n, 1e-6))
    Counted.done = 0
    method = fast_gradient.FastGradientMethod(constant, steps, Counted(1.0), adaptive_restart=True)  # type: ignore[arg-type]
    fast_gradient.descend(method, qp, z, z.copy(), counted(np.ones(1)), 1)
    return Counted.done


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize(("Phi", "Gamma"), PATTERNS)
def test_a_step_of_the_interior_point_method_is_counted_right(Phi: Pattern, Gamma: Pattern) -> None:
    n, bounded = len(Phi), len(Phi) // 2
    code = sizes_of(Phi, Gamma, bounded)._replace(Phi=n * n)  # which multiplies by the zeros of Phi
    expected = operations.interior_point(code, 0).flops - operations.augmented_cost(code, 0).flops
    done = interior_point_step(convex(Phi), numbers(2, Gamma), bounded)
    assert done == pytest.approx(expected, rel=0.02), "steps to the bounds are divided now and then"


def interior_point_step(Phi: NDArray[np.float64], Gamma: NDArray[np.float64], bounded: int) -> int:
    """Return the operations of a step, without J; the last variables have an upper bound."""
    m, n = Gamma.shape
    high = np.where(np.arange(n) < n - bounded, np.inf, 1.0)
    qp = QuadraticProblem(Phi, np.ones(n), Gamma, np.ones(m), np.full(n, -1.0), high, 0.0)
    constant = interior_point.structure_of(qp)
    point = interior_point.near(constant, qp.gamma, qp.low, qp.high, np.zeros(n), 1e-3, 1.0, 0.1)
    counting = constant._replace(hessian=counted(constant.hessian), Gamma=counted(constant.Gamma))
    vectors = counted(qp.phi), counted(qp.gamma), counted(qp.low), counted(qp.high)
    begun = interior_point.Point(*map(counted, point))
    Counted.done = 0
    _, moved = interior_point.step(counting, *vectors, begun, Counted(1e-3), Counted(0.0))  # type: ignore[arg-type]
    assert moved
    return Counted.done


def test_sizes_and_operations_by_hand() -> None:
    """Inputs u1 and u2, slacks s1 and s2, eliminated first: s1 is coupled with s2 and u1, which fills in (s2, u1)."""
    Phi = np.array([[2.0, 1.0, 0.0, 0.0], [1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 1.0], [0.0, 0.0, 1.0, 2.0]])
    Gamma = np.array([[1.0, 0.0, -1.0, 0.0], [-1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    sizes = sizes_without_zeros(Phi, Gamma, np.array([True, True, False, False]))
    assert (sizes.n, sizes.m, sizes.bounded, sizes.Phi, sizes.Gamma, sizes.outer) == (4, 3, 2, 8, 5, 3 + 3 + 1)
    assert sizes.factor.tolist() == [2, 1, 1, 0]
    assert sizes.transformed == (2 + 1) + (2 + 1) + (4 + 2 + 1)
    assert operations.cholesky(sizes.factor).flops == (2 + 2 + 6) + 2 * (2 + 1 + 2) + 2
    assert operations.cholesky_solve(sizes.factor).flops == 2 * (4 + 2 * 4)
    assert operations.augmented_cost(sizes, 1).flops == 2 * 8 + 2 * 5 + 2 * 4 + 2 * 1 + 2
    assert operations.osqp(sizes).flops == 4 * (5 + 4 + 4) + (4 + 7) + 5 * 4 + 14 * 7
    products = 2 * 2 * 16 + 2 * 8 + 2 * 5 + 2 * 4  # with Q twice, Phi, Gamma, and a column of Q
    assert operations.qpoases(sizes, 1).flops == products + 2 * 1 + 2 * 9 + 2 * 7 + 6 * (3 * 4 + (1 + 9) / 2)
    assert operations.daqp(sizes, 1).flops == pytest.approx(2 * (2 * 13 / 7) + 1 + 2 + 4 + 2 * 13)


def test_a_dense_problem_has_all_elements() -> None:
    sizes = dense_sizes(3, 2, 1)
    assert (sizes.bounded, sizes.Phi, sizes.Gamma, sizes.outer, sizes.transformed) == (1, 9, 6, 2 * 6, 6 + 6)
    assert sizes.factor.tolist() == [2, 1, 0]


def test_the_factors_of_the_papers_problem_have_the_elements_that_are_counted(problem: PredictiveProblem) -> None:
    sizes = sizes_without_zeros(problem.Phi, problem.Gamma, np.arange(problem.size) < problem.n_inputs)
    order = np.roll(np.arange(problem.size), -problem.n_inputs)
    Phi, Gamma = problem.Phi[np.ix_(order, order)], problem.Gamma[:, order]
    assert np.count_nonzero(np.linalg.cholesky(Phi + Gamma.T @ Gamma)) == sizes.factor.sum() + sizes.n
    inverse = solve_triangular(np.linalg.cholesky(Phi).T, np.eye(problem.size))
    assert np.count_nonzero(inverse) + np.count_nonzero(Gamma @ inverse) == sizes.transformed


@pytest.mark.usefixtures("plain")
def test_our_code_leaves_some_zeros_of_the_papers_problem_out(problem: PredictiveProblem) -> None:
    """Its own operations are on the page (`docs/budget.md`)."""
    n, m, active = problem.size, len(problem.Gamma), [20, 44, 61]
    sizes = sizes_without_zeros(problem.Phi, problem.Gamma, np.arange(n) < problem.n_inputs)
    dense, gamma = dense_sizes(n, m, problem.n_inputs), np.full(m, 1e6)
    gamma[active] = -1e6
    order = np.roll(np.arange(n), -problem.n_inputs)
    cost = operations.augmented_cost(dense, ACTIVE_ROWS.mean).flops  # in which all zeros are counted
    inner = interior_point_step(problem.Phi[np.ix_(order, order)], problem.Gamma[:, order], problem.n_inputs)
    executed = {
        "ode": ode_step(problem.Phi, problem.Gamma, gamma),
        "fast-gradient": fast_gradient_step(problem.Phi, problem.Gamma, gamma),
        "interior-point": inner + cost,
    }
    assert executed == pytest.approx({"ode": 36_571, "fast-gradient": 5_081, "interior-point": 78_769}, rel=1e-3)
    for name, count in executed.items():
        least, most = (SOLVERS[SolverName(name)].operations(one).flops for one in (sizes, dense))
        assert least < count < most, name


def test_the_curve_fits_the_cholesky_times_within_a_quarter_of_a_percent() -> None:
    times = cholesky_times()
    curve = reference_curve()
    assert len(times.size) == 25
    assert np.abs(residuals(curve, times)).max() < 0.0025
    assert 0.5e6 < curve.flops_per_s(49) < 0.55e6


def test_an_ode_iteration_takes_a_quarter_of_a_second_within_15_percent() -> None:
    tau_1 = operations.ode(dense_sizes(49, 94, 21), ACTIVE_ROWS.mean).flops / reference_curve().flops_per_s(49)
    assert tau_1 == pytest.approx(0.25, rel=0.15)


def test_the_papers_route_gives_qpoases_about_half_a_second() -> None:
    assert QPOASES_ON_LAPTOP_S * slow_down(cholesky_times(), 49) == pytest.approx(0.48, rel=0.05)
