"""Dense linear algebra as plain loops: the same bits on every processor, in single or double precision.

The inner loops run along rows, so that they vectorise without changing the order of any sum.
Constants and sums have the type of the arrays: a double constant would make numba compute in double.
"""

import numpy as np
from numpy.typing import NDArray

from coldloop.compiled import kernel

Array = NDArray[np.float64]


@kernel
def multiply(A: Array, B: Array) -> Array:
    """Return A B for A (n, k) and B (k, m)."""
    product = np.zeros((A.shape[0], B.shape[1]), A.dtype)
    zero = A.dtype.type(0.0)
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            factor = A[i, k]
            if factor != zero:
                for j in range(B.shape[1]):
                    product[i, j] += factor * B[k, j]
    return product


@kernel
def apply(A: Array, x: Array, result: Array) -> None:
    """Add A x to `result` for the transposed storage A (k, n), x (k), result (n)."""
    zero = A.dtype.type(0.0)
    for k in range(A.shape[0]):
        factor = x[k]
        if factor != zero:
            for j in range(A.shape[1]):
                result[j] += factor * A[k, j]


@kernel
def respond(A: Array, B: Array, F: Array, x: Array, u: Array, w: float) -> Array:
    """Return A x + B u + F w for A (n, k), B (n, m), F (n, 1)."""
    result = np.empty(A.shape[0], A.dtype)
    for i in range(A.shape[0]):
        total = F[i, 0] * w
        for j in range(A.shape[1]):
            total += A[i, j] * x[j]
        for j in range(B.shape[1]):
            total += B[i, j] * u[j]
        result[i] = total
    return result


@kernel
def cholesky(M: Array) -> None:
    """Overwrite the upper triangle of the symmetric positive definite M (n, n) by U with U' U = M."""
    n = M.shape[0]
    zero, one = M.dtype.type(0.0), M.dtype.type(1.0)
    for k in range(n):
        pivot = np.sqrt(M[k, k])
        M[k, k] = pivot
        inverse = one / pivot
        for j in range(k + 1, n):
            M[k, j] *= inverse
        for i in range(k + 1, n):
            factor = M[k, i]
            if factor != zero:
                for j in range(i, n):
                    M[i, j] -= factor * M[k, j]


@kernel
def cholesky_solve(U: Array, b: Array) -> None:
    """Overwrite b (n) by the solution of U' U x = b."""
    n = U.shape[0]
    for k in range(n):
        b[k] /= U[k, k]
        factor = b[k]
        for j in range(k + 1, n):
            b[j] -= factor * U[k, j]
    for k in range(n - 1, -1, -1):
        total = b[k]
        for j in range(k + 1, n):
            total -= U[k, j] * b[j]
        b[k] = total / U[k, k]
