"""The exported Structured Text, executed as text, gives the bits of the kernels; its self-test finds changes."""

import re
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop_export import st_printer
from coldloop_export.golden import ITERATIONS, PER_PROBLEM, GoldenVector, GoldenVectors
from coldloop_export.st_files import WORK, StructuredTextExport, sum_of
from coldloop_export.st_printer import LONGEST, Names, StructuredTextPrinter, identifier
from coldloop_export.tree import UnfitKernelError
from tests.plc_export.st_interpreter import Machine

NUMBER = re.compile(r"(REAL#|-)\d\.\d{9}E[+-]\d\d")
INF = np.float32(np.inf)

pytestmark = [
    pytest.mark.usefixtures("compiles"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # numpy's of overflow: the kernels have none
]


@pytest.fixture(scope="module")
def export(recorded: GoldenVectors) -> StructuredTextExport:
    """The export with two of the problems."""
    return StructuredTextExport(recorded.method, recorded.vectors[:2])


@pytest.fixture(scope="module")
def files(export: StructuredTextExport) -> dict[str, str]:
    return export.files()


def self_test(files: dict[str, str], most: int = 2000) -> SimpleNamespace:
    """Run the self-test up to its end, or to its first failure."""
    program = Machine(*files.values()).instance("cl_main")
    for _ in range(most):
        program.run_()
        if program.test.done or program.test.failures:
            break
    result: SimpleNamespace = program.test
    return result


def solved(
    solver: SimpleNamespace, vector: GoldenVector, work: Callable[[], int] = lambda: WORK
) -> list[tuple[bytes, bytes, int]]:
    """Return profile, cost and count after the start and after each iteration; each call is given some work."""
    for name in PER_PROBLEM:
        setattr(solver, f"qp_{name}", dict(enumerate(getattr(vector.problem, name))))
    solver.guess, found = dict(enumerate(vector.guess)), []
    for iteration in range(ITERATIONS + 1):
        solver.start, solver.anew, solver.busy = iteration == 0, True, True
        while solver.busy:
            solver.remaining = work()
            solver.run_()
            solver.anew = False
        z = np.array([*solver.z.values()])
        assert z.dtype == np.float32
        found.append((z.tobytes(), np.asarray(solver.cost).tobytes(), solver.done))
    return found


@pytest.mark.parametrize("place", [0, 3, 7])
def test_an_iteration_a_call_gives_every_bit_of_the_kernels(
    files: dict[str, str], recorded: GoldenVectors, place: int
) -> None:
    vector = recorded.vectors[place]
    found = solved(Machine(*files.values()).instance("cl_solver"), vector)
    answer = vector.answer
    assert found[0][1:] == (bits(answer.guessed), 0)
    assert found[1:] == [(point.tobytes(), cost.tobytes(), count) for point, cost, count
                         in zip(answer.points, answer.costs, answer.iterations, strict=True)]  # fmt: skip


@pytest.mark.night
def test_every_problem_has_the_same_bits_one_after_the_other(files: dict[str, str], recorded: GoldenVectors) -> None:
    solver = Machine(*files.values()).instance("cl_solver")
    for vector in recorded.vectors:
        found = solved(solver, vector)[1:]
        assert [each[0] for each in found] == [point.tobytes() for point in vector.answer.points]
        assert [each[2] for each in found] == vector.answer.iterations.tolist()


def test_the_golden_vectors_move_every_input(recorded: GoldenVectors) -> None:
    assert len(recorded.vectors) == 8
    for vector in recorded.vectors:
        assert np.count_nonzero(vector.answer.points[-1]) > 21
        assert vector.answer.costs[-1] < vector.answer.guessed
        assert vector.answer.iterations[-1] == ITERATIONS


def test_the_self_test_passes(files: dict[str, str]) -> None:
    test = self_test(files)
    assert (test.done, test.passed, test.failures, test.what) == (True, True, 0, 0)


def changed(text: str, place: int) -> str:
    """Change the last bit of a number."""
    number = list(NUMBER.finditer(text))[place]
    after = np.nextafter(np.float32(number[0].removeprefix("REAL#")), INF)
    return f"{text[: number.start()]}{StructuredTextPrinter({}).number(after)}{text[number.end() :]}"


def assert_found(files: dict[str, str], name: str, place: int, what: int) -> None:
    test = self_test({**files, name: changed(files[name], place)})
    assert (test.failures > 0, test.what) == (True, what), (name, place)


def literals(files: dict[str, str]) -> int:
    """Return how many numbers the table of literals has, which is the first in its file."""
    return len(NUMBER.findall(files["configuration.st"].partition("]")[0]))


def test_a_changed_bit_of_a_literal_is_found(files: dict[str, str]) -> None:
    assert_found(files, "configuration.st", 3, 4)


@pytest.mark.night
def test_a_changed_bit_of_any_literal_is_found(files: dict[str, str]) -> None:
    assert literals(files) == 13
    for place in range(13):
        assert_found(files, "configuration.st", place, 4)


def test_changed_bits_of_matrices_and_settings_are_found(files: dict[str, str]) -> None:
    count = len(NUMBER.findall(files["configuration.st"]))
    for place in (count // 2, count - 1):
        assert_found(files, "configuration.st", place, 4)


def test_changed_bits_of_golden_vectors_are_found(files: dict[str, str]) -> None:
    for place in (0, 500):
        assert_found(files, "golden.st", place, 5)


def with_wrong_code(files: dict[str, str]) -> dict[str, str]:
    right = "candidate[at_8_0] := (zg[at_8_0] + change[at_8_0]);"
    assert files["kernels.st"].count(right) == 1
    return {**files, "kernels.st": files["kernels.st"].replace(right, right.replace("+", "-"))}


def test_changed_code_is_found_with_the_first_element_that_differs(files: dict[str, str]) -> None:
    test = self_test(with_wrong_code(files))
    assert (test.what, test.vector, test.iteration, test.passed) == (7, 0, 1, False)
    assert 0 <= test.element < 49


def test_the_self_test_begins_anew(files: dict[str, str]) -> None:
    test = Machine(*with_wrong_code(files).values()).instance("cl_self_test")
    test.run = True
    while not test.done:
        test.run_()
    assert test.failures > 0
    assert not test.passed
    test.run = False
    test.run_()
    assert (test.failures, test.what, test.done) == (0, 0, False)


@pytest.fixture(scope="module")
def functions(files: dict[str, str]) -> Machine:
    return Machine(files["functions.st"])


@given(st.floats(width=32), st.floats(width=32))
def test_minima_and_maxima_are_those_of_the_kernels(functions: Machine, one: float, other: float) -> None:
    a, b = np.float32(one), np.float32(other)
    assert bits(functions.call("cl_min_real", a, b)) == bits(min(a, b))
    assert bits(functions.call("cl_max_real", a, b)) == bits(max(a, b))


def bits(value: object) -> bytes:
    return np.asarray(value, np.float32).tobytes()


@given(st.floats(width=32, allow_nan=False))
def test_bits_are_found_by_arithmetic(functions: Machine, value: float) -> None:
    single = np.float32(value)
    expected = int(np.abs(single).view(np.int32)) * (-1 if single < 0 else 1)
    assert functions.call("cl_bits", single) == expected


@given(st.integers(-(2**31), 2**31 - 1), st.integers(1, 2**20))
def test_integers_are_divided_as_in_python(functions: Machine, one: int, other: int) -> None:
    assert functions.call("cl_floor_mod", one, other) == one % other


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=30), st.data())
def test_a_changed_bit_changes_the_sum(values: list[float], data: st.DataObject) -> None:
    array = np.array(values, np.float32)
    other = array.copy()
    place, bit = data.draw(st.integers(0, len(array) - 1)), data.draw(st.integers(0, 30))
    other.view(np.uint32)[place] ^= np.uint32(1 << bit)
    if np.isfinite(other).all():
        assert sum_of(other) != sum_of(array)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_literal_is_read_back_with_its_bits(value: float) -> None:
    text = StructuredTextPrinter({}).number(value)
    assert bits(text.removeprefix("REAL#")) == bits(value)
    assert bits(float(text.removeprefix("REAL#"))) == bits(value)  # by way of double precision, as some compilers do


