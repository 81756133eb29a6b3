"""The exported output guard applies and judges what the control PLC's own does, and its self-test tells."""

import ctypes
import math
import re
import subprocess
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import TICK_S
from coldloop.process.settings import InputLimits, RateReference
from coldloop.registers.control_plc import Verdict
from coldloop_control_plc.output_limits import OutputGuard, begin
from coldloop_export.c_files import GuardExport
from coldloop_export.counting import counted_guard, counted_longest
from coldloop_export.golden import Call, GoldenCall, GuardKernels, Judgement, golden_calls
from coldloop_export.st_files import GuardText
from tests.harness.records import Row
from tests.plc_export import matiec
from tests.plc_export.c_programs import COMPILERS, NO_COMPILER, SANITIZED, STRICT, compiled, output, write
from tests.plc_export.st_interpreter import Machine

LIMITS = {
    "default": InputLimits(),
    "elapsed, slow": InputLimits(rate_reference=RateReference.ELAPSED, slew_s=2.5),
    "odd numbers": InputLimits(low=(20.1, 0.3, 20.2), high=(59.9, 149.9, 60.2), rate=(0.1, 7.7, 1 / 3)),
}
NUMBER = {
    "c": re.compile(r"(?<=[ {])-?\d\.\d{9,17}e[+-]\d\df?"),
    "st": re.compile(r"LREAL#\d\.\d{16}E[+-]\d\d"),
}
LARGEST = float(np.finfo(np.float32).max)
MIDDLE = Row(43.0, 75.0, 36.0)

needs_a_compiler = pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)
each_limits = pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)


def in_c(limits: InputLimits) -> dict[str, str]:
    return GuardExport(GuardKernels(limits), golden_calls(limits), TICK_S).files()


def in_text(limits: InputLimits) -> dict[str, str]:
    return GuardText(GuardKernels(limits), golden_calls(limits)).files()


# -- golden calls ------------------------------------------------------------------------------------------------------


@each_limits
def test_golden_calls_have_all_that_can_be_asked_and_said(limits: InputLimits) -> None:
    golden = golden_calls(limits)
    assert golden == golden_calls(limits)
    count = Counter(each.call for each in golden)
    assert golden[0].call is Call.RESTART
    assert min(count[Call.SCAN], count[Call.RESUME], count[Call.JUDGE]) >= 5
    assert {each.judgement for each in golden if each.call is Call.JUDGE} == set(Judgement)
    assert any(not all(map(math.isfinite, each.given)) for each in golden)
    assert any(each.applied != each.given for each in golden if each.call is Call.SCAN)


@each_limits
def test_golden_calls_are_answered_as_by_the_guard_of_the_control_plc(limits: InputLimits) -> None:
    golden = golden_calls(limits)
    for each in golden:
        if each.call is Call.RESTART:
            guard = OutputGuard(limits, MIDDLE)
            begin(guard.state, guard.limits, each.given)
            continue
        assert answered(guard, each) == (each.applied, each.judgement)


def answered(guard: OutputGuard, call: GoldenCall) -> tuple[tuple[float, ...], Judgement]:
    """Return what the guard applies after a call, and what it says."""
    judgement = Judgement.ACCEPTED
    given = Row(*call.given)
    if call.call is Call.SCAN:
        guard.admit(call.tick, given, update=call.update)
    elif call.call is Call.RESUME:
        guard.begin_at(call.tick, given)
    else:
        rows = [Row(*row) for row in call.rows]
        held = call.first_tick - call.tick - len(call.meanwhile)
        meanwhile = [*(Row(*row) for row in call.meanwhile), *[None] * held]
        verdict = guard.judge(rows, call.first_tick, meanwhile)
        good = Judgement.ACCEPTED if verdict is Verdict.ACCEPTED else Judgement.RATE_EXCEEDED
        judgement = Judgement.OUT_OF_RANGE if guard.out_of_range(rows) else good
    return tuple(guard.state.applied), judgement


