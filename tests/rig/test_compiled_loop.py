"""The compiled loop and the programs leave the same trace, the same updates and the same events."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import coldloop_rig.cosim.compiled.loops  # noqa: F401 lets numba compile what is plain Python
from coldloop.config import load_configuration
from coldloop.kernels.compiled import kernel
from coldloop.kernels.single_precision import neighbour, single
from coldloop.process.declaration import LAST_NUMBER
from coldloop.process.load_profile import LoadProfile
from coldloop.process.settings import InputLimits, RateReference
from coldloop.registers.common import EventKind
from coldloop.registers.control_plc import Cause, CoolDownStep, Mode, OperatorMode
from coldloop_control_plc.output_limits import admit, beginning, plain
from coldloop_control_plc.player import latch, latches
from coldloop_control_plc.program import make_program
from coldloop_control_plc.scan import Scan, decide, observe
from coldloop_plant.kinds import own_header
from coldloop_rig.cosim.compiled import stretches
from coldloop_rig.cosim.compiled.records import as_arrays, record_of, scan_records
from coldloop_rig.cosim.compiled.stretches import CompiledStretches, Stretch
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import MemorySink, Recorder
from coldloop_rig.settings import Settings
from tests.harness.configurations import COMPILED, LEFT_TO_PROGRAMS, UNUSUAL

pytestmark = pytest.mark.usefixtures("compiles")


class Left(NamedTuple):
    """What a run leaves behind."""

    trace: str
    updates: list[Any]
    events: list[Any]


class Counted(CompiledStretches):
    """Counts the ticks that the compiled loop does."""

    ticks = 0

    def ahead(self, until: int) -> Stretch | None:
        stretch = super().ahead(until)
        Counted.ticks += len(stretch.block.load) if stretch else 0
        return stretch


def left_by(assignments: tuple[str, ...], load: LoadProfile, ticks: int, *, compiled: bool) -> Left:
    chosen = load_configuration(Settings, environment={}, assignments=assignments).settings
    sink = MemorySink()
    recorder = Recorder(ticks, [sink])
    period_s = chosen.optimizer_plc.program.updating_period_s
    OneProcessRig(chosen, compiled=compiled).run(Scenario(ticks, load, period_s, seed=3), recorder)
    recorder.close()
    recording = sink.recording(recorder.link)
    events = [(service, event.tick, event.kind, event.subject, event.cause) for service, event in sink.events]
    return Left(recording.trace_sha256, recording.updates, events)


USUALLY = {
    "adaptive", "load steps that interrupt", "refrigerator", "single precision", "osqp",
    "sequences that are refused", "an impatient watchdog", "loads that cannot be held", "suspects",
}  # fmt: skip
"""One of each kind; the others differ from one of them in a part of the configuration."""
NEARLY_ALL = {"adaptive": 1250, "hybrid": 1250, "load steps that interrupt": 1250, "refrigerator": 1000}
"""Of 1500 ticks that the loop does at least, where nothing unusual happens."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in USUALLY else pytest.mark.night)
        for name in (*COMPILED, *LEFT_TO_PROGRAMS, *UNUSUAL)
    ],
)
def test_the_compiled_loop_leaves_what_the_programs_leave(
    name: str, lively: LoadProfile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stretches, "CompiledStretches", Counted)
    monkeypatch.setattr(Counted, "ticks", 0)
    assignments = (COMPILED | LEFT_TO_PROGRAMS | UNUSUAL)[name]
    loops, programs = (left_by(assignments, lively, 1500, compiled=compiled) for compiled in (True, False))
    assert loops == programs
    assert Counted.ticks >= NEARLY_ALL.get(name, 0)
    if name == "suspects":
        causes = [cause for _, _, kind, _, cause in loops.events if kind == EventKind.SENSOR]
        assert set(causes) == {0, 2}, "they come and go, and none stands still"
        assert len(causes) > 20
    if name == "the classical loops":
        assert not Counted.ticks


