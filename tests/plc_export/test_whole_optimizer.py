"""The whole optimiser in C answers updates by the plans and sequences of the kernels, in every bit."""

import ctypes
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coldloop.config import load_configuration
from coldloop.errors import UsageError
from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from coldloop.registers.control_plc import SEQUENCE_ROWS, Plan, Update
from coldloop_export.c_files import OptimizerExport
from coldloop_export.golden import SINGLE, UpdateRecorder
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_rig.settings import Settings
from tests.harness.records import as_transmitted
from tests.plc_export.c_programs import COMPILERS, NO_COMPILER, SANITIZED, compiled, output, write
from tests.plc_export.recorded_optimizers import OPTIMISERS, disturbed, recorded_updates, recorder

pytestmark = pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)

SHORT = 480
NUMBER = re.compile(r"(?<=[ {])-?\d\.\d{9}e[+-]\d\df")


@pytest.fixture(scope="module", params=OPTIMISERS)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("optimizer")
    assignments = OPTIMISERS[request.param]
    golden = recorded_updates(SHORT, "e", *assignments)
    write(made, OptimizerExport(recorder(*assignments).optimizer, golden).files())
    return made


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize("options", [("-O2",), SANITIZED], ids=" ".join)
@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_self_test_finds_plans_and_sequences_as_the_kernels_have_them(
    folder: Path, compiler: str, options: tuple[str, ...]
) -> None:
    code, said = output(compiled(folder, compiler, *options))
    assert re.fullmatch(r"\d\d+ golden updates, 0 failures\n", said)
    assert code == 0


@pytest.mark.night
@pytest.mark.parametrize("assignments", OPTIMISERS.values(), ids=OPTIMISERS)
def test_two_hours_of_updates_have_the_same_bits_at_every_level_of_optimisation(
    tmp_path: Path, assignments: tuple[str, ...]
) -> None:
    golden = recorded_updates(28800, "2h", *assignments)
    write(tmp_path, OptimizerExport(recorder(*assignments).optimizer, golden).files())
    for compiler in COMPILERS:
        for options in (("-O0",), ("-O2",), ("-O3",), SANITIZED):
            _, said = output(compiled(tmp_path, compiler, *options))
            assert said == f"{len(golden)} golden updates, 0 failures\n"


# -- what is changed is found ------------------------------------------------------------------------------------------


def last_bit(number: re.Match[str]) -> str:
    return f"{np.nextafter(np.float32(number[0].rstrip('f')), np.float32(np.inf)):.9e}f"


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize("name", ["constants.c", "golden.c"])
def test_a_changed_bit_of_a_literal_a_matrix_or_a_golden_update_is_found(
    folder: Path, tmp_path: Path, name: str
) -> None:
    text = (folder / name).read_text()
    numbers = list(NUMBER.finditer(text))
    for place in np.random.default_rng(1).integers(len(numbers), size=1):
        number = numbers[place]
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
        (tmp_path / name).write_text(text[: number.start()] + last_bit(number) + text[number.end() :])
        code, said = output(compiled(tmp_path, COMPILERS[0], "-O0"))
        assert code == 1
        assert "is not what was written" in said


