"""One writer at a time: who may write in a role, and when another one may."""

from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.registers.bank import BusyError, Caller
from coldloop.registers.codec import to_words
from coldloop.registers.common import WHO_WORDS, LeaseEvent, LeaseState, LeaseStatus
from coldloop.registers.declaration import Role
from coldloop.safety.writers import LINGER_S, SIMPLE_CLIENT, WriterLease

SILENCE_S = 5.0


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def caller(connection: int) -> Caller:
    return Caller(f"10.0.0.1:{connection}", frozenset({Role.CONTROL}), connection)


A, B, C = caller(1), caller(2), caller(3)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def lease(clock: Clock) -> WriterLease:
    return WriterLease("the rack", lambda: SILENCE_S, now=clock)


def writes(lease: WriterLease, who: Caller, holder: int | None = None) -> bool:
    """Write; return whether the lease has a new holder with it."""
    lease.check(who, holder)
    return lease.take(who, holder)


def test_the_first_who_writes_has_it_and_a_second_is_refused_and_counted(lease: WriterLease) -> None:
    assert lease.state is LeaseState.FREE
    assert writes(lease, A, 7)
    assert (lease.state, lease.holder) == (LeaseState.HELD, 7)
    for refused in (1, 2):
        with pytest.raises(BusyError, match=r"^10\.0\.0\.1:1 holds the lease of the rack$") as refusal:
            lease.check(B, 8)
        assert refusal.value.exception_code == 6
        assert lease.refused == refused
    assert not writes(lease, A, 7)


def test_a_look_at_whether_one_may_write_takes_nothing(lease: WriterLease) -> None:
    lease.check(A, 7)
    assert lease.state is LeaseState.FREE
    assert writes(lease, B, 8)


def test_a_holder_that_is_silent_for_longer_than_it_may_loses_it(lease: WriterLease, clock: Clock) -> None:
    writes(lease, A, 7)
    clock.now += SILENCE_S
    assert lease.state is LeaseState.HELD
    clock.now += 0.001
    assert (lease.state, lease.holder) == (LeaseState.FREE, SIMPLE_CLIENT)
    assert writes(lease, B, 8)
    with pytest.raises(BusyError):
        lease.check(A, 7)


def test_a_holder_that_comes_back_after_its_silence_is_a_new_one(lease: WriterLease, clock: Clock) -> None:
    writes(lease, A, 7)
    clock.now += SILENCE_S + 1.0
    assert writes(lease, A, 7)


def test_every_write_ends_the_silence(lease: WriterLease, clock: Clock) -> None:
    writes(lease, A)
    for _ in range(5):
        clock.now += 0.9 * SILENCE_S
        assert not writes(lease, A)


def test_without_a_limit_a_silent_holder_keeps_it(clock: Clock) -> None:
    lease = WriterLease("the rack", lambda: 0.0, now=clock)
    writes(lease, A)
    clock.now += 1e6
    with pytest.raises(BusyError):
        lease.check(B)


def test_when_the_connection_of_a_simple_client_closes_the_next_may_write_at_once(lease: WriterLease) -> None:
    writes(lease, A)
    assert not lease.closed(B)
    assert lease.closed(A)
    assert lease.state is LeaseState.FREE
    assert writes(lease, B)


def test_when_that_of_a_holder_with_a_number_closes_only_the_same_may_come_back_for_a_moment(
    lease: WriterLease, clock: Clock
) -> None:
    writes(lease, A, 7)
    assert lease.closed(A)
    clock.now += LINGER_S
    assert lease.state is LeaseState.LINGERING
    for stranger in ((B, 8), (B, SIMPLE_CLIENT), (B, None)):
        with pytest.raises(BusyError):
            lease.check(*stranger)
    assert not writes(lease, C, 7)
    assert lease.state is LeaseState.HELD


def test_after_that_moment_it_is_free(lease: WriterLease, clock: Clock) -> None:
    writes(lease, A, 7)
    lease.closed(A)
    clock.now += LINGER_S + 0.001
    assert lease.state is LeaseState.FREE
    assert writes(lease, B, 8)


def test_the_same_holder_goes_on_over_a_new_connection_and_its_old_one_closes_later(lease: WriterLease) -> None:
    writes(lease, A, 7)
    assert not writes(lease, B, 7)
    assert not lease.closed(A)
    assert lease.state is LeaseState.HELD
    assert lease.closed(B)