# -- C99 ---------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("programs")
@needs_a_compiler
@pytest.mark.parametrize("compiler", COMPILERS)
@each_limits
def test_the_self_test_in_c_passes(tmp_path: Path, compiler: str, limits: InputLimits) -> None:
    write(tmp_path, in_c(limits))
    said = f"{len(golden_calls(limits))} golden calls, 0 failures\n"
    assert output(compiled(tmp_path, compiler, *SANITIZED)) == (0, said)


@pytest.mark.usefixtures("programs")
@needs_a_compiler
@pytest.mark.parametrize(("name", "share"), [("limits.c", 0.0), ("limits.c", 0.9), ("golden.c", 0.999)])
def test_a_changed_bit_in_c_is_found(tmp_path: Path, name: str, share: float) -> None:
    texts = in_c(InputLimits())
    numbers = list(NUMBER["c"].finditer(texts[name]))
    found = numbers[int(share * len(numbers))]
    single = found[0].endswith("f")
    real = np.float32 if single else np.float64
    after = np.nextafter(real(found[0].rstrip("f")), real(np.inf))
    changed = f"{after:.9e}f" if single else f"{after:.17e}"
    texts[name] = texts[name][: found.start()] + changed + texts[name][found.end() :]
    write(tmp_path, texts)
    code, said = output(compiled(tmp_path, COMPILERS[0], "-O1"))
    assert code == 1
    assert "is not what was written" in said


CHANGES = {
    "an output is not compared": ("admits", "i < 3", "i < 2"),
    "the end of a sequence is not": ("admits", "k < stop", "k < 8 && k < stop"),
    "what is no number is wanted": ("nearest", "!(isfinite(wanted) != 0)", "wanted == INFINITY"),
    "what is no number was applied": ("resume", "(isfinite(applied[i]) != 0)", "true"),
    "what is no number is in range": ("in_range", "inside && (", "(inside && isnan(row[i])) ? true : inside && ("),
    "in range is out of bounds": ("resume", "!in_range(", "in_range("),
    "far moves still limit": ("resume", "state->moves[slot] = -32768", "state->moves[slot] = state->moves[slot]"),
    "what is played before counts as updates": ("judge", "false);", "true);"),
    "not all that is played before counts": ("judge", "k < stop", "k < 4 && k < stop"),
    "no slack": ("in_range", "(limits->high[i] + limits->slack[i])", "limits->high[i]"),
    "a longer window": ("admit", ">= 20", ">= 21"),
    "another window for what is judged": ("copy_state", "target->anchor[i] = source->anchor[i]",
                                          "target->anchor[i] = source->applied[i]"),
    "one slot less": ("nearest", "slot < stop", "slot + 1 < stop"),
    "no way back from beyond the bounds": ("admit", "&& (!state->out_of_bounds)", ""),
}  # fmt: skip


@pytest.mark.usefixtures("programs")
@needs_a_compiler
@pytest.mark.night
@pytest.mark.parametrize(("kernel", "old", "new"), CHANGES.values(), ids=CHANGES)
def test_a_guard_in_c_that_does_something_else_is_found(tmp_path: Path, kernel: str, old: str, new: str) -> None:
    texts = in_c(InputLimits())
    whole = texts["kernels.c"]
    first = whole.index(f" {kernel}(\n")
    body = whole[first : whole.index("\n}\n", first)]
    assert old in body
    texts["kernels.c"] = whole.replace(body, body.replace(old, new, 1))
    write(tmp_path, texts)
    code, said = output(compiled(tmp_path, COMPILERS[0], "-O1"))
    assert code == 1
    assert "of golden call" in said


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], ctypes.CDLL]:
    """Return the exported guard for some of the limits as a library of this process."""
    known: dict[str, ctypes.CDLL] = {}

    def load(name: str) -> ctypes.CDLL:
        if name not in known:
            folder = tmp_path_factory.mktemp("guard")
            write(folder, in_c(LIMITS[name]))
            sources = [folder / each for each in ("kernels.c", "limits.c", "output_guard.c")]
            made = folder / "guard.so"
            subprocess.run([COMPILERS[0], *STRICT, "-O2", "-shared", "-fPIC", *sources, "-lm", "-o", made], check=True)
            known[name] = ctypes.CDLL(str(made))
        return known[name]

    return load


