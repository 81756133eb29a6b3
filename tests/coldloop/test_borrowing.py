"""Kernels borrow arrays: what they see and change is the caller's."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.kernels.intrinsics import borrowed

pytestmark = pytest.mark.usefixtures("compiles")

Array = NDArray[np.float64]


class Inner(NamedTuple):
    """A record with an array of two dimensions."""

    table: Array
    scale: float


class Record(NamedTuple):
    """A record within which there is another."""

    inner: Inner
    vector: Array


@kernel
def read(record: Record) -> float:
    """Return a sum over what is passed on."""
    total: float = record.inner.scale * record.inner.table[1, 2]
    return total + record.vector[-1]


@kernel
def by_borrowing(record: Record, calls: int) -> float:
    """Read many times, and write."""
    lent, total = borrowed(record), 0.0
    for call in range(calls):
        total += read(lent)
        lent.vector[0] = call
    return total


def test_what_is_borrowed_is_the_callers_own() -> None:
    record = Record(Inner(np.arange(6.0).reshape(2, 3)[:, ::1], 2.0), np.array([0.0, 7.0]))
    assert by_borrowing(record, 10) == 10 * (2.0 * 5.0 + 7.0)
    assert record.vector.tolist() == [9.0, 7.0]


def test_views_of_parts_that_are_not_contiguous_keep_their_places() -> None:
    whole = np.arange(24.0).reshape(4, 6)
    record = Record(Inner(whole[::2, ::2], 1.0), whole[:, 5])
    assert by_borrowing(record, 1) == whole[2, 4] + whole[3, 5]
    assert whole[0, 5] == 0.0


def test_the_arrays_live_as_long_as_their_owner_however_often_they_are_lent() -> None:
    record = Record(Inner(np.ones((2, 3)), 1.0), np.ones(2))
    copies = [array.copy() for array in (record.inner.table, record.vector)]
    for _ in range(200):
        by_borrowing(record, 1)
    assert np.array_equal(record.inner.table, copies[0])
    assert record.vector.tolist() == [0.0, 1.0]
