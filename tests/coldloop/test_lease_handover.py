"""A holder with a number that comes back over another connection, and somebody else who has the same number."""

import pytest

from coldloop.registers.bank import ALL_ROLES, BusyError, Caller
from coldloop.safety.lease import Lease

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
def lease(clock: Clock) -> Lease:
    held = Lease("the outputs", lambda: 10.0, clock)
    held.take(on(1), NUMBER)
    return held


def test_a_number_that_was_read_from_registers_opens_nothing_from_another_address() -> None:
    lease = Lease("the outputs", lambda: 10.0)
    lease.take(Caller("10.0.0.2:5001 role=control", ALL_ROLES, 1), 7)
    with pytest.raises(BusyError):
        lease.check(Caller("10.0.0.9:5001 role=control", ALL_ROLES, 2), 7)
    lease.check(Caller("10.0.0.2:6001 role=control", ALL_ROLES, 3), 7)


def test_a_holder_that_comes_back_over_another_connection_goes_on(lease: Lease) -> None:
    lease.check(on(2), NUMBER)
    assert not lease.take(on(2), NUMBER)
    lease.closed(on(1))
    lease.check(on(2), NUMBER)


def test_who_goes_on_over_the_connection_that_the_holder_has_left_is_somebody_else(lease: Lease) -> None:
    lease.take(on(2), NUMBER)
    with pytest.raises(BusyError):
        lease.check(on(1), NUMBER)
    assert lease.refused == 1


def test_the_connection_that_was_left_counts_again_when_the_holder_has_been_silent(lease: Lease, clock: Clock) -> None:
    lease.take(on(2), NUMBER)
    clock.now = 11.0
    lease.check(on(1), NUMBER)
    assert lease.take(on(1), NUMBER)
    lease.check(on(2), NUMBER)