near, anything = st.floats(-20.0, 180.0, width=32), st.floats(allow_nan=True, allow_infinity=True, width=32)
some_rows = st.tuples(*[near | near | anything] * 3)
steps = st.one_of(
    st.tuples(st.just("scan"), some_rows, st.booleans(), st.integers(1, 30)),
    st.tuples(st.just("resume"), some_rows, st.booleans(), st.integers(1, 30)),
    st.tuples(st.just("judge"), some_rows, st.booleans(), st.integers(1, 20)),
)


@pytest.mark.usefixtures("programs")
@needs_a_compiler
@given(name=st.sampled_from(list(LIMITS)), course=st.lists(steps, max_size=25))
def test_whatever_is_asked_the_guard_in_c_has_the_bits_of_ours(
    loaded: Callable[[str], ctypes.CDLL], name: str, course: list[tuple[str, tuple[float, ...], bool, int]]
) -> None:
    theirs, ours, tick = loaded(name), OutputGuard(LIMITS[name], MIDDLE), 0
    assert theirs.guard_restart(floats(*MIDDLE))
    for what, row, flag, ticks in course:
        wanted = Row(*row)
        if what == "resume":
            tick += ticks
            assert theirs.guard_resume(tick, floats(*row))
            ours.begin_at(tick, wanted)
        elif what == "judge":
            ahead = 3 * ticks
            rows = [wanted if k >= 10 or flag else ours.applied for k in range(ticks)]
            expected = ours.judge(rows, tick + ahead, [wanted, *[None] * (ahead - 1)])
            offered = floats(*(each for one in rows for each in one))
            said = theirs.guard_judge(tick, floats(*row), 1, tick + ahead, offered, ticks)
            if ours.out_of_range(rows):
                assert said == Judgement.OUT_OF_RANGE
            else:
                assert said == (Judgement.ACCEPTED if expected is Verdict.ACCEPTED else Judgement.RATE_EXCEEDED)
        else:
            for k in range(ticks):
                room = floats(0.0, 0.0, 0.0)
                assert theirs.guard_scan(tick, flag and k == 0, floats(*row), room)
                assert tuple(room) == tuple(ours.admit(tick, wanted, update=flag and k == 0))
                tick += 1


def floats(*values: float) -> "ctypes.Array[ctypes.c_float]":
    return (ctypes.c_float * len(values))(*values)


@pytest.mark.usefixtures("programs")
@needs_a_compiler
def test_what_cannot_be_is_refused_in_c(loaded: Callable[[str], ctypes.CDLL]) -> None:
    guard, row, rows = loaded("default"), floats(*MIDDLE), floats(*MIDDLE * 240)
    assert not guard.guard_restart(floats(43.0, math.nan, 36.0))
    assert guard.guard_restart(row)
    for tick in (-1, 2**31 - 1):
        assert not guard.guard_scan(tick, False, row, floats(0.0, 0.0, 0.0))  # noqa: FBT003 C's own
        assert not guard.guard_resume(tick, row)
    refused = 3
    for tick, coming, first_tick, length in (
        (-1, 0, 5, 1), (5, 0, 4, 1), (5, 0, 5, 0), (5, 0, 5, 241), (5, 2, 6, 1), (5, -1, 6, 1), (5, 0, 246, 1),
    ):  # fmt: skip
        assert guard.guard_judge(tick, rows, coming, first_tick, rows, length) == refused
    assert guard.guard_judge(5, rows, 1, 6, rows, 240) == Judgement.ACCEPTED


