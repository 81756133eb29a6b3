"""A holder with a number that comes back over another connection, and somebody else who has the same number."""

import pytest

from coldloop.registers.bank import ALL_ROLES, BusyError, Caller
from coldloop.registers.common import LeaseState
from coldloop.safety.writers import LINGER_S, WriterLease

NUMBER = 7


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def on(connection: int) -> Caller:
    return Caller(f"client:{connection}", ALL_ROLES, connection)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def lease(clock: Clock) -> WriterLease:
    held = WriterLease("the outputs", lambda: 10.0, now=clock)
    held.take(on(1), NUMBER)
    return held


def test_a_number_that_was_read_from_registers_opens_nothing_from_another_address() -> None:
    lease = WriterLease("the outputs", lambda: 10.0)
    lease.take(Caller("10.0.0.2:5001 role=control", ALL_ROLES, 1), 7)
    with pytest.raises(BusyError):
        lease.check(Caller("10.0.0.9:5001 role=control", ALL_ROLES, 2), 7)
    lease.check(Caller("10.0.0.2:6001 role=control", ALL_ROLES, 3), 7)


def test_a_holder_that_comes_back_over_another_connection_goes_on(lease: WriterLease) -> None:
    lease.check(on(2), NUMBER)
    assert not lease.take(on(2), NUMBER)
    lease.closed(on(1))
    lease.check(on(2), NUMBER)


def test_who_goes_on_over_the_connection_that_the_holder_has_left_is_somebody_else(lease: WriterLease) -> None:
    lease.take(on(2), NUMBER)
    with pytest.raises(BusyError):
        lease.check(on(1), NUMBER)
    assert lease.refused == 1


def test_the_connection_that_was_left_counts_again_after_a_silence(lease: WriterLease, clock: Clock) -> None:
    lease.take(on(2), NUMBER)
    clock.now = 11.0
    lease.check(on(1), NUMBER)
    assert lease.take(on(1), NUMBER)
    lease.check(on(2), NUMBER)


# -- a lease that is shared -------------------------------------------------------------------------------------------


@pytest.fixture
def shared(clock: Clock) -> WriterLease:
    held = WriterLease("the optimiser's registers", lambda: 10.0, now=clock, shared=True)
    for connection in (1, 2, 3):
        held.check(on(connection), NUMBER)
        assert held.take(on(connection), NUMBER) == (connection == 1)
    return held


def test_a_holder_that_shares_it_has_all_its_connections_after_a_silence(shared: WriterLease, clock: Clock) -> None:
    clock.now = 11.0
    assert shared.take(on(1), NUMBER)
    for connection in (2, 3, 1):
        shared.check(on(connection))
        assert not shared.take(on(connection))


def test_connections_of_a_holder_write_side_by_side_and_say_their_number_once(shared: WriterLease) -> None:
    for connection in (1, 3, 2, 1):
        shared.check(on(connection))
        assert not shared.take(on(connection))
    assert shared.holder == NUMBER
    for stranger, number in ((on(4), None), (on(4), 0), (on(4), 8), (Caller("elsewhere:4", ALL_ROLES, 4), NUMBER)):
        with pytest.raises(BusyError):
            shared.check(stranger, number)
    assert shared.refused == 4


def test_a_shared_lease_ends_with_the_last_of_its_connections(shared: WriterLease, clock: Clock) -> None:
    assert not shared.closed(on(3))
    assert not shared.closed(on(1))
    shared.check(on(2))
    assert shared.state is LeaseState.HELD
    assert shared.closed(on(2))
    assert shared.state is LeaseState.LINGERING
    clock.now = LINGER_S + 0.1
    shared.check(on(4), 8)


def test_another_number_over_one_of_them_leaves_the_others_out(shared: WriterLease) -> None:
    shared.check(on(2), 9)
    assert shared.take(on(2), 9)
    for connection in (1, 3):
        with pytest.raises(BusyError):
            shared.check(on(connection))


def test_simple_clients_share_nothing(clock: Clock) -> None:
    lease = WriterLease("the optimiser's registers", lambda: 10.0, now=clock, shared=True)
    lease.take(on(1), 0)
    for number in (None, 0):
        with pytest.raises(BusyError):
            lease.check(on(2), number)
