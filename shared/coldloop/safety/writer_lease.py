"""The one client that writes in a role: its lease, and the events of the lease."""

import time
from collections.abc import Callable
from enum import IntEnum
from typing import Final

from coldloop.registers.bank import BusyError, Caller
from coldloop.registers.safety import LeaseState, LeaseStatus
from coldloop.safety.lease import Lease

REPEATED_AFTER_S: Final = 10.0
"""A second writer that keeps trying is an event again after this time."""


class LeaseEvent(IntEnum):
    """Subject of an event of the kind `EventKind.LEASE`."""

    ENDED = 0
    GRANTED = 1
    REFUSED = 2


class WriterLease:
    """A lease that notes who gets it, who is refused, and when it ends.

    Args:
        what: What the lease is of, for messages.
        silence_s: Returns how long, in real time, the holder may be silent.
        note: Takes the events, with the name of the client.
        now: A clock, s.
        shared: Whether a holder with a number may write over several connections in turn.
    """

    def __init__(
        self,
        what: str,
        silence_s: Callable[[], float],
        note: Callable[[LeaseEvent, str], None],
        now: Callable[[], float] = time.monotonic,
        *,
        shared: bool = False,
    ) -> None:
        self._lease = Lease(what, silence_s, now, shared=shared)
        self._note = note
        self._now = now
        self._name: str | None = None
        """Of the holder, until the end of its lease has been noted."""
        self._refused_at: dict[int, float] = {}
        """When each connection was last noted as a second writer."""

    def check(self, caller: Caller, holder: int | None = None) -> None:
        """Check that a client may write; `holder` is its number, None where the record has none.

        Raises:
            BusyError: Another client holds the lease.
        """
        try:
            self._lease.check(caller, holder)
        except BusyError:
            self._note_second_writer(caller)
            raise

    def _note_second_writer(self, caller: Caller) -> None:
        now = self._now()
        before = self._refused_at.get(caller.connection)
        if before is None or now - before >= REPEATED_AFTER_S:
            self._refused_at[caller.connection] = now
            self._note(LeaseEvent.REFUSED, caller.name)

    def take(self, caller: Caller, holder: int | None) -> None:
        """Give the lease to a client that `check` has let pass, or renew it."""
        if self._lease.take(caller, holder):
            if self._name is not None:  # it has lapsed, or the same connection has given itself another number
                self._note(LeaseEvent.ENDED, self._name)
            self._note(LeaseEvent.GRANTED, caller.name)
        self._name = caller.name

    def closed(self, caller: Caller) -> None:
        """Note that a connection has closed: a simple client hands the lease over at once."""
        self._refused_at.pop(caller.connection, None)
        if self._lease.closed(caller):
            self.note_end()

    def note_end(self) -> None:
        """Note the end of the lease, when it has ended since the last call."""
        if self._name is not None and self._lease.state is LeaseState.FREE:
            self._note(LeaseEvent.ENDED, self._name)
            self._name = None

    @property
    def refused(self) -> int:
        """Writes of others that were refused so far."""
        return self._lease.refused

    def registers(self) -> LeaseStatus:
        """Return what its registers show."""
        return self._lease.registers()