@pytest.mark.usefixtures("programs")
def test_a_changed_setting_is_found(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    text = (folder / "constants.c").read_text()
    changed = re.sub(r"(\.low = )\d+", r"\g<1>77", text, count=1)
    assert changed != text
    (tmp_path / "constants.c").write_text(changed)
    assert "a constant or a literal is not what was written" in output(compiled(tmp_path, COMPILERS[0], "-O0"))[1]


# -- whatever arrives --------------------------------------------------------------------------------------------------


class CUpdate(ctypes.Structure):
    """`Update` of `optimizer.h`."""

    _fields_ = (
        ("update", ctypes.c_int32), ("tick", ctypes.c_int32), ("playing", ctypes.c_int32), ("load", ctypes.c_float),
        ("u_before", ctypes.c_float * len(INPUT_NAMES)), ("u", ctypes.c_float * len(INPUT_NAMES)),
        ("y", ctypes.c_float * len(OUTPUT_NAMES)), ("x", ctypes.c_float * len(STATE_NAMES)),
    )  # fmt: skip


class CPlan(ctypes.Structure):
    """`Plan`."""

    _fields_ = (
        ("update", ctypes.c_int32), ("next_update_tick", ctypes.c_int32), ("load_step", ctypes.c_float),
        ("shortage", ctypes.c_float), ("suspects", ctypes.c_int32), ("iterations", ctypes.c_int32),
    )  # fmt: skip


class CSequence(ctypes.Structure):
    """`Sequence`."""

    _fields_ = (
        ("number", ctypes.c_int32), ("update", ctypes.c_int32), ("first_tick", ctypes.c_int32),
        ("length", ctypes.c_int32), ("tau_u", ctypes.c_int32), ("rows", ctypes.c_float * 3 * SEQUENCE_ROWS),
    )  # fmt: skip


class Exported:
    """The optimiser in C, called as the program in Python is."""

    def __init__(self, library: Path) -> None:
        self.library = ctypes.CDLL(str(library))
        for name in ("optimizer_restart", "optimizer_plan", "optimizer_solve"):
            getattr(self.library, name).restype = ctypes.c_bool

    def plan(self, update: Update) -> tuple[float, ...] | None:
        given = CUpdate(update.update, update.tick, update.playing, update.load, update.u_before, update.u, update.y,
                        update.x)  # fmt: skip
        plan = CPlan()
        known = self.library.optimizer_plan(ctypes.byref(given), ctypes.byref(plan))
        return tuple(getattr(plan, name) for name, _ in CPlan._fields_[:-1]) if known else None

    def solve(self) -> tuple[Any, ...] | None:
        made = CSequence()
        if not self.library.optimizer_solve(ctypes.byref(made)):
            return None
        header = (made.number, made.update, made.first_tick, made.length, made.tau_u)
        return header, [tuple(row) for row in made.rows[: made.length]]


@pytest.fixture(scope="module")
def library(folder: Path) -> Path:
    return compiled(folder, COMPILERS[0], "-O2", "-shared", "-fPIC", sources=("[!s]*.c",))


def of_python(optimizer: OptimizerProgram, update: Update) -> tuple[float, ...]:
    plan: Plan = as_transmitted(optimizer.plan(update))
    return plan[:-1]


def sent(optimizer: OptimizerProgram) -> tuple[Any, ...]:
    header, rows = optimizer.solve()
    return (header.number, header.update, header.first_tick, header.length, header.tau_u), [tuple(row) for row in rows]


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("fixed_ticks", [0, 10])
def test_whatever_arrives_is_answered_as_in_python(folder: Path, library: Path, seed: int, fixed_ticks: int) -> None:
    assignments = next(each for each in OPTIMISERS.values() if ("contraction" in str(each)) == is_tuned(folder))
    optimizer, c, rng = recorder(*assignments).optimizer, Exported(library), np.random.default_rng(seed)
    source = [each.update for each in recorded_updates(SHORT, "e", *assignments)]
    optimizer.restart(0.25 * fixed_ticks)
    assert c.library.optimizer_restart(fixed_ticks)
    tick = playing = 0
    for number in range(60):
        update = disturbed(source[number], tick, number, playing, rng)
        plan = of_python(optimizer, update)
        assert c.plan(update) == plan, number
        if rng.random() < 0.9:
            sequence = sent(optimizer)
            assert c.solve() == sequence, number
            playing = sequence[0][0]
        late = bool(rng.random() < 0.2)
        optimizer.answered(late=late)
        c.library.optimizer_answered(late)
        following = int(plan[1]) + int(rng.choice([0, 0, 0, 0, 3, 30, 2000]))
        tick = following if rng.random() < 0.9 else max(tick + 1, int(plan[1]) - 1)


def is_tuned(folder: Path) -> bool:
    return ".load_step = 1.0" in (folder / "constants.c").read_text()


@pytest.mark.usefixtures("programs")
def test_numbers_beyond_32_bits_and_periods_that_there_are_not_are_refused(library: Path, tmp_path: Path) -> None:
    c = Exported(Path(shutil.copy(library, tmp_path)))  # one that has not begun
    update = recorded_updates(SHORT, "e")[0].update
    assert c.plan(update) is None
    assert not any(c.library.optimizer_restart(period) for period in (-1, 1, 21))
    assert c.library.optimizer_restart(20)
    assert c.solve() is None
    largest = 2**31 - 1 - 2**16
    assert c.plan(update._replace(tick=largest + 1)) is None
    assert c.plan(update._replace(playing=-1)) is None
    assert c.plan(update._replace(tick=largest)) is not None


# -- what is not exported ----------------------------------------------------------------------------------------------


def test_double_precision_is_refused() -> None:
    double = "optimizer_plc.program.arithmetic=float64"
    settings = load_configuration(Settings, environment={}, assignments=[*SINGLE, double]).settings
    with pytest.raises(UsageError, match="in single precision alone"):
        UpdateRecorder(settings)
