"""Scans that are missed, exchanges that fail, time that leaps: timers go by plant time, sequences by their ticks."""

import json
import math
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import COLD_BOX, L1, T5
from coldloop.process.settings import InputLimits
from coldloop.registers.common import AlarmKind
from coldloop.registers.control_plc import LinkCause, Mode, Operator, OperatorMode, Verdict
from coldloop.session import TimeBase
from coldloop_control_plc.output_limits import OutputGuard
from coldloop_control_plc.sessions import ControlStateStore, RetainedControlState
from tests.harness.records import Row, as_transmitted

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.control_plc.conftest import Bench

    At = Callable[..., Row]

U0 = Row(43.0, 75.0, 36.0)


def skip(bench: "Bench", ticks: int) -> None:
    """Let ticks go by without a scan, as when the rack was away; it still applies what it was sent."""
    bench.program.rejoin(bench.program.tick + ticks, bench.program.applied)


def fail_exchange(bench: "Bench", applied: Row) -> None:
    """Begin a scan whose exchange fails, and go on at the same tick from what the rack applies."""
    bench.program.begin_scan()
    bench.program.interrupt()
    bench.program.rejoin(bench.program.tick, applied)


def test_a_bad_level_is_bridged_for_its_time_with_one_scan_in_four_ticks(bench: "Bench") -> None:
    bench.steady = bench.moving = True
    bench.readings[L1] = math.nan
    began = bench.program.tick
    while bench.program.mode is not Mode.CLASSICAL:
        bench.scan()
        skip(bench, 3)
        assert bench.program.tick - began < 200
    bridged_s = (bench.program.tick - began) * 0.25
    assert 10.0 <= bridged_s <= 12.0


@pytest.mark.parametrize("missed", [0, 1, 3, 6])
def test_the_classical_loops_execute_once_a_period_whatever_scans_are_missed(bench: "Bench", missed: int) -> None:
    bench.steady = True
    bench.level = -0.5
    bench.program.operate(Operator(OperatorMode.CLASSICAL, tuple(U0)))
    bench.scan()
    skip(bench, 2)  # never again at a multiple of the period with 3 ticks missed
    heater = [bench.program.applied[1]]
    began = bench.program.tick
    while bench.program.tick - began < 200:
        heater.append(bench.scan()[0].ncr22)
        skip(bench, missed)
    executions = sum(later != earlier for earlier, later in pairwise(heater))
    assert 8 <= executions <= 11, "ten periods of 5 s"
    # du = K T/T_i e in each period: -100 W/% x 5 s/300 s x 0.5 % (the level is low: less heat)
    assert heater[-1] - heater[0] == pytest.approx(-100 * (bench.program.tick - began) * 0.25 / 300 * 0.5, abs=1.7)


def test_an_exchange_that_fails_again_and_again_counts_a_miss_once(bench: "Bench") -> None:
    assert bench.plan(10)
    bench.scans(9)
    for _ in range(5):
        fail_exchange(bench, U0)
    bench.scan()
    assert bench.program.player.deadline_misses == 1


def test_a_lock_step_runtime_does_not_wait_for_a_sequence_that_has_begun(bench: "Bench", at: "At") -> None:
    bench.play([at(0.3)] * 20, ticks=10)
    fail_exchange(bench, U0)
    assert not bench.program.awaiting_sequence


def test_a_sequence_that_begins_long_after_its_tick_is_the_rest_of_one(bench: "Bench", at: "At") -> None:
    bench.play([at(0.3)] * 200, ticks=10)
    skip(bench, 113)
    applied, update = bench.scan()
    assert applied == as_transmitted(at(0.3))
    assert bench.program.mode is Mode.REST
    assert update is not None, "the optimiser is asked anew at once"


def test_an_optimiser_that_gave_signs_while_the_rack_was_away_is_not_lost(bench: "Bench", at: "At") -> None:
    bench.play([at(0.3)] * 240, ticks=10)
    bench.scan()
    bench.program.alarms.now = bench.program.tick + 100
    bench.program.optimizer_seen()
    skip(bench, 101)
    bench.scan()
    assert bench.program.optimizer_present


