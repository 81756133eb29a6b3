"""Operations are counted by running the kernels' own Python code on numbers that count."""

import math
from typing import Any, SupportsFloat

import numpy as np
import pytest
from numpy.typing import NDArray

from optimizer_plc.computing_settings import OdeSettings
from optimizer_plc.qp import costs, linear_algebra, problem
from optimizer_plc.qp.penalties import DEFAULT_PENALTIES
from optimizer_plc.qp.problem import QuadraticProblem
from optimizer_plc.solvers import interior_point, ode
from optimizer_plc.solvers.ode import flow_in
from rig.plc_sizing import operations
from rig.plc_sizing.reference_plc import ACTIVE_ROWS, QPOASES_ON_LAPTOP_S, cholesky_times, fitted, residuals, slow_down


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
    for module in (ode, interior_point, costs, problem, linear_algebra):
        for name, value in list(vars(module).items()):
            if hasattr(value, "py_func"):
                monkeypatch.setattr(module, name, value.py_func)
    Counted.done = 0


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("n", [1, 2, 7, 20])
def test_the_cholesky_factorisation_and_solve_are_counted_right(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    M, b = counted(root @ root.T + np.eye(n)), counted(rng.normal(size=n))
    skyline = linear_algebra.cholesky(M)
    assert Counted.done == pytest.approx(operations.cholesky(n).flops)
    Counted.done = 0
    linear_algebra.cholesky_solve(M, skyline, b)
    assert Counted.done == operations.cholesky_solve(n).flops


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize(("n", "m", "active"), [(3, 5, 0), (6, 9, 2), (12, 20, 20), (49, 94, 3)])
def test_a_step_of_the_ode_solver_is_counted_right(n: int, m: int, active: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    gamma = np.where(np.arange(m) < active, -1e3, 1e3)  # far away: the same rows at all three points
    qp = QuadraticProblem(
        counted(root @ root.T + np.eye(n)), counted(rng.normal(size=n)), counted(rng.normal(size=(m, n)) * 1e-2),
        counted(gamma), np.full(n, -1e9), np.full(n, 1e9), 0.0,
    )  # fmt: skip
    constants = flow_in(OdeSettings(), DEFAULT_PENALTIES, np.float64)
    flow = ode.Flow(*(value if isinstance(value, bool) else Counted(value) for value in constants))  # type: ignore[arg-type]
    z = counted(rng.normal(size=n))
    before = [float(value) for value in z]
    constant, v, pushing = costs.matrices_of(qp), counted(np.zeros(n)), np.zeros(m)
    ode.velocity(constant, qp, z, costs.excess_by_columns(constant, qp, z), flow, v, pushing)  # type: ignore[arg-type]
    Counted.done = 0
    ode.step(constant, qp, z, v, pushing, np.zeros(m), Counted(1e30), Counted(1e-6), flow)  # type: ignore[arg-type]
    assert [float(value) for value in z] != before, "the step was accepted"
    assert Counted.done == pytest.approx(operations.ode_kept(n, m, active).flops)


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize(("knots", "chains", "inputs", "instants"), [(2, 1, 2, 3), (3, 2, 4, 5), (7, 4, 21, 14)])
def test_a_step_of_the_interior_point_method_is_counted_right(
    knots: int, chains: int, inputs: int, instants: int
) -> None:
    rng = np.random.default_rng(knots)
    slacks, m = knots * chains, instants * chains
    n = slacks + inputs
    Gamma = np.zeros((m, n))
    for row in range(m):  # an output row: all inputs, and two neighbours of one chain of slacks
        knot, chain = row // chains % (knots - 1), row % chains
        Gamma[row, [chains * knot + chain, chains * (knot + 1) + chain]] = -0.5
        Gamma[row, slacks:] = rng.uniform(0.1, 1.0, size=inputs)
    qp = QuadraticProblem(
        np.diag(rng.uniform(1.0, 2.0, size=n)), rng.normal(size=n), Gamma, np.ones(m), np.full(n, -1.0),
        np.where(np.arange(n) < slacks, np.inf, 1.0), 0.0,
    )  # fmt: skip
    constant = interior_point.structure_of(qp)
    point = interior_point.near(constant, qp.gamma, qp.low, qp.high, np.zeros(n), 1e-3, 1.0, 0.1)
    counting = constant._replace(hessian=counted(constant.hessian), Gamma=counted(constant.Gamma))
    vectors = counted(qp.phi), counted(qp.gamma), counted(qp.low), counted(qp.high)
    begun = interior_point.Point(*map(counted, point))
    Counted.done = 0
    _, moved = interior_point.step(counting, *vectors, begun, Counted(1e-3), Counted(0.0))  # type: ignore[arg-type]
    assert moved
    k = np.count_nonzero(Gamma, axis=1)
    sparse = operations.SparseRows(k.sum(), (k * (k + 1) // 2).sum())
    expected = operations.interior_point(n, m, inputs, sparse, operations.slacks_first(n, slacks, chains))
    assert Counted.done == pytest.approx(expected.flops, rel=0.02), "steps to the bounds are divided now and then"


def test_the_curve_fits_the_cholesky_times_within_a_quarter_of_a_percent() -> None:
    times = cholesky_times()
    curve = fitted(times)
    assert len(times.size) == 25
    assert np.abs(residuals(curve, times)).max() < 0.0025
    assert 0.5e6 < curve.flops_per_s(49) < 0.55e6


def test_an_ode_iteration_takes_a_quarter_of_a_second_within_15_percent() -> None:
    tau_1 = operations.ode(49, 94, ACTIVE_ROWS.mean).flops / fitted(cholesky_times()).flops_per_s(49)
    assert tau_1 == pytest.approx(0.25, rel=0.15)


def test_the_papers_route_gives_qpoases_about_half_a_second() -> None:
    assert QPOASES_ON_LAPTOP_S * slow_down(cholesky_times(), 49) == pytest.approx(0.48, rel=0.05)
