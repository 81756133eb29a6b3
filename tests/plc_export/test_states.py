"""Kernels with states, parts of arrays and records of results do in Structured Text what they do in Python.

In C the whole optimiser does so (test_whole_optimizer.py).
"""

import math
from typing import Any, NamedTuple, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_export import st_printer
from coldloop_export.st_files import state_types
from coldloop_export.st_lowering import Lowering, Record
from coldloop_export.st_printer import (
    Constants,
    StructuredTextPrinter,
    configuration,
    global_name,
    in_pieces,
    section,
    types_in,
)
from coldloop_export.statements import Program
from coldloop_export.tree import UnfitKernelError, template, type_of
from tests.plc_export.st_interpreter import Machine

Array = NDArray[np.float32]
N = 4


class Table(NamedTuple):
    """A constant."""

    rows: Array
    """Shape (3, N)."""


class Part(NamedTuple):
    """A state within a state."""

    numbers: Any
    z: Array


class State(NamedTuple):
    """What kernels write to."""

    numbers: Any
    one: Part
    other: Part
    marks: Any
    """Records, shape (N,)."""


class Found(NamedTuple):
    """Results: an array of its own, one of a constant, a number."""

    z: Array
    rows: Array
    total: np.float32


NUMBERS = np.dtype([("count", "i8"), ("done", "?"), ("sum", np.float32)])
MARK = np.dtype([("kind", "i8"), ("size", np.float32)])


@kernel
def mark(r: Any, kind: int, size: np.float32) -> None:  # noqa: ANN401 records
    if r.kind != kind:
        r.kind, r.size = kind, size


@kernel
def combined(c: Table, z: Array, row: int) -> Found:
    total, part = z.dtype.type(0.0), c.rows[row]
    made = z.copy()
    for i in range(z.shape[0]):
        made[i] += part[i]
        total += made[i]
    return Found(made, c.rows, total)


@kernel
def judged(c: Table, z: Array, row: int) -> tuple[Found, bool]:
    found = combined(c, z, row)
    return found, 0 <= found.total < 100.0


@kernel
def of_rows(found: Found) -> np.float32:
    total = found.total
    for i in range(found.rows.shape[0]):
        total += largest(found.rows[i])
    return total


@kernel
def largest(z: Array) -> np.float32:
    most = z[0]
    for i in range(1, z.shape[0]):
        most = max(most, z[i])
    return most


@kernel
def swap(m: State) -> int:
    m.one.numbers[0] = m.other.numbers[0]
    m.one.z[:], m.other.z[:] = m.other.z, m.other.z.dtype.type(-1.0)
    return m.one.numbers[0].count


@kernel
def advance(c: Table, m: State, z: Array, row: int) -> None:
    """Almost everything that a state can do."""
    now, other = m.numbers[0], m.other.numbers[0]
    now.count += 1
    found, small = judged(c, z, row)
    other.sum = of_rows(found)
    other.count, other.done = now.count * 2, small
    m.other.z[:] = found.z
    m.other.z[1:-1] = z[2:]
    m.one.z[2:] = z[:2]
    mask, bit = 0, 1
    for i in range(m.marks.shape[0]):
        r = m.marks[i]
        mark(r, row if z[i] > 0 else -1, z[i])
        if r.kind >= 0 and np.isfinite(r.size):
            mask += bit
        bit += bit
    now.sum = z.dtype.type(mask)
    now.done = other.done = small and not math.isnan(z[0])
    count = swap(m)
    now.count += count


@kernel
def reads_behind(m: State) -> None:
    now = m.numbers[0]
    now.count, now.sum = 7, m.one.z[m.numbers[0].count]


def empty() -> State:
    def numbers() -> Any:  # noqa: ANN401 records
        return np.zeros(1, NUMBERS)

    one, other = (Part(numbers(), np.zeros(N, np.float32)) for _ in range(2))
    return State(numbers(), one, other, np.zeros(N, MARK))


