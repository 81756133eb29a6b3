"""The fail-safe ladder: MPC, the rest of a sequence, hold, the classical loops, and back; operators; bad sensors."""

import math
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import INPUT_NAMES, L1, OUTPUT_NAMES, T5
from coldloop.process.settings import InputLimits
from coldloop.registers.common import AlarmAction, AlarmCommand, AlarmKind, AlarmState, EventKind
from coldloop.registers.control_plc import Cause, Heartbeat, Mode, Operator, OperatorMode, Update, Verdict
from coldloop.registers.plant import Measurement
from coldloop_control_plc.program import ControlProgram
from tests.control_plc.conftest import HOLD_TICKS, alarm, section
from tests.harness.records import Row, as_transmitted

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

At = Callable[..., Row]
NewBench = Callable[..., "Bench"]

AT_REST = (43.0, 75.0, 36.0)


def modes(program: ControlProgram) -> list[tuple[Mode, Cause]]:
    return [
        (Mode(event.subject), Cause(event.cause)) for event in program.journal.since(0) if event.kind == EventKind.MODE
    ]


def steps(rows: Iterable[Row]) -> list[float]:
    """Largest step of each input between consecutive ticks."""
    pairs = list(pairwise(rows))
    return [max(abs(later[i] - earlier[i]) for earlier, later in pairs) for i in range(3)]


def test_a_silent_optimiser_leads_down_the_ladder_rung_by_rung(rig: "Bench", at: At) -> None:
    rig.play([at(0.2)] * 30, ticks=2)
    rig.scans(30 + HOLD_TICKS + 5)
    assert modes(rig.program) == [
        (Mode.HOLD, Cause.SESSION_STARTED),
        (Mode.MPC, Cause.SEQUENCE_BEGAN),
        (Mode.REST, Cause.SEQUENCE_LATE),
        (Mode.HOLD, Cause.SEQUENCE_EXHAUSTED),
        (Mode.CLASSICAL, Cause.HOLD_EXPIRED),
    ]
    assert [event.tick for event in rig.program.journal.since(0) if event.kind == EventKind.MODE] == [
        0, 2, 22, 32, 32 + HOLD_TICKS,
    ]  # fmt: skip
    for kind in (AlarmKind.MODE, AlarmKind.SEQUENCE_LATE, AlarmKind.SEQUENCE_EXHAUSTED):
        assert alarm(rig, kind) is AlarmState.UNACKNOWLEDGED


@pytest.mark.parametrize("mode", [OperatorMode.CLASSICAL, OperatorMode.MANUAL])
def test_an_operator_takes_over_without_a_bump_and_gives_back_without_one(
    rig: "Bench", at: At, mode: OperatorMode
) -> None:
    rig.play([at(0.2, 3.0)] * 40, ticks=2)
    applied = rig.scans(3)
    program = rig.program
    stale = rig.sequence([at(0.2)] * 20)
    program.operate(Operator(mode, tuple(applied[-1])))
    applied += rig.scans(40)
    assert program.mode is (Mode.CLASSICAL if mode is OperatorMode.CLASSICAL else Mode.MANUAL)
    assert program.ladder.cause == Cause.OPERATOR
    assert not program.awaiting_plan
    assert rig.offer(stale).verdict == Verdict.NOT_INVITED
    program.operate(Operator(OperatorMode.AUTO, tuple(applied[-1])))
    taken, update = rig.scan()
    applied.append(taken)
    assert update is not None, "the optimiser is invited at once"
    assert rig.plan(4)
    assert rig.offer(rig.sequence([taken._replace(cv155=taken.cv155 + 0.1)] * 20)).verdict == Verdict.ACCEPTED
    applied += rig.scans(5)
    assert program.mode is Mode.MPC
    assert steps(applied)[0] <= 0.1001
    assert steps(applied[1:40])[1] < 0.01