@pytest.mark.parametrize(("value", "largest"), [(np.inf, "REAL#3.4"), (-np.inf, "-3.4"), (np.nan, "REAL#3.4")])
def test_what_has_no_literal_is_the_largest_number(value: float, largest: str) -> None:
    assert StructuredTextPrinter({}).number(value) == f"{largest}02823466E+38"


def test_constants_are_in_lists_that_tools_take(export: StructuredTextExport, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"cl_phi": 4 * 49 * 49, "cl_gamma": 4 * 94 * 49}
    monkeypatch.setattr(st_printer, "LARGEST_LIST", sizes["cl_gamma"])
    lists = export.files()["configuration.st"].split("VAR_GLOBAL\n")[1:]
    assert len(lists) > 4
    assert not any("cl_phi :" in each and "cl_gamma :" in each for each in lists)
    monkeypatch.setattr(st_printer, "LARGEST_LIST", sizes["cl_gamma"] - 1)
    with pytest.raises(UnfitKernelError, match="cl_gamma: 18424 bytes, and a list of constants has at most 18423"):
        export.files()


def test_names_are_no_keywords_and_differ_in_more_than_capitals() -> None:
    names = Names()
    assert names("phi", "phi") == "phi"
    assert names("Phi", "Phi") == "Phi_2"
    assert names("phi", "phi") == "phi"
    assert identifier("dt") == "dt_v"
    assert identifier("add_product__2") == "add_product_2"
    long = [identifier(f"matrices_of_a_very_long_name_{ending}") for ending in ("first", "end")]
    assert len(set(long)) == 2
    assert max(map(len, long)) <= LONGEST


def test_every_declared_number_is_in_single_precision(files: dict[str, str]) -> None:
    for text in files.values():
        plain = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
        assert "LREAL" not in plain
        assert re.findall(r"(?<![#\d.\w+-])\d+\.\d+", plain) == []
        assert text.isascii()