def test_two_simple_clients_are_not_the_same_holder(lease: WriterLease) -> None:
    writes(lease, A, SIMPLE_CLIENT)
    with pytest.raises(BusyError):
        lease.check(B, SIMPLE_CLIENT)


def test_another_number_over_the_same_connection_is_a_new_holder_and_none_is_the_same(lease: WriterLease) -> None:
    assert writes(lease, A, 7)
    assert not writes(lease, A)
    assert lease.holder == 7
    assert writes(lease, A, 9)
    assert lease.holder == 9


def test_registers_tell_who_has_it(lease: WriterLease, clock: Clock) -> None:
    nobody = LeaseStatus(LeaseState.FREE, 0, 0, to_words("", WHO_WORDS))
    assert lease.registers() == nobody
    writes(lease, A, 7)
    with pytest.raises(BusyError):
        lease.check(B)
    assert lease.registers() == LeaseStatus(LeaseState.HELD, 7, 1, to_words(A.name, WHO_WORDS))
    clock.now += SILENCE_S + 1.0
    assert lease.registers() == nobody._replace(refused=1)


class Step(NamedTuple):
    """What happens: a connection writes, or closes, or time passes."""

    what: str
    connection: int
    seconds: float


# Connections 1 and 2 are of holder 7, 3 is of holder 8, 4 and 5 are simple clients.
NUMBERS = {1: 7, 2: 7, 3: 8, 4: SIMPLE_CLIENT, 5: SIMPLE_CLIENT}
steps = st.lists(
    st.builds(
        Step,
        st.sampled_from(("write", "write", "write", "close", "wait")),
        st.sampled_from(list(NUMBERS)),
        st.sampled_from((0.0, 0.3, LINGER_S + 0.1, SILENCE_S - 0.1, SILENCE_S + 0.1)),
    ),
    max_size=40,
)


def same_party(one: int, other: int) -> bool:
    return one == other or NUMBERS[one] == NUMBERS[other] != SIMPLE_CLIENT


@settings(max_examples=5 * settings.default.max_examples)
@given(story=steps)
def test_another_party_writes_only_after_the_silence_or_the_departure_of_the_one_before(  # noqa: C901 - a model
    story: list[Step],
) -> None:
    clock = Clock()
    lease = WriterLease("the rack", lambda: SILENCE_S, now=clock)
    last: tuple[int, float] | None = None  # connection and time of the last write that was taken
    departed: float | None = None
    left: set[int] = set()  # connections that their holder has left for another one
    for step in story:
        clock.now += step.seconds if step.what == "wait" else 0.0
        if step.what == "close":
            assert lease.closed(caller(step.connection)) in {True, False}
            left.discard(step.connection)
            if last is not None and last[0] == step.connection and departed is None:
                departed = clock.now
        if step.what != "write":
            continue
        free = last is None or clock.now - last[1] > SILENCE_S
        if last is not None and departed is not None:
            linger = LINGER_S if NUMBERS[last[0]] else 0.0
            free = free or NUMBERS[last[0]] == SIMPLE_CLIENT or clock.now - departed > linger
        mine = last is not None and same_party(last[0], step.connection) and step.connection not in left
        if last is not None and last[0] == step.connection and departed is not None:
            continue  # a connection that has closed does not write
        try:
            new = writes(lease, caller(step.connection), NUMBERS[step.connection])
        except BusyError:
            assert not free
            assert not mine
        else:
            assert free or mine
            assert new == (free or not mine)
            if new:
                left.clear()
            elif last is not None and last[0] != step.connection and departed is None:
                left.add(last[0])
            last, departed = (step.connection, clock.now), None


def test_a_lease_ends_for_the_connection_that_wrote_last(clock: Clock) -> None:
    ended: list[str] = []
    lease = WriterLease(
        "the rack", lambda: SILENCE_S, lambda event, name: ended.append(name) if event is LeaseEvent.ENDED else None,
        now=clock, shared=True,
    )  # fmt: skip
    writes(lease, A, 7)
    writes(lease, B, 7)
    lease.closed(B)
    writes(lease, A, 7)
    clock.now += SILENCE_S + 1.0
    lease.note_end()
    assert ended == [A.name]