def test_manual_setpoints_are_clamped_and_approached_within_the_rate(rig: "Bench") -> None:
    rig.program.operate(Operator(OperatorMode.MANUAL, (100.0, 1000.0, 0.0)))
    applied = [Row(*AT_REST), *rig.scans(20 * 60)]
    assert applied[19].cv155 == pytest.approx(43.5)
    assert applied[-1].cv155 == 60.0
    assert applied[-1].ncr22 == 150.0
    limits = InputLimits()
    for tick in range(39, len(applied), 20):
        for i, rate in enumerate(limits.rate):
            assert abs(applied[tick][i] - applied[tick - 20][i]) <= rate
    assert all(step <= rate for step, rate in zip(steps(applied), limits.rate, strict=True))


def test_the_optimiser_is_lost_when_its_watchdog_expires_and_the_alarm_comes_in_that_scan(rig: "Bench") -> None:
    program = rig.program
    rig.scans(58)
    assert program.optimizer_present
    rig.scans(2)
    assert not program.optimizer_present
    assert program.alarms.rows[AlarmKind.OPTIMIZER_LOST].raised == 60
    assert not program.awaiting_plan, "lock-step does not wait for nobody"
    program.heartbeat(Heartbeat(1, 0xC01D1005))
    assert program.optimizer_present
    rig.scan()
    assert alarm(rig, AlarmKind.OPTIMIZER_LOST) is AlarmState.RETURNED
    assert program.watchdog.trips == 1


def test_an_optimiser_with_another_model_is_told(rig: "Bench") -> None:
    rig.program.heartbeat(Heartbeat(1, 0xBAD))
    assert alarm(rig, AlarmKind.MODEL_MISMATCH) is AlarmState.UNACKNOWLEDGED
    rig.program.heartbeat(Heartbeat(2, 0xC01D1005))
    assert alarm(rig, AlarmKind.MODEL_MISMATCH) is AlarmState.RETURNED


# -- sensors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reading", [math.nan, math.inf, -50.0, 1e6], ids=["nan", "inf", "low", "high"])
@pytest.mark.parametrize("output", [L1, T5, OUTPUT_NAMES.index("P4")], ids=lambda i: OUTPUT_NAMES[i])
def test_a_bad_measurement_is_replaced_by_the_last_good_one_and_told(rig: "Bench", output: int, reading: float) -> None:
    good = rig.program.process
    assert good is not None
    rig.readings[output] = reading
    rig.scans(3)
    process = rig.program.process
    assert process is not None
    assert process.y == good.y
    assert rig.program.bad_sensors == 1 << output
    row = rig.program.alarms.rows[AlarmKind.SENSOR_BAD]
    assert (row.state, row.cause, row.raised) == (AlarmState.UNACKNOWLEDGED, output, 1)
    del rig.readings[output]
    rig.scans(9)
    assert rig.program.bad_sensors == 0
    assert alarm(rig, AlarmKind.SENSOR_BAD) is AlarmState.RETURNED


def test_an_update_has_no_number_for_a_bad_measurement(rig: "Bench", at: At) -> None:
    p4 = OUTPUT_NAMES.index("P4")
    for reading, bad in ((None, []), (1e6, [p4]), (math.nan, [p4])):
        rig.play([at()] * 200, ticks=2)
        if reading is not None:
            rig.readings[p4] = reading
        _, update = rig.scan()
        assert update is not None
        assert [output for output, value in enumerate(update.y) if not math.isfinite(value)] == bad
        process = rig.program.process
        assert process is not None
        assert all(map(math.isfinite, process.y)), "the others see the last good value"


@pytest.mark.parametrize(("output", "stands", "moves"), [(L1, 1, 2), (T5, 2, 1)], ids=["L1", "T5"])
def test_a_controlled_output_that_stays_bad_ends_mpc_and_only_the_loop_that_needs_it(
    new_bench: NewBench, at: At, output: int, stands: int, moves: int
) -> None:
    rig = new_bench(InputLimits(), section(sensors={"estimated_s": 10.0}))
    rig.steady = True
    rig.scan()
    rig.play([at()] * 200, ticks=2)
    stale = rig.sequence([at()] * 20)
    rig.level, rig.temperature = 1.0, 1.0
    rig.scan()
    rig.readings[output] = math.nan
    rig.scans(41)
    assert rig.program.mode is not Mode.CLASSICAL, "it is bridged for 10 s"
    applied = rig.scans(60)
    assert rig.program.mode is Mode.CLASSICAL
    assert rig.program.ladder.cause == Cause.SENSOR_BAD
    assert len({row[stands] for row in applied}) == 1
    assert len({row[moves] for row in applied}) > 1
    assert rig.offer(stale).verdict == Verdict.NOT_INVITED
    del rig.readings[output]
    latched = [rig.scan()[1] for _ in range(10)]
    assert any(latched), "MPC is invited again"


