"""The exported C99 gives the bits of the kernels, and its self-test finds what has been changed."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from coldloop_export.c_files import OdeExport
from coldloop_export.golden import ITERATIONS, PER_PROBLEM, GoldenVector, GoldenVectors
from coldloop_optimizer_plc.qp.costs import matrices_of
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Costs
from coldloop_optimizer_plc.solvers.ode import Flow, OdeMethod, solve
from tests.plc_export.c_programs import COMPILERS, NO_COMPILER, compiled, output, write

REAL = re.compile(r"(?<=[ {])-?\d\.\d{9}e[+-]\d\df")

pytestmark = pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)


def export_of(recorded: GoldenVectors) -> OdeExport:
    return OdeExport(recorded.method, recorded.vectors)


@pytest.fixture(scope="module")
def folder(recorded: GoldenVectors, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh export with the golden vectors of that recorded."""
    made = tmp_path_factory.mktemp("export")
    write(made, export_of(recorded).files())
    return made


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("level", ["-O0", "-O3"])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_self_test_finds_every_bit_as_the_kernels_have_it(
    folder: Path, recorded: GoldenVectors, compiler: str, level: str
) -> None:
    code, said = output(compiled(folder, compiler, level))
    assert said.endswith(f"\n{len(recorded.vectors)} golden vectors, 0 failures\n")
    assert code == 0


def in_double(recorded: GoldenVectors, most: int) -> GoldenVectors:
    """Return the first problems with the kernels' answers in double precision."""
    counts, none = np.arange(1, ITERATIONS + 1), Costs(np.inf, np.inf)
    flow = Flow(*(each if isinstance(each, bool) else float(each) for each in recorded.method.flow))
    first = recorded.vectors[0].problem
    Phi, Gamma = first.Phi.astype(float), first.Gamma.astype(float)
    vectors = []
    for vector in recorded.vectors[:most]:
        phi, gamma, low, high = (getattr(vector.problem, name).astype(float) for name in PER_PROBLEM)
        qp = QuadraticProblem(Phi, phi, Gamma, gamma, low, high, 0.0)
        method, guess = OdeMethod(matrices_of(qp), flow), vector.guess.astype(float)
        vectors.append(GoldenVector(qp, guess, solve(method, qp, guess, counts, none)))
    return GoldenVectors(method, vectors)


@pytest.mark.night
def test_double_precision_has_the_same_bits_too(recorded: GoldenVectors, tmp_path: Path) -> None:
    double = in_double(recorded, 5)
    write(tmp_path, export_of(double).files())
    assert output(compiled(tmp_path, COMPILERS[0], "-O2"))[1].endswith("\n5 golden vectors, 0 failures\n")


def changed(text: str, place: int) -> str:
    """Change the last bit of a number in a C source."""
    number = list(REAL.finditer(text))[place]
    after = np.nextafter(np.float32(number[0].rstrip("f")), np.float32(np.inf))
    return f"{text[: number.start()]}{after:.9e}f{text[number.end() :]}"


def places(folder: Path, name: str, most: int) -> Iterator[int]:
    count = len(REAL.findall((folder / name).read_text()))
    assert count
    yield from sorted({int(place) for place in np.random.default_rng(1).permutation(count)[:most]})


def assert_found(folder: Path, copy: Path, name: str, most: int) -> None:
    text = (folder / name).read_text()
    for place in places(folder, name, most):
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        (copy / name).write_text(changed(text, place))
        code, said = output(compiled(copy, COMPILERS[0], "-O0"))
        assert code == 1, (name, place)
        assert "is not what was written" in said


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", ["tables.c", "golden.c"])
def test_a_changed_bit_of_a_literal_a_matrix_or_a_golden_vector_is_found(
    folder: Path, tmp_path: Path, name: str
) -> None:
    assert_found(folder, tmp_path / "copy", name, 1)


@pytest.mark.night
@pytest.mark.parametrize("name", ["tables.c", "golden.c"])
def test_many_changed_bits_are_found(folder: Path, tmp_path: Path, name: str) -> None:
    assert_found(folder, tmp_path / "copy", name, 30)