def test_time_that_goes_back_begins_anew(bench: "Bench", at: "At") -> None:
    """A rack whose session was restarted under the same number: no sequence of a later time is played."""
    bench.steady = bench.moving = True
    bench.program.rejoin(50_000, U0)
    bench.scan()
    bench.play([at(0.3)] * 240, ticks=10)
    bench.scan()
    bench.program.rejoin(0, U0)
    told = bench.program.alarms.rows[AlarmKind.CLOCK_SKEW]
    assert (told.times, told.cause) == (1, LinkCause.TIME_JUMP)
    assert bench.program.remaining == 0
    assert bench.program.player.playing == 0
    applied, update = bench.scan()
    assert (applied, bench.program.mode) == (U0, Mode.HOLD)
    assert update is not None
    assert bench.program.ladder.since <= 1
    assert bench.program.watchdog.triggered <= bench.program.tick, "or it would not expire before the later time"


def test_a_tick_back_changes_nothing_of_what_is_played(bench: "Bench", at: "At") -> None:
    bench.play([at(0.3)] * 40, ticks=10)
    bench.scans(3)
    tick = bench.program.tick
    bench.program.rejoin(tick - 1, bench.program.applied)
    assert bench.scan()[0] == as_transmitted(at(0.3))
    assert bench.program.tick == tick
    assert bench.program.remaining <= 40


def test_the_guard_never_takes_over_what_is_no_number() -> None:
    guard = OutputGuard(InputLimits(), U0)
    guard.begin_at(7, Row(math.nan, math.inf, 36.0))
    assert guard.applied == U0
    assert guard.admit(7, Row(math.nan, 80.0, -math.inf), update=True) == Row(43.0, 80.0, 36.0)


def test_no_input_moves_by_more_than_its_rate_within_the_slew_time_however_many_sequences_begin() -> None:
    guard = OutputGuard(InputLimits(slew_s=1.0), U0)
    applied = [guard.admit(tick, U0._replace(ncr22=150.0), update=True)[1] for tick in range(12)]
    for tick in range(12):
        for later in range(tick + 1, min(12, tick + 4)):
            assert applied[later] - applied[tick] <= 10.0
    assert applied[-1] == pytest.approx(75.0 + 10.0 * 3)


def test_a_sequence_is_judged_as_it_would_be_played(bench: "Bench", at: "At") -> None:
    """Two steps of the full rate in neighbouring ticks are within no rate, whatever the windows say."""
    assert bench.plan(10)
    zigzag = [at(0.5), at(0.0), at(-0.5)] * 6
    assert bench.offer(bench.sequence(zigzag)).verdict == Verdict.RATE_EXCEEDED
    assert bench.offer(bench.sequence([at(0.5)] * 18)).verdict == Verdict.ACCEPTED


def test_a_sensor_that_shows_nothing_new_for_a_while_without_scans_is_frozen_by_plant_time(bench: "Bench") -> None:
    bench.steady = bench.moving = True
    bench.readings[T5] = 10.4
    began = bench.program.tick
    while not bench.program.bad_sensors:
        bench.scan()
        skip(bench, 3)
        assert bench.program.tick - began < 200
    assert 20.0 <= (bench.program.tick - began) * 0.25 <= 22.0


def test_after_a_restart_the_rest_of_what_was_played_is_played_on(bench: "Bench", at: "At") -> None:
    bench.play([at(0.3)] * 40, ticks=10)
    bench.scans(3)
    program = bench.program
    playing, tick, applied = program.player.sequence, program.tick, program.applied
    program.restart(session=0)
    program.resume(1, tick + 5, applied, updates=7, operator=program.operator, playing=playing)
    row, update = bench.scan()
    assert row == as_transmitted(at(0.3))
    assert program.mode is Mode.REST
    assert update is not None
    assert update.update == 7, "the optimiser is asked anew at once"


def test_the_time_of_the_watchdog_that_an_operator_set_outlasts_a_restart(bench: "Bench") -> None:
    program = bench.program
    program.watchdog.set(240, program.tick)
    content = ControlStateStore(None, 0, COLD_BOX).content(program, TimeBase(realtime=False, factor=1.0))
    kept = RetainedControlState.parsed(json.loads(json.dumps(content)), COLD_BOX)
    program.watchdog.set(60, program.tick)
    program.recall(kept.operator, kept.alarms, kept.watchdog, kept.tick)
    assert program.watchdog.registers(program.tick).time == 240