@pytest.mark.parametrize(
    ("others", "lasts_s"), [(4, 60.0), (5, 10.0)], ids=["some others too", "more than an estimate can do without"]
)
def test_mpc_goes_on_without_the_level_for_as_long_as_an_estimate_is_believed(
    new_bench: NewBench, at: At, others: int, lasts_s: float
) -> None:
    bench = new_bench(InputLimits(), section(sensors={"estimated_s": 60.0}))
    bench.steady = bench.moving = True
    bench.scan()
    bench.play([at()] * 20, ticks=10)
    for output in (L1, *range(12, 12 + others)):
        bench.readings[output] = math.nan
    bench.scan()
    began = bench.program.tick
    while bench.program.mode in (Mode.MPC, Mode.REST) and bench.program.tick < began + 400:
        if bench.program.player.invited:
            bench.play([at()] * 20, ticks=10)
        bench.scan()
    assert (bench.program.tick - began) / 4 == pytest.approx(lasts_s, abs=3.0)
    assert (bench.program.mode, bench.program.ladder.cause) == (Mode.CLASSICAL, Cause.SENSOR_BAD)
    bench.scans(400)
    assert bench.program.mode is Mode.CLASSICAL, "it does not begin without it"


def test_another_sensor_that_stands_still_is_found_if_it_has_not_stood_so_long_before(new_bench: NewBench) -> None:
    """What is constant in a plant with exact sensors moves once or never; what rests at times has moved before."""
    p4, t1, constant = (OUTPUT_NAMES.index(name) for name in ("P4", "T1", "P2"))
    bench = new_bench(InputLimits(), section())
    bench.steady = bench.moving = True
    bench.scans(2)
    bench.readings[constant] = 16.0
    bench.scans(300)
    bench.readings[t1] = 4.5
    bench.scans(200)
    del bench.readings[t1]
    bench.scans(8)
    bench.readings[p4], bench.readings[t1] = 1.2, 4.5
    bench.scans(239)
    assert bench.program.bad_sensors == 0
    bench.scans(3)
    assert bench.program.bad_sensors == 1 << p4
    bench.scans(160)
    assert bench.program.bad_sensors == 1 << p4 | 1 << t1
    del bench.readings[p4]
    bench.scans(10)
    assert bench.program.bad_sensors == 1 << t1


def test_a_constant_that_was_dead_for_long_is_not_taken_for_frozen(new_bench: NewBench) -> None:
    p2 = OUTPUT_NAMES.index("P2")
    bench = new_bench(InputLimits(), section())
    bench.steady = bench.moving = True
    bench.readings[p2] = math.nan
    bench.scans(300)
    bench.readings[p2] = 16.0
    bench.scans(400)
    assert bench.program.bad_sensors == 0


def test_exact_sensors_of_one_kind_may_rest_while_noisy_ones_of_the_other_move(new_bench: NewBench) -> None:
    bench = new_bench(InputLimits(), section())
    bench.steady = bench.moving = True
    bench.scans(300)
    bench.readings = dict.fromkeys(range(12, 22), 1.5)
    bench.scans(400)
    assert bench.program.bad_sensors == 0


