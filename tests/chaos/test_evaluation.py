"""What is said about a run, on made-up recordings."""

import numpy as np
import pytest

from coldloop.process.cold_box import COLD_BOX, INPUT_NAMES, L1, OUTPUT_NAMES, STATE_NAMES, T5
from coldloop.registers.common import AlarmKind, Event, EventKind
from coldloop.registers.control_plc import Cause, Mode
from coldloop.registers.plant import PlantSample
from coldloop_chaos.faults import LinkCut, ProcessStop
from coldloop_chaos.report import Evaluation, RaisedAlarm, evaluate, table
from coldloop_chaos.sequencer import ChaosTrace, Mark
from coldloop_optimizer_plc.settings import ControlDesign

TICKS = 400
RATE = (0.5, 10.0, 0.1)
KILL = ProcessStop(kind="kill", process="optimizer", at_s=25, duration_s=25)
RESET = LinkCut(kind="reset", link="plant", at_s=75, duration_s=0.25)


def sample(
    tick: int, *, u: tuple[float, ...] = (43.0, 75.0, 36.0), level: float = 60.0, t5: float = 12.0
) -> PlantSample:
    y = [0.0] * len(OUTPUT_NAMES)
    y[L1], y[T5] = level, t5
    return PlantSample(tick, 385.0, u, tuple(y), (0.0,) * len(STATE_NAMES))


def quiet() -> ChaosTrace:
    trace = ChaosTrace(TICKS, COLD_BOX)
    for tick in range(TICKS):
        trace.sample(sample(tick))
    return trace


def mode(tick: int, new: Mode) -> Event:
    return Event(number=1, tick=tick, kind=EventKind.MODE, subject=new, cause=Cause.NONE)


def alarm(tick: int, kind: AlarmKind) -> Event:
    return Event(number=1, tick=tick, kind=EventKind.ALARM_RAISED, subject=kind)


def evaluated(trace: ChaosTrace, design: ControlDesign | None = None) -> Evaluation:
    return evaluate(trace, quiet().recording(), RATE, design or ControlDesign())


@pytest.fixture
def killed() -> ChaosTrace:
    """An optimiser that is away from tick 100 to 200, and a reset at tick 300."""
    trace = quiet()
    trace.events = [
        mode(0, Mode.MPC), alarm(101, AlarmKind.OPTIMIZER_LOST), mode(118, Mode.HOLD), mode(238, Mode.CLASSICAL),
        mode(250, Mode.MPC), alarm(302, AlarmKind.PLANT_LOST),
    ]  # fmt: skip
    trace.marks = [Mark(KILL, 100, 200, first_event=1), Mark(RESET, 300, 301, first_event=5)]
    return trace


def test_modes_alarms_and_the_way_back_belong_to_the_fault_before_them(killed: ChaosTrace) -> None:
    first, second = evaluated(killed).rows
    assert first.modes == ("MPC", "HOLD", "CLASSICAL", "MPC")
    assert first.alarms == (RaisedAlarm("OPTIMIZER_LOST", 0.25, 0.25),)
    assert (first.at_s, first.lasted_s, first.back_s) == (25.0, 25.0, 12.5)
    assert second.modes == ("MPC",)
    assert second.alarms == (RaisedAlarm("PLANT_LOST", 0.5, 0.5),)
    assert second.back_s == 0.0


def test_a_fault_that_never_ends_or_is_not_recovered_from_has_no_way_back(killed: ChaosTrace) -> None:
    killed.marks[1].end = None
    del killed.events[4]
    killed.marks[1].first_event = 4
    assert [row.back_s for row in evaluated(killed).rows] == [None, None]


def test_a_control_plc_that_was_started_again_is_not_in_mpc_because_it_was_before() -> None:
    trace = quiet()
    trace.events = [mode(0, Mode.MPC)]
    trace.marks = [Mark(KILL, 100, 100, first_event=1)]
    trace.events += [mode(100, Mode.HOLD), mode(110, Mode.MPC)]
    (row,) = evaluated(trace).rows
    assert row.modes == ("MPC", "HOLD", "MPC")
    assert row.back_s == 2.5


def test_steps_are_shares_of_their_limit_and_belong_to_the_tick_that_takes_them(killed: ChaosTrace) -> None:
    for tick in range(150, TICKS):
        killed.sample(sample(tick, u=(43.25, 75.0, 36.0)))
    for tick in range(350, TICKS):
        killed.sample(sample(tick, u=(43.25, 63.0, 36.0)))
    first, second = evaluated(killed).rows
    assert first.largest_steps == pytest.approx((0.5, 0.0, 0.0))
    assert second.largest_steps == pytest.approx((0.0, 1.2, 0.0))
    assert evaluated(killed).largest_steps == pytest.approx((0.5, 1.2, 0.0))


def test_time_outside_the_bands_is_counted_from_the_fault_on(killed: ChaosTrace) -> None:
    for tick in range(90, 110):
        killed.sample(sample(tick, level=61.5))
    for tick in range(310, 314):
        killed.sample(sample(tick, t5=8.5))
    first, second = evaluated(killed).rows
    assert (first.outside_s, second.outside_s) == ((2.5, 0.0), (0.0, 1.0))
    assert first.undisturbed_s == (0.0, 0.0)
    assert evaluated(killed).outside_s == (5.0, 1.0)


def test_ticks_that_nobody_saw_are_counted_and_disturb_nothing() -> None:
    trace = ChaosTrace(TICKS, COLD_BOX)
    for tick in (*range(100), *range(120, TICKS)):
        trace.sample(sample(tick))
    trace.marks = [Mark(KILL, 90, 200)]
    evaluation = evaluated(trace)
    assert evaluation.missing_ticks == 20
    assert evaluation.largest_steps == (0.0, 0.0, 0.0)
    assert np.isnan(trace.recording().u[100:120]).all()
    assert len(INPUT_NAMES) == trace.recording().u.shape[1]


def test_the_bands_of_the_configuration_are_those_that_are_judged_by() -> None:
    narrow = ControlDesign(output_low=(60.5, 9.0), output_high=(61.0, 11.5))
    assert evaluated(quiet()).outside_s == (0.0, 0.0)
    assert evaluated(quiet(), narrow).outside_s == (100.0, 100.0)
    assert evaluated(quiet(), narrow).undisturbed_s == (100.0, 100.0)


def test_a_run_without_faults_has_a_table_of_headings() -> None:
    evaluation = evaluated(quiet())
    assert evaluation.rows == []
    assert table(evaluation.rows, COLD_BOX).count("\n") == 1


def test_the_tables_have_a_line_a_fault(killed: ChaosTrace) -> None:
    text = table(evaluated(killed).rows, COLD_BOX)
    assert "MPC > HOLD > CLASSICAL > MPC" in text
    assert "optimizer lost 0.25" in text
    assert text.count("\n") == 3


def test_a_restless_run_still_has_a_table_that_can_be_read() -> None:
    trace = quiet()
    for tick in range(100, 300, 10):
        trace.events += [mode(tick, Mode.REST), alarm(tick, AlarmKind.SEQUENCE_LATE), mode(tick + 5, Mode.MPC)]
    trace.marks = [Mark(KILL, 90, 95)]
    (row,) = evaluated(trace).rows
    assert len(row.modes) == 40
    assert "REST > MPC > (32 more) > REST > MPC" in table([row], COLD_BOX)
    assert "sequence late 2.5 (x20)" in table([row], COLD_BOX)
