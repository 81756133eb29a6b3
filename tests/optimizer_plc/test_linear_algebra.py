import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optimizer_plc.linear_algebra import apply, cholesky, cholesky_solve, multiply

seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(1, 30)
each_precision = pytest.mark.parametrize(("precision", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-4)])


def matrix(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return a matrix some of whose elements are 0, which the kernels skip."""
    return rng.normal(size=(rows, columns)) * (rng.random((rows, columns)) < 0.8)


@each_precision
@settings(max_examples=60, deadline=None)
@given(n=sizes, k=sizes, m=sizes, seed=seeds)
def test_a_product_is_numpys(precision: type, tolerance: float, n: int, k: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = matrix(rng, n, k).astype(precision), matrix(rng, k, m).astype(precision)
    product = multiply(A, B)
    assert product.dtype == precision
    assert np.allclose(product, A @ B, rtol=tolerance, atol=tolerance)


@each_precision
@settings(max_examples=60, deadline=None)
@given(n=sizes, k=sizes, seed=seeds)
def test_applying_a_transposed_matrix_adds_to_the_result(
    precision: type, tolerance: float, n: int, k: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    A, x, start = (part.astype(precision) for part in (matrix(rng, k, n), rng.normal(size=k), rng.normal(size=n)))
    result = start.copy()
    apply(A, x, result)
    assert np.allclose(result, start + A.T @ x, rtol=tolerance, atol=tolerance)


@each_precision
@settings(max_examples=60, deadline=None)
@given(n=sizes, seed=seeds)
def test_the_factor_is_numpys_and_solves_its_system(precision: type, tolerance: float, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = matrix(rng, n, n)
    S = (root @ root.T + np.eye(n)).astype(precision)
    b = rng.normal(size=n).astype(precision)
    U, x = S.copy(), b.copy()
    cholesky(U)
    assert np.allclose(np.triu(U), np.linalg.cholesky(S).T, rtol=100 * tolerance, atol=100 * tolerance)
    cholesky_solve(U, x)
    residual = S.astype(np.float64) @ x - b
    assert np.abs(residual).max() <= 100 * tolerance * (1 + np.abs(x).max() * np.abs(S).max())


@settings(max_examples=30, deadline=None)
@given(n=sizes, seed=seeds)
def test_only_the_upper_triangle_is_read(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = matrix(rng, n, n)
    S = root @ root.T + np.eye(n)
    whole, upper = S.copy(), np.triu(S) + np.tril(np.full((n, n), np.nan), -1)
    cholesky(whole)
    cholesky(upper)
    x, y = rng.normal(size=(2, n))
    y[:] = x
    cholesky_solve(whole, x)
    cholesky_solve(upper, y)
    assert x.tobytes() == y.tobytes()