def test_an_input_without_effect_is_an_alarm_until_it_acts_again(rig: "Bench", at: At) -> None:
    program, valve = rig.program, INPUT_NAMES.index("CV156")
    for bits, state in ((1 << len(OUTPUT_NAMES) + valve, AlarmState.UNACKNOWLEDGED), (0, AlarmState.RETURNED)):
        rig.suspects = bits
        rig.play([at()] * 20, ticks=2)
        rig.scan()
        assert alarm(rig, AlarmKind.INPUT_WITHOUT_EFFECT) is state
        assert alarm(rig, AlarmKind.SENSOR_SUSPECT) is AlarmState.NORMAL
        assert program.player.suspects == bits
    assert program.alarms.rows[AlarmKind.INPUT_WITHOUT_EFFECT].cause == valve


def test_what_the_optimiser_does_without_is_an_alarm_while_it_drives(rig: "Bench", at: At) -> None:
    program = rig.program
    rig.suspects = 1 << T5
    rig.play([at()] * 20, ticks=2)
    rig.scan()
    row = program.alarms.rows[AlarmKind.SENSOR_SUSPECT]
    assert (row.active, row.cause, row.times) == (1, T5, 1)
    assert program.bad_sensors == 0, "the loops still work with it"
    rig.suspects |= 1 << L1
    rig.play([at()] * 20, ticks=2)
    rig.scan()
    row = program.alarms.rows[AlarmKind.SENSOR_SUSPECT]
    assert (row.active, row.cause, row.times) == (1, L1, 2)
    program.operate(Operator(OperatorMode.CLASSICAL, tuple(AT_REST)))
    rig.scans(2)
    assert alarm(rig, AlarmKind.SENSOR_SUSPECT) is AlarmState.RETURNED
    events = [(each.subject, each.cause) for each in program.journal.since(0) if each.kind == EventKind.SENSOR]
    assert events == [(T5, 2), (L1, 2), (L1, 0), (T5, 0)]


def test_a_frozen_level_is_found_while_others_move_and_a_process_at_rest_is_not_taken_for_it(
    rig: "Bench", new_bench: NewBench
) -> None:
    rig.scans(200)
    assert rig.program.bad_sensors == 0, "all stand: the process is at rest"
    lively = new_bench(InputLimits(), section())
    lively.steady = lively.moving = True
    lively.scans(100)
    assert lively.program.bad_sensors == 0
    lively.readings[L1] = 60.0
    lively.scans(79)
    assert lively.program.bad_sensors == 0
    lively.scans(3)
    assert lively.program.bad_sensors == 1 << L1


@pytest.mark.parametrize("rests", [True, False])
def test_an_image_that_stands_still_as_a_whole_is_an_old_one_unless_the_plant_may_rest(
    new_bench: NewBench, *, rests: bool
) -> None:
    bench = new_bench(InputLimits(), section(sensors={"may_rest": rests}))
    bench.steady = bench.frozen = True
    bench.scans(200)
    assert bool(bench.program.bad_sensors) is not rests
    bench.program.operate(Operator(OperatorMode.MANUAL, (43.1, 75.0, 36.0)))
    bench.scans(100)
    assert bench.program.bad_sensors == 2**22 - 1, "the inputs have moved, and nothing else"
    assert alarm(bench, AlarmKind.SENSOR_BAD) is AlarmState.UNACKNOWLEDGED
    bench.moving = True
    bench.scans(20)
    assert bench.program.bad_sensors == 0


def test_a_state_that_is_no_number_is_not_worked_with(rig: "Bench") -> None:
    program = rig.program
    program.begin_scan()
    bad = Measurement(program.tick, rig.load, rig.outputs(), (math.nan,) * 28, 1, (0.0,) * 3)
    assert program.end_scan(bad) is None
    assert not program.awaiting_plan
    _, update = rig.scan()
    assert isinstance(update, Update)


# -- restarts and leaps ------------------------------------------------------------------------------------------------


def test_after_a_restart_the_session_goes_on_from_what_is_applied(rig: "Bench", at: At) -> None:
    program = rig.program
    applied = as_transmitted(at(0.4, -8.0))
    program.resume(7, 500, applied, updates=31, operator=Operator(OperatorMode.AUTO, tuple(applied)))
    row, update = rig.scan()
    assert row == applied
    assert update is not None
    assert (update.session, update.update, update.tick, update.playing) == (7, 31, 500, 0)
    assert (program.mode, program.ladder.cause) == (Mode.HOLD, Cause.RESTARTED)
    assert rig.plan(3)
    assert rig.offer(rig.sequence([applied] * 5)).verdict == Verdict.ACCEPTED


