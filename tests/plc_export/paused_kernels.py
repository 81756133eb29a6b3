"""Kernels with what can go wrong where blocks pause: each with arguments, of which the first is an array."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel

Array = NDArray[np.float32]
N: Final = 30


@kernel
def five_hundred(z: Array, s: np.float32) -> np.float32:
    """As many operations as one piece has."""
    total = z.dtype.type(0.0)
    for _i in range(250):
        total += z[0] * s
    return total


@kernel
def product(z: Array, s: np.float32) -> np.float32:
    """More than a piece, with an end within."""
    total = z.dtype.type(0.0)
    if s < z[5] - z[6]:
        return total - s
    for i in range(z.shape[0]):
        for j in range(i, z.shape[0]):
            if z[j] != z[0]:
                total += s * z[i] * z[j]
    return total


@kernel
def writing(z: Array, s: np.float32) -> np.float32:
    for _k in range(20):
        for i in range(z.shape[0]):
            z[i] = z[i] * s + s
    return z[3]


@kernel
def what_an_argument_is_made_of_changes(z: Array) -> np.float32:
    return writing(z, z[0])


@kernel
def arguments_take_all_that_remains(z: Array, s: np.float32) -> np.float32:
    return product(z, s * s + s)


@kernel
def with_its_arguments_a_call_is_more_than_a_piece(z: Array, s: np.float32) -> np.float32:
    return five_hundred(z, s + z[1])


@kernel
def early(z: Array, s: np.float32) -> np.float32:
    """An end behind operations, in one piece."""
    one = z[0] * z[1] + z[2] * z[3] + z[4] * z[5]
    if one + s < s * s:
        return one
    for i in range(4):
        one += z[i]
        if one > s:
            return one - s
    return s


@kernel
def ends_within_a_piece(z: Array, s: np.float32) -> np.float32:
    total = s
    for i in range(300):
        total = early(z, total - z[i % 30]) * s
    return total


@kernel
def busy_inside(z: Array, s: np.float32, busy: bool) -> np.float32:  # noqa: FBT001 as an input of a block
    """Names that blocks have that pause."""
    remaining, anew = s, z[1]
    for _i in range(300):
        if busy:
            remaining = remaining * anew + z[2]
    return remaining


@kernel
def names_that_are_taken(z: Array, s: np.float32) -> np.float32:
    return busy_inside(z, s, True) - busy_inside(z, s, s > z[0])  # noqa: FBT003 as an input of a block


@kernel
def empty_by_more_than_one(z: Array, first: int, last: int) -> np.float32:
    total = z[0]
    for _k in range(200):
        total = total * z[0]
        for i in range(first, last):
            total += z[i]
        for i in range(first, last, 7):
            total -= z[i]
    return total


@kernel
def an_index_now_and_then(z: Array, count: int) -> np.float32:
    total = z[0]
    for k in range(count):
        total = total * z[0]
        if k < N:
            total += z[k]
    return total


@kernel
def computed_ends(z: Array, s: np.float32) -> np.float32:
    total = z[0]
    for k in range(int(round(s * s)), 30):  # noqa: RUF046 integers of the subset
        total += z[k] * z[k]
    for k in range(int(round(s * s)), 30):  # noqa: RUF046 integers of the subset
        for j in range(int(round(s + s)), k):  # noqa: RUF046 integers of the subset
            total -= product(z, z[j] * z[k])
    return total


@kernel
def no_round_inside(z: Array, s: np.float32) -> np.float32:
    total = s
    for i in range(z.shape[0] - 30):
        total = five_hundred(z, total - z[i])
    return total


@kernel
def no_round(z: Array, s: np.float32) -> np.float32:
    return product(z, no_round_inside(z, s) + s)


@kernel
def one_after_the_other(z: Array, s: np.float32) -> np.float32:
    """Results that are arguments of the next call of the same block; calls in conditions, in a choice, downwards."""
    s = product(z, s)
    s = product(z, -s) if product(z, s) > s else product(z, s) - s
    rounds = 0
    while rounds < 3 and (s > z[0] or product(z, s) < s):
        rounds += 1
        s = s * z[rounds] - z[rounds + 1]
        for i in range(z.shape[0] - 1, -1, -9):
            if product(z, z[i]) > s:
                s = product(z, s) * z[i]
    return s


Z: Final = np.linspace(-0.9, 1.1, N).astype(np.float32)
S: Final = np.float32(0.7)
KERNELS: Final = (
    (what_an_argument_is_made_of_changes, (Z,)),
    (arguments_take_all_that_remains, (Z, S)),
    (with_its_arguments_a_call_is_more_than_a_piece, (Z, S)),
    (ends_within_a_piece, (Z, S)),
    (names_that_are_taken, (Z, S)),
    (empty_by_more_than_one, (Z, 25, 2)),
    (empty_by_more_than_one, (Z, 2, 25)),
    (an_index_now_and_then, (Z, 3000)),
    (computed_ends, (Z, np.float32(2.0))),
    (no_round, (Z, S)),
    (one_after_the_other, (Z, S)),
    (one_after_the_other, (-Z, np.float32(-0.2))),
)
