"""Kernels with what Structured Text does not have, printed and executed, compute what their Python does."""

from importlib.resources import files
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_export.golden import leaves
from coldloop_export.st_lowering import Lowering, Record
from coldloop_export.st_pausing import one_iteration_a_call
from coldloop_export.st_printer import StructuredTextPrinter, block_name, memory
from coldloop_export.statements import Program
from coldloop_export.tree import RecordType, UnfitKernelError, type_of
from tests.plc_export.st_interpreter import Machine

Array = NDArray[np.float32]
N = 5


class Scale(NamedTuple):
    """A record whose fields are constants."""

    factor: np.float32
    weights: Array


class Pair(NamedTuple):
    """A record of two results."""

    count: int
    total: np.float32


@kernel
def largest(z: Array) -> np.float32:
    found = z[0]
    for i in range(1, z.shape[0]):
        found = max(found, z[i])
    return found


@kernel
def leading(z: Array) -> int:
    """The index is beyond the array where the first operand is false."""
    count = 0
    while count < z.shape[0] and z[count] > z.dtype.type(0.0):
        count += 1
    return count


@kernel
def chosen(z: Array) -> np.float32:
    """A choice within an expression, and a call within the second operand."""
    zero = z.dtype.type(0.0)
    first = (z[0] if z[0] > z[1] else -z[1]) + z[2]
    return first if first > zero or largest(z) < zero else zero - first * first


@kernel
def countdown(z: Array, count: int) -> Pair:
    """A parameter that is written to, a loop downwards, two results."""
    total = z.dtype.type(0.0)
    while count > 0:
        count -= 1
        total = total * z[count % 3] - z[count // 2]
    for i in range(z.shape[0] - 1, -1, -2):
        total += z[i]
    return Pair(count, total)


@kernel
def fresh(z: Array) -> Array:
    """An array that is zero at each call, written to in part."""
    found = np.zeros_like(z)
    for i in range(z.shape[0]):
        if z[i] > z.dtype.type(0.0):
            found[i] = z[i]
    return found


@kernel
def scaled(scale: Scale, z: Array) -> np.float32:
    total = z.dtype.type(0.0)
    for i in range(z.shape[0]):
        total += scale.factor * scale.weights[i] * z[i]
    return total


class Exported:
    """A kernel as a function block."""

    def __init__(self, compiled: object, *arguments: object, constant: object = None) -> None:
        assert isinstance(compiled, Dispatcher)
        types = tuple(map(type_of, arguments))
        function = Program().function(compiled, types)
        records = {each.name: Record((each.name,)) for each in function.parameters if isinstance(each.type, RecordType)}
        constants = leaves(next(iter(records.values())).path, constant) if records else {}
        lowering = Lowering(constants)
        self.block = lowering.block(function, records)
        printer = StructuredTextPrinter({path: type_of(value) for path, value in constants.items()})
        printer.literal(0.0)
        blocks = "\n".join(map(printer.block, lowering.blocks))
        values = {"cl_literals": f"cl_literals_table := [{', '.join(printer.literals)}]"}
        if constants:
            values["cl_factor"] = f"REAL := {printer.number(float(constants['scale', 'factor']))}"
            listed = ", ".join(map(printer.number, constants["scale", "weights"]))
            values["cl_weights"] = f"cl_reals_{N} := [{listed}]"
        globals_ = "".join(f"{name} : {value};" for name, value in values.items())
        functions = files("coldloop_export").joinpath("structured_text/functions.st").read_text(encoding="ascii")
        configuration = f"CONFIGURATION c VAR_GLOBAL {globals_} END_VAR END_CONFIGURATION"
        self.machine = Machine(printer.types(), functions, blocks, configuration)
        self.instance = self.machine.instance(block_name(self.block))

    def __call__(self, z: Array, **inputs: int) -> SimpleNamespace:
        self.instance.z = dict(enumerate(z))
        if self.block.shared[-1].name == "result_0":
            self.instance.result_0 = dict(enumerate(np.full(N, 7, np.float32)))
        for name, value in inputs.items():
            setattr(self.instance, name, value)
        self.instance.run_()
        return self.instance


ZEROS = np.zeros(N, np.float32)
VECTORS = st.lists(
    st.sampled_from([-2.5, -1.0, -0.0, 0.0, 0.125, 1.0, 3.0]), min_size=N, max_size=N
).map(lambda values: np.array(values, np.float32))  # fmt: skip


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("compiled", [largest, leading, chosen], ids=["largest", "leading", "chosen"])
def test_a_value_is_that_of_the_kernel(compiled: Dispatcher) -> None:
    exported = Exported(compiled, ZEROS)

    @settings(deadline=None)
    @given(VECTORS)
    def check(z: Array) -> None:
        assert np.float32(exported(z).result).tobytes() == np.float32(compiled.py_func(z)).tobytes()

    check()


def test_several_results_are_those_of_the_kernel() -> None:
    exported = Exported(countdown, ZEROS, 3)

    @settings(deadline=None)
    @given(VECTORS, st.integers(0, N))
    def check(z: Array, count: int) -> None:
        expected = countdown.py_func(z, count)  # type: ignore[attr-defined]
        found = exported(z, count_given=count)
        assert (found.result_0, found.result_1.tobytes()) == (expected.count, expected.total.tobytes())

    check()


def test_an_array_is_zero_again_at_the_next_call() -> None:
    exported = Exported(fresh, ZEROS)
    for z in (np.ones(N, np.float32), -np.ones(N, np.float32)):
        assert [*exported(z).result_0.values()] == fresh.py_func(z).tolist()  # type: ignore[attr-defined]


def test_fields_of_records_are_constants() -> None:
    scale = Scale(np.float32(0.1), np.arange(N, dtype=np.float32))
    exported = Exported(scaled, scale, ZEROS, constant=scale)
    z = np.linspace(-1, 1, N, dtype=np.float32)
    assert exported(z).result.tobytes() == scaled.py_func(scale, z).tobytes()  # type: ignore[attr-defined]
    assert memory(exported.block) == 4 * 3  # the result, the sum, the index


def test_a_solver_that_is_no_loop_over_counts_is_refused_with_file_and_line() -> None:
    function = Program().function(largest, (type_of(ZEROS),))  # type: ignore[arg-type]
    with pytest.raises(UnfitKernelError, match=r"test_lowering\.py:\d+: the solver is not a start and a loop"):
        one_iteration_a_call(function)