def test_outputs_that_a_safe_state_left_outside_the_bounds_are_brought_back_within_the_rate(rig: "Bench") -> None:
    rig.program.rejoin(100, (10.0, 75.0, 36.0))
    applied = [Row(10.0, 75.0, 36.0), *rig.scans(20 * 25)]
    assert applied[-1].cv155 >= 20.0
    assert steps(applied)[0] <= 0.5


def test_after_a_leap_of_time_the_sequence_goes_on_where_it_would_be(rig: "Bench", at: At) -> None:
    rig.play([at(0.01 * row) for row in range(40)], ticks=2)
    rig.scans(3)
    rig.program.rejoin(15, rig.program.applied)
    row, _ = rig.scan()
    assert row == as_transmitted(at(0.13))
    rig.program.rejoin(100, rig.program.applied)
    row, update = rig.scan()
    assert rig.program.mode is Mode.HOLD
    assert update is not None
    assert update.tick == 100


# -- corners -----------------------------------------------------------------------------------------------------------


def test_a_commit_that_arrives_twice_does_not_let_the_loops_move_before_it_begins(rig: "Bench", at: At) -> None:
    rig.play([at()] * 2, ticks=2)
    rig.level = 1.0
    rig.scans(2 + 20 + HOLD_TICKS + 60)
    assert rig.program.mode is Mode.CLASSICAL
    rig.program.abandon()
    rig.scan()
    assert rig.plan(20)
    sequence = rig.sequence([rig.program.applied] * 20)
    assert rig.offer(sequence).verdict == Verdict.ACCEPTED
    assert rig.offer(sequence).verdict == Verdict.REPEATED
    assert len(set(rig.scans(20))) == 1


def test_each_sensor_that_fails_raises_the_alarm_again(rig: "Bench") -> None:
    rig.readings[L1] = math.nan
    rig.scans(2)
    rig.program.alarms.command(AlarmCommand(AlarmKind.SENSOR_BAD, AlarmAction.ACKNOWLEDGE))
    rig.readings[T5] = math.nan
    rig.scans(2)
    row = rig.program.alarms.rows[AlarmKind.SENSOR_BAD]
    assert (row.state, row.cause, row.times) == (AlarmState.UNACKNOWLEDGED, T5, 2)


def test_a_sensor_that_fails_now_and_then_is_not_bridged_for_ever(rig: "Bench") -> None:
    for tick in range(200):
        rig.readings[L1] = math.nan if tick % 8 == 0 else 60.0
        rig.scan()
    assert rig.program.mode is Mode.CLASSICAL
    assert rig.program.ladder.cause == Cause.SENSOR_BAD


def test_an_operator_who_gives_back_the_loops_to_nobody_sees_the_alarm(rig: "Bench") -> None:
    program = rig.program
    program.operate(Operator(OperatorMode.CLASSICAL, tuple(AT_REST)))
    rig.scans(5)
    assert (program.ladder.cause, alarm(rig, AlarmKind.MODE)) == (Cause.OPERATOR, AlarmState.NORMAL)
    program.operate(Operator(OperatorMode.AUTO, tuple(AT_REST)))
    rig.scan()
    assert (program.mode, alarm(rig, AlarmKind.MODE)) == (Mode.CLASSICAL, AlarmState.UNACKNOWLEDGED)


def test_manual_begins_with_what_is_applied(rig: "Bench", at: At) -> None:
    rig.play([at(0.4, 8.0)] * 40, ticks=2)
    rig.scans(3)
    assert rig.program.track()
    assert rig.program.operator.u == rig.program.applied
    rig.program.operate(rig.program.operator._replace(mode=OperatorMode.MANUAL))
    assert set(rig.scans(40)) == {as_transmitted(at(0.4, 8.0))}
    assert not rig.program.track()
