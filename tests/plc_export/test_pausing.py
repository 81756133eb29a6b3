"""Blocks that pause do what they do in one call, whatever a call is given, and take exactly what they do from that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from coldloop_export import st_pausing
from coldloop_export.golden import GoldenVector, GoldenVectors, answered
from coldloop_export.st_files import WORK, OptimizerText, StructuredTextExport
from coldloop_export.st_lowering import GIVEN, Lowering
from coldloop_export.st_pausing import BUSY, PIECE, Pausing
from coldloop_export.st_printer import StructuredTextPrinter, block_name, interface_names
from coldloop_export.statements import Program
from coldloop_export.tree import UnfitKernelError, template, type_of
from tests.plc_export.paused_kernels import KERNELS, S, Z, five_hundred
from tests.plc_export.recorded_optimizers import recorded_updates, recorder
from tests.plc_export.st_interpreter import Machine
from tests.plc_export.test_structured_text import bits, solved

Array = NDArray[np.float32]

pytestmark = [
    pytest.mark.usefixtures("compiles"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # numpy's of overflow: the kernels have none
]


class Paused:
    """A kernel as a block that pauses."""

    def __init__(self, compiled: Dispatcher, *arguments: object) -> None:
        lowering = Lowering({})
        self.kernel, self.arguments = compiled, arguments
        block = lowering.block(Program().function(compiled, tuple(map(type_of, arguments))), {})
        made, printer = Pausing((block,)), StructuredTextPrinter({})
        printer.literal(0.0)
        blocks = "\n".join(map(printer.block, map(made.block, lowering.blocks)))
        literals = f"cl_literals : cl_literals_table := [{', '.join(printer.literals)}]"
        configuration = f"CONFIGURATION c VAR_GLOBAL {literals}; END_VAR END_CONFIGURATION"
        self.machine = Machine(printer.types(), template("structured_text/functions.st"), blocks, configuration)
        self.instance = self.machine.instance(block_name(block))
        names = interface_names(made.block(block), printer.type)
        self.names = {each.name.removesuffix(GIVEN): name.lower() for each, name in names.items()}
        self.parameters = [
            each.name for each in Program().function(compiled, tuple(map(type_of, arguments))).parameters
        ]

    def begin(self) -> None:
        for name, value in zip(self.parameters, self.arguments, strict=True):
            given = dict(enumerate(value)) if isinstance(value, np.ndarray) else value
            setattr(self.instance, self.names[name], given)
        self.instance.anew = True

    def call(self, work: int) -> bool:
        """Call it with so much work; return whether it has paused."""
        before, self.instance.remaining = self.machine.operations[0], work
        self.instance.run_()
        self.instance.anew = False
        did = self.machine.operations[0] - before
        assert did == work - self.instance.remaining, "it takes what it does"
        assert did <= work + PIECE
        assert not self.busy or did >= work, "it does what it is given"
        return self.busy

    @property
    def busy(self) -> bool:
        return bool(getattr(self.instance, self.names[BUSY.name]))

    def assert_right(self) -> None:
        """Compare result and array with those of the kernel."""
        z, *others = self.arguments
        assert isinstance(z, np.ndarray)
        then = z.copy()
        assert bits(self.instance.result) == bits(self.kernel(then, *others))
        assert np.array([*self.instance.z.values()], np.float32).tobytes() == then.tobytes()


@pytest.fixture(scope="module", params=KERNELS, ids=lambda each: each[0].py_func.__name__)
def paused(request: pytest.FixtureRequest) -> Paused:
    compiled, arguments = request.param
    return Paused(compiled, *arguments)


@settings(deadline=None, max_examples=settings.default.max_examples // 8)
@given(data=st.data(), most=st.sampled_from([1, 2, 300, 10_000, 10**9]))
def test_whatever_calls_are_given_bits_are_those_of_the_kernel(paused: Paused, most: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    paused.begin()
    if data.draw(st.booleans()):
        paused.call(int(rng.integers(1, 5000)))
        paused.begin()  # anew, wherever it is
    while paused.call(int(rng.integers(1, most + 1))):
        pass
    paused.assert_right()


def test_a_statement_of_more_than_a_piece_is_refused_with_file_and_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(st_pausing, "PIECE", 0)
    with pytest.raises(UnfitKernelError, match=r"paused_kernels\.py:\d+: a statement of more than 0 operations"):
        Paused(five_hundred, Z, S)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def solver(recorded: GoldenVectors) -> Machine:
    return Machine(*StructuredTextExport(recorded.method, recorded.vectors[:1]).files().values())


@pytest.mark.parametrize("work", [1, 3000, 10**9])
def test_the_solver_has_its_bits_whatever_calls_are_given(solver: Machine, recorded: GoldenVectors, work: int) -> None:
    vector = recorded.vectors[0]
    found = solved(solver.instance("cl_solver"), vector, lambda: work)
    assert [each[0] for each in found[1:]] == [point.tobytes() for point in vector.answer.points]


def test_an_iteration_with_every_row_active_takes_more_calls_and_no_longer_ones(
    solver: Machine, recorded: GoldenVectors
) -> None:
    usual, calls = recorded.vectors[0], list[int]()

    def work() -> int:
        calls.append(solver.operations[0])
        return WORK

    for vector in (usual, all_active(recorded, usual)):
        calls.clear()
        solved(solver.instance("cl_solver"), vector, work)
        assert max(np.diff(calls)) <= WORK + PIECE
    assert len(calls) > 20 * 10


def all_active(recorded: GoldenVectors, vector: GoldenVector) -> GoldenVector:
    gamma = np.full_like(vector.problem.gamma, -1e6)
    return answered(recorded.method, vector.problem._replace(gamma=gamma), vector.guess)


@pytest.mark.night
def test_the_longest_call_of_the_whole_optimiser_is_hardly_longer_than_the_mean() -> None:
    machine = Machine(*OptimizerText(recorder().optimizer, recorded_updates(100, "e")).files().values())
    test, calls = machine.instance("cl_self_test"), list[int]()
    test.run = True
    while not test.done:
        before, phase = machine.operations[0], test.phase
        test.run_()
        if phase in {3, 4}:
            calls.append(machine.operations[0] - before)
    assert test.passed
    assert WORK < max(calls) <= WORK + PIECE
    assert max(calls) < 1.2 * np.mean(calls)