# -- arithmetic that is plain Python in the control PLC ----------------------------------------------------------------


@kernel
def compiled_single(value: float) -> float:
    return single(value)


@kernel
def compiled_neighbour(value: float, target: float) -> float:
    return neighbour(value, target)


@kernel
def compiled_admit(guard: Any, limits: Any, tick: int, wanted: Any, update: bool) -> None:  # noqa: ANN401, FBT001 a kernel
    admit(guard[0], limits, tick, wanted, update)


values = (
    st.floats(-1e30, 1e30)
    | st.floats(0.0, 200.0, width=32)
    | st.floats(-(2.0**-122), 2.0**-122, width=32)
    | st.integers(-149, 126).map(lambda exponent: 2.0**exponent)
    | st.just(0.0)
)


@given(value=values, target=values)
def test_single_precision_is_the_same_compiled(value: float, target: float) -> None:
    assert compiled_single(value) == single(value)
    own = single(value)
    found = neighbour(own, target)
    assert compiled_neighbour(own, target) == found
    assert math.copysign(1.0, compiled_neighbour(own, target)) == math.copysign(1.0, found)
    assert found == np.nextafter(np.float32(own), np.float32(math.inf if target > own else -math.inf))


anything = st.floats(-20.0, 180.0) | st.floats(allow_nan=True, allow_infinity=True)
scans = st.lists(st.tuples(st.tuples(anything, anything, anything), st.booleans(), st.integers(1, 30)), max_size=30)


@given(history=scans, slew_s=st.sampled_from([0.25, 0.5, 2.0, 5.0]), reference=st.sampled_from(RateReference))
def test_the_guard_is_the_same_compiled(
    history: list[tuple[tuple[float, float, float], bool, int]], slew_s: float, reference: RateReference
) -> None:
    limits = plain(InputLimits(slew_s=slew_s, rate_reference=reference))
    state = beginning(limits, (43.0, 75.0, 36.0))
    records, tick = record_of(state), 0
    for wanted, update, ticks in history:
        for repetition in range(ticks):
            began = update and repetition == 0
            admit(state, limits, tick, wanted, began)
            compiled_admit(records, limits, tick, np.array(wanted), began)
            assert records[0]["applied"].tolist() == list(state.applied)
            assert (records[0]["share"], records[0]["moved"]) == (state.share, state.moved)
            tick += 1


def do_tick(c: Any, s: Scan, tick: int, rows: Any, y: Any, x: Any, load: float) -> tuple[bool, bool]:  # noqa: ANN401 rows
    """Do what the control PLC does in a tick."""
    changed = decide(c, s, tick, rows)
    told = observe(c, s, tick, y, x, load)
    if latches(s.player, tick, load):
        latch(s.player, tick, load, 20)
    return changed, told


inner_tick = kernel(do_tick)


@kernel
def compiled_tick(c: Any, parts: Any, tick: int, rows: Any, y: Any, x: Any, load: float) -> tuple[bool, bool]:  # noqa: ANN401 a kernel
    s = Scan(
        parts.guard[0], parts.ladder[0], parts.player[0], parts.sensors[0], parts.alarms[0], parts.watchdog[0]
    )  # fmt: skip
    return inner_tick(c, s, tick, rows, y, x, load)


counts = st.integers(0, 300)
ticks = st.integers(-2, 300)
readings = st.sampled_from([0.0, 4.5, 12.0, 60.0, 75.0, 200.0, 2350.0, math.nan, math.inf, -1e30])