# -- Structured Text ---------------------------------------------------------------------------------------------------


def self_test(texts: Mapping[str, str]) -> tuple[bool, int]:
    """Return verdict and what failed first, from where a register table would have them."""
    machine = Machine(*texts.values())
    program, verdict = machine.instance("cg_main"), machine.globals.cg_verdict
    while not verdict[0]:
        program.run_()
    assert (program.test.passed, program.test.what) == (bool(verdict[1]), verdict[3])
    return bool(verdict[1]), verdict[3]


@each_limits
def test_the_self_test_in_structured_text_passes(limits: InputLimits) -> None:
    assert self_test(in_text(limits)) == (True, 0)


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("place", [0, 13, 900, -1])
def test_a_changed_bit_in_structured_text_is_found(place: int) -> None:
    texts = in_text(InputLimits())
    text = texts["configuration.st"]
    found = list(NUMBER["st"].finditer(text))[place]
    after = np.nextafter(float(found[0].removeprefix("LREAL#")), np.inf)
    texts["configuration.st"] = f"{text[: found.start()]}LREAL#{after:.16E}{text[found.end() :]}"
    assert self_test(texts) == (False, 4)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("((tick - cl_guard_start) >= cg", "((tick - cl_guard_start) + 1 >= cg", 8),
        ("judgement := 2;", "judgement := 1;", 7),
        ("accepted := (cl_guard_begun AND (tick >= 0)", "accepted := (cl_guard_begun AND (tick >= 300)", 6),
    ],
)
def test_a_guard_that_does_something_else_is_found(old: str, new: str, what: int) -> None:
    texts = {name: text.replace(old, new) for name, text in in_text(InputLimits()).items()}
    assert self_test(texts) == (False, what)


@pytest.mark.usefixtures("programs")
@matiec.NEEDS_MATIEC
@pytest.mark.parametrize("name", LIMITS)
def test_the_self_test_passes_in_native_code(tmp_path: Path, name: str) -> None:
    assert matiec.self_test(tmp_path, in_text(LIMITS[name]).values(), "-O2") == "1 1 0"


def test_before_a_restart_and_for_what_cannot_be_nothing_is_done() -> None:
    machine = Machine(*in_text(InputLimits()).values())
    scan, restart = machine.instance("cl_guard_scan"), machine.instance("cl_guard_restart")
    scan.tick, scan.update = 0, True
    scan.wanted, scan.applied = ({i: np.float32(each) for i, each in enumerate(MIDDLE)} for _ in range(2))
    scan.run_()
    assert not scan.accepted
    restart.applied = {0: np.float32(43.0), 1: np.float32(LARGEST), 2: np.float32(36.0)}
    restart.run_()
    assert not restart.accepted
    restart.applied = {i: np.float32(each) for i, each in enumerate(MIDDLE)}
    restart.run_()
    scan.run_()
    assert restart.accepted
    assert scan.accepted


# -- what it costs -----------------------------------------------------------------------------------------------------


def test_operations_are_those_counted_by_hand() -> None:
    kernels, moved = GuardKernels(InputLimits()), Row(43.25, 74.0, 36.0625)
    calls = [GoldenCall(Call.RESTART, 0, MIDDLE, MIDDLE), GoldenCall(Call.SCAN, 1, MIDDLE, MIDDLE),
             GoldenCall(Call.SCAN, 2, moved, moved),
             GoldenCall(Call.JUDGE, 3, moved, moved, first_tick=3, rows=(moved, moved))]  # fmt: skip
    counted = counted_guard(kernels, calls)
    assert counted["scan"].least == 0, "what stays as it is takes none"
    assert counted["scan"].most == 3 * (1 + 4 + 3), "of each output: the reach, both ends from both rows, is it reached"
    assert counted["judgement"].most == 2 * 3, "of each row and output: how far what is applied is from it"
    assert counted_longest(kernels) > 240 * counted["scan"].most
