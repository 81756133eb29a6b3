"""Sizes of a problem: how many elements of its matrices are computed with, all of them or those that can be non-zero.

A zero is left out where it is zero whatever the state, and whichever rows are active. Variables without an upper bound
(the slacks) are eliminated first, where the Hessian is nearly diagonal.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pattern = NDArray[np.bool_]


class QpSizes(NamedTuple):
    """What the operations of an iteration depend on."""

    n: int
    """Variables."""
    m: int
    """Rows of Gamma."""
    bounded: int
    """Variables with an upper bound; all have a lower one."""
    Phi: int
    """Elements of Phi."""
    Gamma: int
    """Elements of Gamma."""
    outer: int
    """Elements on and above the diagonal of g g', summed over the rows g' of Gamma."""
    factor: NDArray[np.int64]
    """Elements right of the diagonal, row by row, of the Cholesky factor of Phi + Gamma' Gamma, shape (n,)."""
    transformed: int
    """Elements of (I; Gamma) R^-1, where R is the Cholesky factor of Phi."""

    @property
    def triangle(self) -> float:
        """Elements on and above the diagonal of Phi."""
        return (self.Phi + self.n) / 2

    @property
    def row(self) -> float:
        """Elements of a mean row of Gamma."""
        return self.Gamma / self.m


def sizes_without_zeros(Phi: Array, Gamma: Array, bounded: Pattern) -> QpSizes:
    """Return the sizes with the zeros of Phi and Gamma left out; `bounded` (n,) are variables with an upper bound."""
    order = np.argsort(bounded, kind="stable")
    quadratic, rows = (Phi != 0)[np.ix_(order, order)], (Gamma != 0)[:, order]
    lengths = rows.sum(axis=1)
    inverse = inverse_pattern(factor_pattern(quadratic))
    return QpSizes(
        n=len(Phi), m=len(Gamma), bounded=int(bounded.sum()),
        Phi=int(quadratic.sum()), Gamma=int(rows.sum()), outer=int((lengths * (lengths + 1)).sum()) // 2,
        factor=factor_pattern(quadratic | (rows.T @ rows)).sum(axis=1) - 1,
        transformed=int(inverse.sum() + (rows @ inverse).sum()),
    )  # fmt: skip


def dense_sizes(n: int, m: int, bounded: int) -> QpSizes:
    """Return the sizes of a problem without zeros."""
    return sizes_without_zeros(np.ones((n, n)), np.ones((m, n)), np.arange(n) >= n - bounded)


def factor_pattern(pattern: Pattern) -> Pattern:
    """Return where the Cholesky factor U, U' U = A, of a matrix with this pattern (n, n) can be non-zero."""
    filled = pattern.copy()
    for k in range(len(filled)):
        row = k + np.flatnonzero(filled[k, k:])
        filled[np.ix_(row, row)] = True
    upper: Pattern = np.triu(filled)
    return upper


def inverse_pattern(upper: Pattern) -> Pattern:
    """Return where the inverse of an upper triangular matrix with this pattern (n, n) can be non-zero."""
    inverse = np.eye(len(upper), dtype=bool)
    for i in reversed(range(len(upper))):
        inverse[i] |= inverse[upper[i]].any(axis=0)
    return inverse
