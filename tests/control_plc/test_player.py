from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.declaration import LAST_NUMBER
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Mode, Plan, Update, Verdict
from coldloop_control_plc.output_limits import OutputGuard
from coldloop_control_plc.player import SequencePlayer
from tests.harness.records import Row, as_transmitted

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

At = Callable[..., Row]


def test_a_session_begins_with_the_initial_inputs_and_an_update_at_tick_0(
    new_bench: "Callable[[InputLimits], Bench]", at: At
) -> None:
    bench = new_bench(InputLimits())
    applied, update = bench.scan()
    assert applied == at()
    assert update is not None
    assert (update.session, update.update, update.tick, update.playing) == (1, 0, 0, 0)
    assert update.u == update.u_before == tuple(at())
    assert bench.program.mode is Mode.HOLD
    assert bench.program.awaiting_plan


@given(ticks=st.integers(1, 30), length=st.integers(1, 40))
def test_a_sequence_takes_effect_exactly_at_its_first_tick_and_plays_a_row_a_tick(
    new_bench: "Callable[[InputLimits], Bench]", at: At, ticks: int, length: int
) -> None:
    bench = new_bench(InputLimits())
    bench.scan()
    rows = [at(0.2 + 0.005 * tick, -5.0 + 0.1 * tick, 0.05) for tick in range(length)]
    before = bench.play(rows, ticks)
    assert set(before) <= {at()}
    assert bench.program.mode is Mode.HOLD
    applied, modes, remaining = [], [], []
    for _ in range(length + 3):
        row, _ = bench.scan()
        applied.append(row)
        modes.append(bench.program.mode)
        remaining.append(bench.program.remaining)
    expected = [as_transmitted(row) for row in rows]
    assert applied == expected + [expected[-1]] * 3, "the last value holds"
    in_time = min(length, 20)  # then the latest instant for its successor has passed
    assert modes == [Mode.MPC] * in_time + [Mode.REST] * (length - in_time) + [Mode.HOLD] * 3
    assert remaining[0] == length - 1
    assert remaining[-1] == 0


def test_the_update_at_the_first_tick_of_a_sequence_tells_both_inputs(bench: "Bench", at: At) -> None:
    bench.play([at(0.5)] * 20, ticks=3)
    actuators = bench.program.begin_scan()
    measurement = bench.measurement(actuators)
    update = bench.program.end_scan(measurement)
    assert update is not None
    assert (update.update, update.tick, update.playing) == (1, 3, 1)
    assert (update.u_before, update.u) == (tuple(at()), tuple(at(0.5)))
    assert (update.load, update.y, update.x) == (measurement.load, measurement.y, measurement.x)
    assert bench.program.player.update == update


def test_updates_are_numbered_from_0_again_after_the_last_number() -> None:
    limits = InputLimits()
    player = SequencePlayer(OutputGuard(limits, Row(43.0, 75.0, 36.0)), 0, updates=LAST_NUMBER)
    empty = Update(1, 0, 0, 0, 385.0, (43.0,) * 3, (43.0,) * 3, (0.0,) * 22, (0.0,) * 28)
    assert [player.latch(empty).update for _ in range(2)] == [LAST_NUMBER, 0]


def test_the_process_image_is_that_of_the_last_scan(bench: "Bench", at: At) -> None:
    bench.scans(2)
    process = bench.program.process
    assert process is not None
    assert (process.tick, process.u, process.y[0]) == (2, tuple(at()), 2.0)


def test_a_newer_sequence_takes_over_from_one_that_is_still_being_played(bench: "Bench", at: At) -> None:
    bench.play([at(0.1)] * 40, ticks=2)
    bench.scan()
    applied = bench.play([at(0.2)] * 40, ticks=5) + bench.scans(2)
    assert applied == [as_transmitted(at(0.1))] * 4 + [as_transmitted(at(0.2))] * 2
    assert bench.program.player.playing == 2


def test_without_an_answer_the_rest_plays_the_last_value_holds_and_the_miss_is_counted(bench: "Bench", at: At) -> None:
    bench.play([at(0.1)] * 5 + [at(0.2)] * 5, ticks=2)
    bench.scan()
    assert bench.plan(4)
    applied = bench.scans(4)
    program = bench.program
    assert program.player.deadline_misses == 1
    assert program.player.update is not None
    assert (program.player.update.update, program.player.update.tick, program.player.update.playing) == (2, 6, 1)
    applied += bench.scans(10)
    assert applied == [as_transmitted(at(0.1))] * 4 + [as_transmitted(at(0.2))] * 10
    assert program.player.deadline_misses == 1, "there is no further instant before the next plan"
    assert program.awaiting_plan