def function(entry: object, *arguments: object) -> tuple[Program, Any]:
    program = Program()
    return program, program.function(cast("Dispatcher", entry), tuple(map(type_of, arguments)))


TABLE = Table(np.arange(3 * N, dtype=np.float32).reshape(3, N) - np.float32(4.0))


def shown(numbers: Any) -> tuple[int, bool, float]:  # noqa: ANN401 records
    return int(numbers[0]["count"]), bool(numbers[0]["done"]), float(numbers[0]["sum"])


finite = st.floats(-50.0, 50.0, width=32)


def test_a_number_that_is_read_behind_its_assignment_is_refused() -> None:
    with pytest.raises(UnfitKernelError, match="read behind its assignment"):
        function(reads_behind, empty())


class InText:
    """`advance` as Structured Text: the state is global, the table may be in pieces."""

    def __init__(self) -> None:
        _, found = function(advance, TABLE, empty(), np.zeros(N, np.float32), 0)
        values, split = in_pieces({("c", "rows"): TABLE.rows})
        state = dict(state_types(("m", "state"), type_of(empty())))
        lowering = Lowering({*values, *split, *state}, split)
        lowering.block(found, {"c": Record(("c",)), "m": Record(("m", "state"))})
        printer = StructuredTextPrinter({**types_in(values), **state})
        blocks = "\n".join(map(printer.block, lowering.blocks))
        globals_ = section("VAR_GLOBAL", {global_name(path): printer.type(kind) for path, kind in state.items()})
        lists = configuration(iter([*Constants(values, printer).lists(), globals_]))
        functions = template("structured_text/functions.st")
        self.machine = Machine(printer.types(), functions, blocks, "PROGRAM cl_main END_PROGRAM", lists)
        self.instance = self.machine.instance("cl_advance")

    def clear(self) -> None:
        """Make the state zero."""
        for name, variable in self.machine.library.globals.items():
            if not variable.constant:
                setattr(self.machine.globals, name, self.machine.initial(variable))

    def step(self, z: Array, row: int) -> None:
        self.instance.z, self.instance.row = dict(enumerate(z)), row
        self.instance.run_()

    def shown(self, *path: str) -> tuple[int, bool, float]:
        count, done, total = (getattr(self.machine.globals, "_".join(("cl_state", *path, name)))
                              for name in ("count", "done", "sum"))  # fmt: skip
        return count, done, float(total)

    def array(self, name: str) -> list[float]:
        return [float(each) for each in getattr(self.machine.globals, f"cl_state_{name}").values()]


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("largest_list", [64 * 1024, 4 * N * 2], ids=["whole", "in pieces"])
def test_a_state_goes_the_same_way_in_structured_text(monkeypatch: pytest.MonkeyPatch, largest_list: int) -> None:
    monkeypatch.setattr(st_printer, "LARGEST_LIST", largest_list)
    text = InText()
    monkeypatch.undo()

    @settings(deadline=None)
    @given(
        steps=st.lists(st.tuples(st.lists(finite, min_size=N, max_size=N), st.integers(0, 2)), min_size=1, max_size=4)
    )
    def check(steps: list[tuple[list[float], int]]) -> None:
        m = empty()
        text.clear()
        for values, row in steps:
            z = np.array(values, np.float32)
            advance(TABLE, m, z, row)
            text.step(z, row)
            assert text.shown() == shown(m.numbers)
            for name, part in (("one", m.one), ("other", m.other)):
                assert text.shown(name) == shown(part.numbers)
                assert text.array(f"{name}_z") == part.z.tolist()
            assert text.array("marks_kind") == m.marks["kind"].tolist()
            assert text.array("marks_size") == m.marks["size"].tolist()

    check()


def test_states_are_written_and_constants_are_not() -> None:
    _, found = function(advance, TABLE, empty(), np.zeros(N, np.float32), 0)
    assert found.written == {"m"}
