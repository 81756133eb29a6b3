"""What counts for the digest of code: whatever may change what it does, and nothing else."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Final

import numba
import numpy as np
import pytest

from coldloop.kernels.intrinsics import Implementations
from coldloop.kernels.reach import digest, reached

TEXT: Final = '''"""Some code."""

from enum import IntEnum
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numba.extending import overload, register_jitable

LIMIT = 3.0
TABLE = np.arange(4.0)
NAMES = frozenset({"one", "two", "three"})
CHOICE = {"first": lambda x: x + 1.0}


class Mode(IntEnum):
    OFF = 0
    ON = 1


class Gains(NamedTuple):
    """Of a controller."""

    p: float
    i: float = 2.0

    @property
    def both(self):
        return self.p + self.i


class Box:
    def __init__(self, size):
        self.size = size

    @cached_property
    def half(self):
        return 0.5 * self.size


SMALL, LARGE = Box(1.0), Box(2.0)


def outside(x):
    return x


@overload(outside, jit_options={"error_model": "numpy"}, strict=False)
def _outside(x):
    return lambda x: x + 0.25


def portable(x):
    return x - 0.5


register_jitable(error_model="numpy")(portable)


def add(a, b=1.0):
    """Return the sum."""
    return a + b  # of both


def scaled(gain):
    def by(x):
        return gain * x

    return by


twice = scaled(2.0)


def unrelated():
    return 17


def even(n):
    return n == 0 or odd(n - 1)


def odd(n):
    return n != 0 and even(n - 1)


def root(x):
    """Return something."""
    total = add(x) + TABLE[0] + outside(x) + portable(x)
    if x > LIMIT:
        return [name for name in NAMES if name > "a"], CHOICE["first"](total)
    return twice(Gains(x, 3.0).i), SMALL.size - LARGE.size if Mode.ON else even(3)


@cache
def roots():
    return root
'''
Make = Callable[[str], ModuleType]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Make a module, always of the same name, from a text."""

    def made(text: str) -> ModuleType:
        module = ModuleType("some_code")
        module.__file__ = str(tmp_path / "some_code.py")
        monkeypatch.setitem(sys.modules, "some_code", module)
        exec(compile(text, module.__file__, "exec"), vars(module))  # noqa: S102 our own
        return module

    return made


def edited(old: str, new: str) -> str:
    assert old in TEXT
    return TEXT.replace(old, new)


SAME: Final = {
    "the docstring of the module": ('"""Some code."""', '"""Other code."""\n\n'),
    "a docstring": ('"""Return something."""', '"""Return something else."""'),
    "the docstring of what is called": ('"""Return the sum."""', '"""Return a + b."""'),
    "the docstring of a class": ('"""Of a controller."""', '"""Of a law."""'),
    "a comment": ("# of both", "# of the two"),
    "the place in the file": ("LIMIT = 3.0", "\n\n\nLIMIT = 3.0"),
    "a local variable's name": ("total", "summed"),
    "what is not reached": ("return 17", "return 18"),
    "the order of a set": ('{"one", "two", "three"}', '{"three", "two", "one"}'),
}
OTHER: Final = {
    "a constant": ("LIMIT = 3.0", "LIMIT = 3.5"),
    "the type of a constant": ("LIMIT = 3.0", "LIMIT = 3"),
    "a literal": ("Gains(x, 3.0)", "Gains(x, -3.0)"),
    "the body of what is called": ("a + b", "a - b"),
    "a default": ("b=1.0", "b=2.0"),
    "a closure": ("scaled(2.0)", "scaled(3.0)"),
    "a member's value": ("ON = 1", "ON = 2"),
    "the order of fields": ("    p: float\n    i: float = 2.0", "    i: float\n    p: float = 2.0"),
    "a field's default": ("i: float = 2.0", "i: float = 2.5"),
    "an array": ("np.arange(4.0)", "np.arange(1.0, 5.0)"),
    "an array's type": ("np.arange(4.0)", "np.arange(4.0, dtype=np.float32)"),
    "a set": ('"three"', '"four"'),
    "a function in a dictionary": ("x + 1.0", "x + 2.0"),
    "what calls itself": ("n == 0 or", "n == 1 or"),
    "what is called in a circle": ("n != 0 and", "n != 1 and"),
}
OF_PYTHON: Final = {
    "a method": ("self.p + self.i", "self.p - self.i"),
    "an attribute": ("Box(1.0)", "Box(1.5)"),
    "attributes the other way round": ("SMALL, LARGE", "LARGE, SMALL"),
    "a property computed once": ("0.5 * self.size", "2.0 * self.size"),
}
OF_KERNELS: Final = {
    "an overload": ("x + 0.25", "x + 0.5"),
    "how an overload is compiled": ('jit_options={"error_model": "numpy"}', 'jit_options={"error_model": "python"}'),
    "what is plain Python": ("x - 0.5", "x - 0.75"),
    "how that is compiled": ('register_jitable(error_model="numpy")', 'register_jitable(error_model="python")'),
}


