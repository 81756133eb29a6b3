from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.linear_algebra import (
    add_product,
    add_transposed_product,
    by_columns,
    cholesky,
    cholesky_solve,
    multiply,
)

Array = NDArray[Any]
Precision = type[np.float64] | type[np.float32]

seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(1, 30)
each_precision = pytest.mark.parametrize(("precision", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-4)])


def matrix(rng: np.random.Generator, rows: int, columns: int, precision: Precision = np.float64) -> Array:
    """Return a matrix some of whose elements are 0, which the kernels skip."""
    return np.asarray(rng.normal(size=(rows, columns)) * (rng.random((rows, columns)) < 0.8), dtype=precision)


@pytest.mark.usefixtures("compiles")
@each_precision
@given(n=sizes, k=sizes, m=sizes, seed=seeds)
def test_a_product_is_numpys(precision: Precision, tolerance: float, n: int, k: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = matrix(rng, n, k, precision), matrix(rng, k, m, precision)
    product = multiply(A, B)
    assert product.dtype == precision
    assert np.allclose(product, A @ B, rtol=tolerance, atol=tolerance)


@each_precision
@given(n=sizes, k=sizes, seed=seeds)
def test_applying_a_transposed_matrix_adds_to_the_result(
    precision: Precision, tolerance: float, n: int, k: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    A = matrix(rng, k, n, precision)
    x: Array = np.asarray(rng.normal(size=k), dtype=precision)
    start: Array = np.asarray(rng.normal(size=n), dtype=precision)
    result = start.copy()
    add_transposed_product(A, x, result)
    assert np.allclose(result, start + A.T @ x, rtol=tolerance, atol=tolerance)


@each_precision
@given(n=sizes, k=sizes, seed=seeds)
def test_a_product_by_columns_has_the_bits_of_the_plain_sums(
    precision: Precision, tolerance: float, n: int, k: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    A, x = matrix(rng, n, k, precision), np.asarray(rng.normal(size=k), dtype=precision)
    A[: rng.integers(0, n + 1), rng.integers(0, k)] = 0.0
    result = start = np.asarray(rng.normal(size=n), dtype=precision)
    for column, factor in zip(A.T, x, strict=True):
        result = result + factor * column
    summed = start.copy()
    add_product(by_columns(A), x, summed)
    assert summed.tobytes() == result.tobytes()
    assert np.allclose(summed, start + A @ x, rtol=tolerance, atol=tolerance)


@given(n=sizes, dense=st.integers(0, 30), seed=seeds)
def test_zeros_that_are_left_out_change_no_bit_of_the_factor(n: int, dense: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = matrix(rng, n, n)
    S = root @ root.T + n * np.eye(n)
    S[dense:, :] = S[:, dense:] = 0.0
    S += 3.0 * np.eye(n) + 0.5 * (np.eye(n, k=4) + np.eye(n, k=-4))
    U = S.copy()
    for k in range(n):  # row by row, every product computed
        U[k, k] = np.sqrt(U[k, k])
        U[k, k + 1 :] *= 1.0 / U[k, k]
        for i in range(k + 1, n):
            U[i, i:] -= U[k, i] * U[k, i:]
    found = S.copy()
    cholesky(found)
    assert np.triu(found).tobytes() == np.triu(U).tobytes()


@each_precision
@given(n=sizes, seed=seeds)
def test_the_factor_is_numpys_and_solves_its_system(precision: Precision, tolerance: float, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = matrix(rng, n, n)
    S: Array = np.asarray(root @ root.T + np.eye(n), dtype=precision)
    b: Array = np.asarray(rng.normal(size=n), dtype=precision)
    U, x = S.copy(), b.copy()
    skyline = cholesky(U)
    assert np.allclose(np.triu(U), np.linalg.cholesky(S).T, rtol=100 * tolerance, atol=100 * tolerance)
    cholesky_solve(U, skyline, x)
    residual = S.astype(np.float64) @ x - b
    assert np.abs(residual).max() <= 100 * tolerance * (1 + np.abs(x).max() * np.abs(S).max())


@given(n=sizes, seed=seeds)
def test_only_the_upper_triangle_is_read(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = matrix(rng, n, n)
    S = root @ root.T + np.eye(n)
    whole, upper = S.copy(), np.triu(S) + np.tril(np.full((n, n), np.nan), -1)
    of_whole, of_upper = cholesky(whole), cholesky(upper)
    x, y = rng.normal(size=(2, n))
    y[:] = x
    cholesky_solve(whole, of_whole, x)
    cholesky_solve(upper, of_upper, y)
    assert x.tobytes() == y.tobytes()
