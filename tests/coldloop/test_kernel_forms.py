"""A kernel has a form for calls from Python, and for arguments of many parts another one for calls from kernels."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.kernels import compiled
from coldloop.kernels.cache import CacheFolder
from coldloop.kernels.compiled import LARGE, is_compiled, kernel

pytestmark = pytest.mark.usefixtures("compiles")

Array = NDArray[np.float64]
Row = tuple[float, ...]


class Many(NamedTuple):
    """More parts than `LARGE`."""

    first: Row
    rest: Row


MANY = Many((0.1,) * 3, (0.2,) * LARGE)


@kernel
def weighted(many: Many, x: Array) -> float:
    return many.first[0] * x[0] + many.rest[0] * x[1]


@kernel
def twice_weighted(many: Many, x: Array) -> float:
    return 2.0 * weighted(many, x)


@kernel
def product(x: Array) -> float:
    return x[0] * x[1]


@kernel
def twice_the_product(x: Array) -> float:
    return 2.0 * product(x)


X = np.array([1.0 / 3.0, 5.0])


@pytest.fixture(autouse=True)
def _nothing_is_cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "cache_folder", CacheFolder(tmp_path))


def test_arguments_of_many_parts_have_no_wrapper_until_python_calls() -> None:
    from_python, from_kernels = weighted, weighted.for_kernels
    twice = twice_weighted(MANY, X)
    assert not from_python.overloads
    assert len(from_kernels.overloads) == 1
    assert weighted(MANY, X) * 2.0 == twice == 2.0 * (0.1 * X[0] + 0.2 * X[1])
    assert len(from_python.overloads) == 1


def test_arguments_of_few_parts_have_one_form() -> None:
    from_python, from_kernels = product, product.for_kernels
    assert twice_the_product(X) == 2.0 * product(X)
    assert len(from_python.overloads) == 1
    assert not from_kernels.overloads


def test_a_kernel_is_compiled_for_the_types_that_it_was_called_with() -> None:
    product(X)
    assert is_compiled(product, X)
    assert not is_compiled(product, X.astype(np.float32))
