"""The floating-point type of what is computed on line, and dense linear algebra in it as plain loops.

The PLC of the paper has single precision only. What is computed off line (maps, gains, transitions) is computed in
double precision and rounded once; everything that depends on a measurement is computed in the chosen type.

Loops give the same bits on every processor. The inner ones run along rows, so that they vectorise without changing the
order of any sum. Constants and sums have the type of the arrays: a double constant would make numba compute in double.
Indices that begin elsewhere than at 0 are unsigned: numba then knows that they do not count from the end.
"""

from typing import NamedTuple, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.computing_settings import Arithmetic

Real: TypeAlias = type[np.float64]
"""The scalar type in use. Annotations say double for either type: kernels are compiled for the type they are given."""
DOUBLE: Real = np.float64
Array = NDArray[np.float64]
Indices = NDArray[np.uint64]
T = TypeVar("T")


def real_of(arithmetic: Arithmetic) -> Real:
    """Return the scalar type of an arithmetic."""
    return cast("Real", np.float32) if arithmetic is Arithmetic.FLOAT32 else DOUBLE


def rounded(value: T, real: Real) -> T:
    """Return a float, an array of floats, or a named tuple of these and others, in a type; arrays are contiguous."""
    if isinstance(value, tuple):
        return cast("T", type(value)(*(rounded(part, real) for part in value)))
    if isinstance(value, np.ndarray):
        return cast("T", np.ascontiguousarray(value, real if value.dtype.kind == "f" else None))
    return cast("T", real(value) if isinstance(value, float | np.floating) else value)


class Columns(NamedTuple):
    """A constant matrix A (n, k), stored so that A x is a sum of columns, the zeros at their ends left out.

    transposed (k, n) has the columns of A as rows; first and end (k,) are the indices of the first element of each
    column that is not zero, and of the one behind the last.
    """

    transposed: Array
    first: Indices
    end: Indices


def by_columns(A: Array) -> Columns:
    """Return a matrix (n, k) stored by columns."""
    transposed = np.ascontiguousarray(A.T)
    first, end = np.zeros((2, len(transposed)), np.uint64)
    for j, column in enumerate(transposed):
        found = np.flatnonzero(column)
        if len(found):
            first[j], end[j] = found[0], found[-1] + 1
    return Columns(transposed, first, end)


@kernel
def add_product(A: Columns, x: Array, result: Array) -> None:
    """Add A x to `result` (n,), for x (k,): gemv; each element is summed in the order of the columns."""
    for j in range(x.shape[0]):
        factor = x[j]
        for i in range(A.first[j], A.end[j]):
            result[i] += factor * A.transposed[j, i]


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
def add_transposed_product(A: Array, x: Array, result: Array) -> None:
    """Add A' x to `result` (n,), for A (k, n) and x (k,): gemv with a transposed matrix; zeros of x are skipped."""
    zero = A.dtype.type(0.0)
    for k in range(A.shape[0]):
        factor = x[k]
        if factor != zero:
            for j in range(A.shape[1]):
                result[j] += factor * A[k, j]


@kernel
def respond(A: Array, B: Array, F: Array, x: Array, u: Array, w: float) -> Array:
    """Return A x + B u + F w for the transposes A (k, n), B (m, n), F (1, n): sums of columns."""
    result = np.empty(A.shape[1], A.dtype)
    for i in range(result.size):
        result[i] = F[0, i] * w
    for j in range(A.shape[0]):
        factor = x[j]
        for i in range(result.size):
            result[i] += factor * A[j, i]
    for j in range(B.shape[0]):
        factor = u[j]
        for i in range(result.size):
            result[i] += factor * B[j, i]
    return result


@kernel
def cholesky(M: Array) -> Indices:
    """Overwrite the upper triangle of the symmetric positive definite M (n, n) by U with U' U = M; return its skyline.

    The skyline says of each row of U where its zeros begin that reach up to the end, shape (n,). Row by row, the rows
    above are subtracted in their order, four at a time; those that have a zero in the row's column are left out.
    """
    n = M.shape[0]
    zero, one = M.dtype.type(0.0), M.dtype.type(1.0)
    skyline = np.empty(n, np.uint64)
    above = np.empty(n + 3, np.int64)
    for i in range(n):
        end = n
        while end > i + 1 and M[i, end - 1] == zero:
            end -= 1
        count, reach = 0, np.uint64(end)
        for k in range(i):
            if M[k, i] != zero:
                above[count] = k
                count += 1
                reach = max(reach, skyline[k])
        skyline[i] = reach
        begin = np.uint64(i)
        for g in range(0, count - 3, 4):
            a, b, c, d = above[g], above[g + 1], above[g + 2], above[g + 3]
            fa, fb, fc, fd = M[a, i], M[b, i], M[c, i], M[d, i]
            for j in range(begin, max(skyline[a], skyline[b], skyline[c], skyline[d])):
                M[i, j] = M[i, j] - fa * M[a, j] - fb * M[b, j] - fc * M[c, j] - fd * M[d, j]
        for g in range(count - count % 4, count):
            a = above[g]
            factor = M[a, i]
            for j in range(begin, skyline[a]):
                M[i, j] -= factor * M[a, j]
        pivot = np.sqrt(M[i, i])
        M[i, i] = pivot
        inverse = one / pivot
        for j in range(np.uint64(i + 1), reach):
            M[i, j] *= inverse
    return skyline


@kernel
def cholesky_solve(U: Array, skyline: Indices, b: Array) -> None:
    """Overwrite b (n) by the solution of U' U x = b, for U and its skyline from `cholesky`."""
    n = U.shape[0]
    for k in range(n):
        b[k] /= U[k, k]
        factor = b[k]
        for j in range(np.uint64(k + 1), skyline[k]):
            b[j] -= factor * U[k, j]
    for k in range(n - 1, -1, -1):
        total = b[k]
        for j in range(np.uint64(k + 1), skyline[k]):
            total -= U[k, j] * b[j]
        b[k] = total / U[k, k]
