"""The state machine of the optimiser's link: which state follows which, what is counted, noted and logged."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.errors import (
    ColdloopError,
    DamagedAnswerError,
    ModelFileError,
    PeerUnreachableError,
    RequestRefusedError,
    UntrustedPeerError,
)
from coldloop.registers.common import EventKind
from coldloop.registers.optimizer_plc import ControlLinkState, ControlLinkStatus
from coldloop.service.journal import Journal
from coldloop_optimizer_plc.control_link import REPEAT_S, ControlLink

S = ControlLinkState
BUSY = RequestRefusedError("another client holds the lease", 6)
NO_SUCH_REGISTER = RequestRefusedError("no such register", 2)
GONE = PeerUnreachableError("did not answer in time")
OTHER_MODEL = ModelFileError("another model")
DAMAGED = DamagedAnswerError("arrived damaged")


class Watched:
    """A link, its journal, and how often it has reported an event."""

    def __init__(self) -> None:
        self.journal = Journal(now=lambda: 0.0)
        self.told = 0
        self.link = ControlLink(0xABCD, self.journal, self._tell)

    def _tell(self) -> None:
        self.told += 1

    def up(self) -> ControlLink:
        self.link.answered()
        self.link.introduced()
        return self.link

    @property
    def noted(self) -> list[int]:
        return [event.subject for event in self.journal.since(0) if event.kind == EventKind.CONTROL_LINK]


def test_an_update_takes_the_link_from_searching_to_waiting_and_around() -> None:
    watched = Watched()
    link = watched.link
    shown = []
    for call in [*CALLS[:4], CALLS[6]]:
        call(link)
        shown.append(link.registers().state)
    assert shown == [S.INTRODUCING, S.WAITING, S.COMPUTING, S.DELIVERING, S.WAITING]
    assert watched.noted == [S.WAITING]
    assert link.registers() == ControlLinkStatus(S.WAITING, 0xABCD)


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (GONE, S.SEARCHING), (UntrustedPeerError("expired"), S.SEARCHING), (DAMAGED, S.SEARCHING),
        (NO_SUCH_REGISTER, S.SEARCHING), (BUSY, S.OTHER_MASTER), (OTHER_MODEL, S.WRONG_MODEL),
    ],
)  # fmt: skip
def test_the_kind_of_failure_decides_the_state(error: ColdloopError, state: S) -> None:
    watched = Watched()
    link = watched.up()
    link.failed(error)
    assert link.state is state
    assert link.registers().breaks == 1
    assert watched.noted == [S.WAITING, state]


def test_a_foreign_link_stays_foreign_while_it_tries_again_and_then_waits() -> None:
    watched = Watched()
    link = watched.link
    for _ in range(3):
        link.answered()
        link.failed(BUSY)
    link.answered()
    assert link.state is S.OTHER_MASTER
    link.introduced()
    assert watched.noted == [S.OTHER_MASTER, S.WAITING]
    assert link.registers().breaks == 0  # it had never been up


def test_each_thing_that_goes_wrong_has_its_counter() -> None:
    link = Watched().up()
    link.go(S.COMPUTING)
    link.go(S.WAITING, interrupted=1)
    link.go(S.COMPUTING)
    link.damaged()
    link.go(S.DELIVERING)
    link.go(S.WAITING, rejected=1)
    link.failed(DAMAGED)
    assert link.registers() == ControlLinkStatus(S.SEARCHING, 0xABCD, breaks=1, damaged=2, rejected=1, interrupted=1)


def test_steps_that_make_no_sense_are_errors_of_the_program() -> None:
    link = Watched().up()
    with pytest.raises(RuntimeError, match="WAITING to DELIVERING"):
        link.go(S.DELIVERING)


@pytest.mark.parametrize(("error", "pause_s"), [(GONE, 0.2), (BUSY, 1.0), (OTHER_MODEL, 1.0)])
def test_attempts_that_fail_at_once_are_spaced(error: ColdloopError, pause_s: float) -> None:
    link = Watched().link
    assert link.pause_s(100.0) == 0.0
    link.attempt(100.0)
    link.failed(error)
    assert link.pause_s(100.0) == pytest.approx(pause_s)
    assert link.pause_s(100.0 + pause_s / 4) == pytest.approx(0.75 * pause_s)


def test_a_link_that_was_up_for_a_while_is_looked_for_at_once() -> None:
    watched = Watched()
    watched.link.attempt(100.0)
    watched.up()
    watched.link.failed(GONE)
    assert watched.link.pause_s(103.0) == 0.0


def test_a_reason_is_logged_at_first_and_then_now_and_then() -> None:
    link = Watched().link
    reasons = ["no answer", "wrong word order"]
    logged = [
        (second, reason) for second in range(25) for reason in reasons if link.is_worth_logging(reason, float(second))
    ]
    assert logged == [(second, reason) for second in (0, 10, 20) for reason in reasons]
    assert REPEAT_S == 10


def test_reasons_that_always_differ_do_not_fill_the_memory() -> None:
    link = Watched().link
    for number in range(1000):
        link.is_worth_logging(f"digest {number}", 0.0)
    assert len(link._logged_at) <= 32  # noqa: SLF001 - nothing else shows it


CALLS: list[Callable[[ControlLink], None]] = [
    ControlLink.answered,
    ControlLink.introduced,
    lambda link: link.go(S.COMPUTING),
    lambda link: link.go(S.DELIVERING),
    lambda link: link.go(S.WAITING, interrupted=1),
    ControlLink.damaged,
    lambda link: link.go(S.WAITING),
    lambda link: link.go(S.WAITING, rejected=1),
    lambda link: link.failed(GONE),
    lambda link: link.failed(BUSY),
    lambda link: link.failed(OTHER_MODEL),
]


@given(calls=st.lists(st.sampled_from(CALLS), max_size=60))
def test_whatever_happens_the_registers_show_it_and_a_refused_step_changes_nothing(
    calls: list[Callable[[ControlLink], None]],
) -> None:
    watched = Watched()
    link = watched.link
    for call in calls:
        before = link.registers()
        try:
            call(link)
        except RuntimeError:
            assert link.registers() == before
        else:
            after = link.registers()
            assert all(new >= old for new, old in zip(after[2:], before[2:], strict=True))
            assert after.state is link.state
        assert watched.told == len(watched.noted)
    assert all(first != second for first, second in zip(watched.noted, watched.noted[1:], strict=False))