def of_python(module: ModuleType) -> str:
    return digest(module.root)


def of_kernel(module: ModuleType) -> str:
    return digest(numba.njit(module.root))


BOTH: Final = pytest.mark.parametrize("of", [of_python, of_kernel])


@BOTH
@pytest.mark.parametrize("edit", SAME.values(), ids=SAME)
def test_what_changes_nothing_does_not_count(
    make: Make, of: Callable[[ModuleType], str], edit: tuple[str, str]
) -> None:
    assert of(make(edited(*edit))) == of(make(TEXT))


@BOTH
@pytest.mark.parametrize("edit", OTHER.values(), ids=OTHER)
def test_what_changes_the_result_counts(make: Make, of: Callable[[ModuleType], str], edit: tuple[str, str]) -> None:
    assert of(make(edited(*edit))) != of(make(TEXT))


@pytest.mark.parametrize("edit", OF_PYTHON.values(), ids=OF_PYTHON)
def test_all_of_a_class_counts_for_python(make: Make, edit: tuple[str, str]) -> None:
    assert of_python(make(edited(*edit))) != of_python(make(TEXT))


@pytest.mark.parametrize("edit", OF_KERNELS.values(), ids=OF_KERNELS)
def test_what_takes_the_place_of_a_function_in_kernels_counts(make: Make, edit: tuple[str, str]) -> None:
    assert of_kernel(make(edited(*edit))) != of_kernel(make(TEXT))


def test_for_a_kernel_a_class_is_the_layout_of_its_data(make: Make) -> None:
    assert of_kernel(make(edited(*OF_PYTHON["a method"]))) == of_kernel(make(TEXT))


def test_the_options_of_a_kernel_count(make: Make) -> None:
    root = make(TEXT).root
    assert digest(numba.njit(root)) != digest(numba.njit(error_model="numpy")(root))


def test_what_was_computed_once_does_not_count(make: Make) -> None:
    before, after = make(TEXT), make(TEXT)
    assert after.SMALL.half == 0.5
    assert after.roots() is after.root
    assert digest(after.roots) == digest(before.roots)


def test_a_class_counts_with_the_implementations_that_are_registered_for_it(make: Make) -> None:
    table: Implementations[Any] = Implementations("of a test")
    one, other, none = make(TEXT), make(TEXT), make(TEXT)
    table[one.Gains], table[other.Gains] = numba.njit(one.add), numba.njit(other.even)
    assert len({digest(each.Gains, compiled=True) for each in (one, other, none)}) == 3


def test_a_module_that_is_being_imported_is_described_anew(make: Make) -> None:
    module = make(TEXT)
    twice = vars(module).pop("twice")
    vars(module)["__spec__"] = SimpleNamespace(_initializing=True)
    before = digest(module.root)
    vars(module).update(twice=twice, __spec__=None)
    assert before != digest(module.root) == digest(make(TEXT).root)


def test_data_count_by_value_and_files_by_content(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "two" / "one"
    other.parent.mkdir()
    one.write_text("content")
    other.write_text("content")
    assert digest(one) == digest(other) != digest(tmp_path / "none")
    assert digest(np.zeros(3)) == digest(np.zeros(3)) != digest(np.zeros((3, 1)))
    assert len({digest(value) for value in (0, 0.0, -0.0, False, None, "0", b"0", (0,), [0])}) == 9


def test_what_is_reached_can_be_listed(make: Make) -> None:
    module = make(TEXT)
    found = reached(module.root)
    assert all(each in found for each in (module.add, module.even, module.odd, module.Gains, module.SMALL))
    assert module.unrelated not in found
