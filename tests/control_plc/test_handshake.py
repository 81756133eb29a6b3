"""From the classical loops back to MPC: when the loops hold still for the optimiser's first sequence."""

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from coldloop.process.settings import InputLimits
from coldloop.registers.common import AlarmKind, AlarmState
from coldloop.registers.control_plc import Mode, Verdict
from coldloop_control_plc import scan
from coldloop_control_plc.scan import move_loops
from tests.control_plc.conftest import HOLD_TICKS, alarm
from tests.harness.records import Row, as_transmitted

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

At = Callable[..., Row]
NewBench = Callable[..., "Bench"]


def test_the_optimiser_comes_back_through_a_handshake_from_the_input_being_applied(rig: "Bench", at: At) -> None:
    rig.play([at(0.2)] * 5, ticks=2)
    rig.level = 1.0  # the loops have something to do
    rig.scans(5 + 20 + HOLD_TICKS + 60)
    program = rig.program
    assert program.mode is Mode.CLASSICAL
    program.abandon()
    _, update = rig.scan()
    assert update is not None
    assert update.playing == 0
    assert rig.plan(18)
    start = Row(*update.u)
    assert start != at(0.2), "the loops have moved the inputs"
    first = start._replace(cv155=start.cv155 + 0.3)
    assert rig.offer(rig.sequence([first] * 20)).verdict == Verdict.ACCEPTED
    applied = rig.scans(18)
    assert set(applied[:-1]) == {start}, "the loops stand still for the handshake"
    assert applied[-1] == as_transmitted(first)
    assert program.mode is Mode.MPC
    assert alarm(rig, AlarmKind.MODE) is AlarmState.RETURNED


def test_a_handshake_that_comes_to_nothing_does_not_keep_the_loops_from_working(rig: "Bench", at: At) -> None:
    rig.play([at()] * 2, ticks=2)
    rig.level = 1.0
    rig.scans(2 + 20 + HOLD_TICKS + 30)
    assert rig.program.mode is Mode.CLASSICAL
    moved = []
    for _ in range(6):
        rig.program.abandon()
        rig.scan()
        assert rig.plan(20)
        applied = rig.scans(20)  # planned, and nothing sent
        moved.append(len(set(applied)) > 1)
    assert moved.count(True) >= 4


@pytest.mark.parametrize("period", [14, 16, 18, 19, 20])
@pytest.mark.parametrize("phase", range(0, 20, 2))
def test_an_optimiser_whose_answers_are_refused_gets_its_handshake_after_the_pause(
    rig: "Bench", phase: int, period: int, at: At
) -> None:
    """The loops move the inputs between update and answer, so that it is beyond the rates, as often as it is tried."""
    program = rig.program
    rig.temperature = 2.0
    rig.play([at()] * 2, ticks=2)
    rig.scans(2 + 20 + HOLD_TICKS + 30)
    rig.scans((phase - program.tick) % 20)
    program.abandon()
    rig.scan()
    began = program.tick
    for _ in range(3):
        assert rig.plan(period)
        rig.scans(period)  # and nothing is sent: a handshake that comes to nothing, and two more broken promises
    assert program.mode is Mode.CLASSICAL
    while program.mode is not Mode.MPC and program.tick < began + 400:
        update = program.player.update
        assert update is not None
        first = Row(*update.u)
        assert rig.plan(period)
        rig.scans(10)
        rig.offer(rig.sequence([first._replace(cv156=first.cv156 - 0.1)] * 40))
        rig.scans(period - 10)
    assert program.mode is Mode.MPC
    assert program.tick <= began + 120 + 3 * period, "a failure, a pause of 30 s and a handshake"


def test_loops_that_have_waited_for_the_hold_to_end_do_not_wait_for_a_late_optimiser(
    new_bench: NewBench, monkeypatch: pytest.MonkeyPatch, at: At
) -> None:
    rig = new_bench(InputLimits())
    rig.steady = True
    rig.scan()
    rig.play([at()] * 2, ticks=2)
    at_work: list[int] = []
    monkeypatch.setattr(scan, "move_loops", lambda _, __, tick: at_work.append(tick))
    while rig.program.mode is not Mode.CLASSICAL:
        if rig.program.player.awaiting_plan:
            rig.plan(20)
        rig.scan()
    assert at_work == [rig.program.tick - 1], "at once, though a sequence has been promised again"


class LoopsAtWork:
    """Bench whose loops drive; the ticks at which they were at work. What is held is not seen where rates hold too."""

    def __init__(self, bench: "Bench", monkeypatch: pytest.MonkeyPatch) -> None:
        bench.level = 1.0
        bench.scans(2 + 20 + HOLD_TICKS + 30)
        self.program = bench.program
        assert self.program.mode is Mode.CLASSICAL
        self.program.abandon()
        self.begun = self.program.tick
        self.ticks: list[int] = []
        monkeypatch.setattr(scan, "move_loops", self._work)

    def _work(self, c: scan.ScanConstants, s: scan.Scan, tick: int) -> None:
        self.ticks.append(tick)
        move_loops(c, s, tick)

    def check(self) -> None:
        """Demand that they are held for 5 s at a time, and then not for 30 s."""
        passed = self.program.tick - self.begun
        assert max(after - before for before, after in pairwise([self.begun, *self.ticks])) <= 20 + 1
        assert passed - len(self.ticks) <= passed * 20 / 140 + 40


WAYS = ("silence", "abandoned", "interrupted", "interrupted answers", "an answer far ahead")


@pytest.mark.parametrize("way", WAYS)
def test_an_optimiser_that_plans_and_never_delivers_does_not_hold_the_loops(
    rig: "Bench", way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, far = rig.program, way in {"silence", "an answer far ahead"}
    at_work = LoopsAtWork(rig, monkeypatch)
    for tick in range(1200):
        if program.player.awaiting_plan:
            rig.plan(239 if far else 20, load_step=0.25 if "interrupted" in way else 0.0)
        if "answer" in way and not program.player.has_answer:
            rig.offer(rig.sequence([program.applied] * 20))
        if way == "abandoned" and tick % 15 == 14:
            program.abandon()
        if "interrupted" in way and tick % 15 == 14:
            rig.load = 768.5 - rig.load
        rig.scan()
        if program.mode is not Mode.CLASSICAL:
            break
    at_work.check()


def test_answers_that_load_steps_drop_and_promises_that_are_broken_in_turns_do_not_hold_the_loops(
    rig: "Bench", monkeypatch: pytest.MonkeyPatch
) -> None:
    program, at_work = rig.program, LoopsAtWork(rig, monkeypatch)
    rig.scan()
    for _ in range(70):
        assert rig.plan(20, load_step=0.25)
        assert rig.offer(rig.sequence([program.applied] * 20)).verdict == Verdict.ACCEPTED
        rig.scans(14)
        rig.load = 768.5 - rig.load
        rig.scan()
        assert rig.plan(2)
        rig.scans(2)
        assert program.mode is Mode.CLASSICAL
    at_work.check()