def test_after_a_missed_deadline_the_next_answer_takes_over(bench: "Bench", at: At) -> None:
    assert bench.plan(3)
    bench.scans(4)
    assert bench.program.player.deadline_misses == 1
    assert bench.plan(5)
    assert bench.offer(bench.sequence([at(0.3)] * 20)).verdict == Verdict.ACCEPTED
    assert bench.scans(5)[-1] == as_transmitted(at(0.3))
    assert (bench.program.player.deadline_misses, bench.program.mode) == (1, Mode.MPC)


def test_lock_step_waits_for_a_plan_after_each_update_and_for_a_sequence_at_the_instant(bench: "Bench", at: At) -> None:
    program = bench.program
    assert program.awaiting_plan
    assert bench.plan(2)
    assert not program.awaiting_plan
    assert not program.awaiting_sequence
    bench.scan()
    assert program.awaiting_sequence
    assert bench.offer(bench.sequence([at()] * 20)).verdict == Verdict.ACCEPTED
    assert not program.awaiting_sequence
    bench.scan()
    assert program.awaiting_plan


@pytest.mark.parametrize("plan", [Plan(1, 9), Plan(0, 0), Plan(0, 3)], ids=["another update", "at once", "passed"])
def test_a_plan_for_another_update_or_for_the_past_is_refused(bench: "Bench", plan: Plan) -> None:
    bench.scans(3)
    assert not bench.program.accept_plan(plan)
    assert bench.program.awaiting_plan
    assert bench.program.player.next_update_tick == 20  # the latest instant possible


def test_a_plan_is_taken_once(bench: "Bench") -> None:
    assert bench.plan(4)
    assert not bench.plan(8)
    assert bench.program.player.next_update_tick == 4


def test_there_is_nothing_to_plan_before_the_first_scan(new_bench: "Callable[[InputLimits], Bench]") -> None:
    program = new_bench(InputLimits()).program
    assert not program.accept_plan(Plan(0, 5))
    program.abandon()
    assert program.player.next_update_tick == 0


@pytest.mark.parametrize("planned", [False, True], ids=["before its plan", "after its plan"])
def test_an_optimiser_that_lost_the_thread_gets_a_new_update_at_the_next_scan(
    bench: "Bench", at: At, *, planned: bool
) -> None:
    bench.play([at(0.1)] * 40, ticks=2)
    bench.scan()
    lost = bench.program.player.update
    assert lost is not None
    if planned:
        assert bench.plan(10)
    bench.scans(2)
    bench.program.abandon()
    assert not bench.program.awaiting_plan
    assert not bench.program.awaiting_sequence
    stale = bench.sequence([at(0.2)] * 20)
    applied, update = bench.scan()
    assert applied == as_transmitted(at(0.1)), "what is played goes on"
    assert update is not None
    assert update.update == lost.update + 1
    assert bench.offer(stale).verdict == Verdict.LATE
    assert bench.plan(3)
    assert bench.offer(bench.sequence([at(0.2)] * 20)).verdict == Verdict.ACCEPTED
    assert bench.scans(3)[-1] == as_transmitted(at(0.2))


def test_an_accepted_sequence_is_not_abandoned(bench: "Bench", at: At) -> None:
    assert bench.plan(3)
    assert bench.offer(bench.sequence([at(0.2)] * 20)).verdict == Verdict.ACCEPTED
    bench.program.abandon()
    assert bench.program.player.next_update_tick == 3
    assert bench.scans(3)[-1] == as_transmitted(at(0.2))


def test_a_new_session_begins_at_tick_0_and_remembers_nothing(bench: "Bench", at: At) -> None:
    bench.play([at(0.5)] * 40, ticks=2)
    bench.scans(3)
    program = bench.program
    program.restart(session=2)
    assert (program.tick, program.player.playing, program.player.accepted, program.player.deadline_misses) == (
        0,
        0,
        0,
        0,
    )
    assert program.player.update is None
    assert program.process is None
    applied, update = bench.scan()
    assert applied == at()
    assert update is not None
    assert (update.session, update.update) == (2, 0)
    assert bench.plan(2)
    assert bench.offer(bench.sequence([at(0.1)] * 5, number=1)).verdict == Verdict.ACCEPTED
