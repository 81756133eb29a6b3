"""Exchanges that fail, time that leaps, and what is measured that is no number: scan by scan."""

import math
from typing import TYPE_CHECKING

import pytest

from coldloop.registers.codec import WordOrder, codec_of
from coldloop.registers.common import AlarmKind
from coldloop.registers.control_plc import Cause, Mode, Status, Verdict
from tests.harness.records import CONTROL_MAP, Row

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.control_plc.conftest import Bench

    At = Callable[..., Row]


def test_an_exchange_that_fails_at_the_first_tick_of_a_sequence_is_neither_a_miss_nor_late(
    bench: "Bench", at: "At"
) -> None:
    bench.play([at(cv155=0.2)] * 40, 8)
    program = bench.program
    for _ in range(3):
        applied = program.applied
        program.begin_scan()
        program.interrupt()
        program.rejoin(program.tick, applied)
    assert bench.scan()[0] == pytest.approx(at(cv155=0.2))
    assert (program.mode, program.ladder.cause) == (Mode.MPC, Cause.SEQUENCE_BEGAN)
    assert program.player.deadline_misses == 0
    assert not program.player.late
    assert program.alarms.rows[AlarmKind.SEQUENCE_LATE].times == 0


def test_a_rack_that_has_been_away_for_a_while_takes_no_new_sequence(bench: "Bench", at: "At") -> None:
    assert bench.plan(8)
    bench.program.alarms.now = bench.program.tick + 5
    assert bench.offer(bench.sequence([at()] * 20)).verdict == Verdict.PLANT_LOST
    bench.program.alarms.now = bench.program.tick
    assert bench.offer(bench.sequence([at()] * 20)).verdict == Verdict.ACCEPTED


@pytest.mark.parametrize("back", [1, 19, 20, 21, 500, 100_000])
def test_when_the_tick_goes_back_what_remains_of_a_sequence_still_fits_its_register(
    back: int, bench: "Bench", at: "At"
) -> None:
    program = bench.program
    program.rejoin(100_000, program.applied)
    bench.scan()
    bench.play([at(cv155=0.2)] * 40, 8)
    bench.scan()
    program.rejoin(max(0, program.tick - back), program.applied)
    for _ in range(30):
        assert 0 <= program.remaining <= 40
        codec_of(CONTROL_MAP.block_of(Status), WordOrder.HIGH_FIRST).encode(
            Status(0, 0, 0, 0, program.remaining, 0, 0, 0, 0, 0.0, 0.0)
        )
        bench.scan()


@pytest.mark.parametrize("load", [math.nan, math.inf, -math.inf, 1e30, -1.0])
def test_a_load_that_makes_no_sense_ends_mpc_as_a_bad_sensor(load: float, bench: "Bench", at: "At") -> None:
    bench.play([at(cv155=0.2)] * 40, 8)
    bench.scan()
    assert bench.program.mode is Mode.MPC
    bench.load = load
    bench.scans(2)
    assert bench.program.ladder.cause == Cause.SENSOR_BAD
    assert all(map(math.isfinite, bench.scan()[0]))