@st.composite
def any_scan(draw: st.DrawFn) -> dict[str, dict[str, Any]]:
    """Draw the state of a scan, by parts and names."""

    def some(kind: st.SearchStrategy[Any], size: int) -> list[Any]:
        return draw(st.lists(kind, min_size=size, max_size=size))

    flags = st.booleans()
    return {
        "guard": {"lag": draw(st.integers(0, 3)), "newest": draw(st.integers(0, 305)), "start": draw(counts)},
        "ladder": {
            "mode": draw(st.sampled_from(Mode)).value, "cause": draw(st.sampled_from(Cause)).value,
            "since": draw(counts), "setpoints": some(readings, 3), "errors": some(readings, 22),
            "step": draw(st.sampled_from(CoolDownStep)).value, "has_begun": draw(flags), "settled_since": draw(ticks),
            "operator": draw(st.sampled_from(OperatorMode)).value, "optimizer_present": draw(flags),
            "is_measured": draw(flags), "handshake_failed": draw(counts), "held_from": draw(st.integers(-1, 300)),
            "held_for_answer": draw(flags), "answer_failed": draw(flags), "seen": draw(ticks), "executed": draw(ticks),
        },
        "watchdog": {"triggered": draw(counts), "expired": draw(flags), "time": draw(st.sampled_from([0, 60, 290]))},
        "player": {
            "phase": draw(st.integers(0, 5)), "has_update": draw(flags), "invited": draw(flags), "late": draw(flags),
            "has_answer": draw(flags), "slot": draw(st.integers(0, 1)), "next_update_tick": draw(counts),
            "load_step": draw(st.sampled_from([0.0, 10.0])), "update_load": draw(st.sampled_from([375.0, 385.0])),
            "first_ticks": some(counts, 2), "lengths": some(counts, 2), "periods": some(st.integers(0, 20), 2),
            "missed": draw(ticks), "updates": draw(st.sampled_from([7, LAST_NUMBER])),
        },
        "sensors": {
            "tick": draw(ticks), "good": some(readings, 22), "before": some(readings, 22),
            "unchanged": some(counts, 22), "rests": some(st.integers(-240, 300), 22), "inputs_moved": some(ticks, 22),
            "inputs": [[43.0, 75.0, each] for each in some(readings, 22)], "standing": some(flags, 22),
            "bad_since": (bad := some(st.integers(-1, 0), 22)), "bad_count": sum(each >= 0 for each in bad),
            "good_since": some(st.integers(-1, 0), 22), "x": some(readings, 28), "load": draw(readings),
            "image_count": draw(counts), "image_moved": draw(flags),
        },
        "alarms": {"active": some(flags, 23), "since": some(st.sampled_from([2**62, 0, 200, 299]), 23)},
    }  # fmt: skip


measured = st.tuples(
    st.lists(readings, min_size=22, max_size=22), st.booleans(), st.sampled_from([375.0, 385.0, 1e9, math.nan])
)


@given(state=any_scan(), measurements=st.lists(measured, min_size=1, max_size=4), as_one=st.booleans())
def test_a_scan_is_the_same_compiled(
    state: dict[str, dict[str, Any]], measurements: list[Any], *, as_one: bool
) -> None:
    """From any state whatever: an alarm's condition and a sensor's rule are written once, and run in both ways."""
    section = Settings().control_plc
    program = make_program(own_header(Settings().model.file), section, InputLimits())
    sensors = program.sensors.constants._replace(each_may_rest=not as_one)
    program.scan_constants = program.scan_constants._replace(sensors=sensors)
    for part, values in state.items():
        for name, value in values.items():
            setattr(getattr(program.scan, part), name, value)
    records, constants = scan_records(program.scan), as_arrays(program.scan_constants)
    rows = np.full((2, 310, 3), (43.0, 75.0, 36.0)) + 0.1 * np.sin(np.arange(310))[:, None]
    for tick, (read, again, load) in enumerate(measurements, start=300):
        y, x = program.sensors.before[:] if again else read, program.sensors.x[:]
        told = do_tick(program.scan_constants, program.scan, tick, rows.tolist(), y, x, load)
        assert told == compiled_tick(constants, records, tick, rows, np.array(y), np.array(x), load)
        for part, record in zip(program.scan, records, strict=True):
            assert repr(record_of(part)[0]) == repr(record[0])
