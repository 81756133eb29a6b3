"""A load step may end an updating period: the control PLC then latches an update at once."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from coldloop.registers.control_plc import Verdict
from tests.harness.records import Row, as_transmitted

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

At = Callable[..., Row]


def test_a_load_step_latches_an_update_and_what_is_played_goes_on(bench: "Bench", at: At) -> None:
    bench.play([at(0.1)] * 40, ticks=2)
    bench.scan()
    assert bench.plan(10, load_step=10.0)
    assert bench.offer(bench.sequence([at(0.2)] * 20)).verdict == Verdict.ACCEPTED
    bench.scans(3)
    before = bench.program.player.update
    bench.load += 10.5
    applied, update = bench.scan()
    assert applied == as_transmitted(at(0.1))
    assert before is not None
    assert update is not None
    assert (update.update, update.tick) == (before.update + 1, before.tick + 4)
    assert update.load == pytest.approx(bench.load)
    assert bench.program.awaiting_plan
    assert bench.scans(8)[-1] == as_transmitted(at(0.1)), "the sequence for the old instant is not played"


def test_the_answer_to_the_interrupted_update_is_refused_and_the_new_one_taken(bench: "Bench", at: At) -> None:
    assert bench.plan(10, load_step=10.0)
    late = bench.sequence([at(0.3)] * 20)
    bench.load -= 20.0
    bench.scan()
    assert bench.offer(late).verdict == Verdict.WRONG_UPDATE
    assert bench.plan(4)
    assert bench.offer(bench.sequence([at(0.2)] * 20)).verdict == Verdict.ACCEPTED
    assert bench.scans(4)[-1] == as_transmitted(at(0.2))


@pytest.mark.parametrize(("load_step", "moved"), [(0.0, 300.0), (10.0, 9.9)], ids=["not asked for", "too small"])
def test_other_moves_of_the_load_interrupt_nothing(bench: "Bench", load_step: float, moved: float) -> None:
    assert bench.plan(10, load_step=load_step)
    bench.load += moved
    assert [bench.scan()[1] for _ in range(9)] == [None] * 9
    assert bench.scan()[1] is not None


def test_a_move_before_the_plan_arrives_counts_at_the_next_scan(bench: "Bench") -> None:
    bench.load += 50.0
    assert bench.scan()[1] is None
    assert bench.plan(10, load_step=10.0)
    assert bench.scan()[1] is not None


def test_lock_step_waits_at_once_for_a_sequence_that_may_be_interrupted(bench: "Bench", at: At) -> None:
    assert bench.plan(10, load_step=10.0)
    assert bench.program.awaiting_sequence
    assert bench.offer(bench.sequence([at()] * 20)).verdict == Verdict.ACCEPTED
    assert not bench.program.awaiting_sequence


def test_lock_step_does_not_wait_for_ever_for_an_optimiser_whose_answer_was_refused(bench: "Bench", at: At) -> None:
    assert bench.plan(3)
    bench.scans(2)
    assert bench.program.awaiting_sequence
    assert bench.offer(bench.sequence([at(30.0)] * 20)).verdict == Verdict.OUT_OF_RANGE
    assert not bench.program.awaiting_sequence
    assert bench.scan()[1] is not None
    assert bench.program.player.deadline_misses == 1
