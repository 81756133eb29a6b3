"""Writers of a service: the lease of the one that may write, and the seal of the sequences that it sends.

A lease is granted to a connection with its first write, and refused to all others while it is held. It ends with
silence, or by hand-over: when the connection of a simple client closes, at once; when that of a holder with a number
closes, after a moment in which it may come back over another connection, from the same address and with the same
certificate: the number is no password, anyone can read it. A holder that reconnects leaves its former connection for
good: another client that writes over it has the same number. A lease that is shared is held by all connections of its
holder side by side, until the last of them closes.

The checks of a sequence are the control PLC's; `docs/link.md` describes the whole exchange.
"""

import struct
import time
import zlib
from collections.abc import Callable
from collections.abc import Sequence as Rows
from itertools import chain
from typing import Final, NamedTuple, TypeAlias

from coldloop.registers import bank, codec, control_plc, declaration
from coldloop.registers.common import WHO_WORDS, LeaseEvent, LeaseState, LeaseStatus

LINGER_S: Final = 1.0
"""For how long, in real time, a holder whose connection has closed keeps its lease."""

SIMPLE_CLIENT: Final = 0
"""Number of a holder that has given itself none."""
REPEATED_AFTER_S: Final = 10.0
"""A second writer that keeps trying is an event again after this time."""


class WriterLease:
    """Who may write in a role; notes who gets the lease, who is refused, and when it ends.

    `what` the lease is of is for messages. A holder may be silent for `silence_s()` of real time, 0 is for ever, by the
    clock `now`, s. `note` takes the events, with the name of the client. `shared`: a holder with a number may write
    over several connections in turn.
    """

    def __init__(
        self, what: str, silence_s: Callable[[], float], note: Callable[[LeaseEvent, str], None] = lambda *_: None,
        now: Callable[[], float] = time.monotonic, *, shared: bool = False,
    ) -> None:  # fmt: skip
        self._what = what
        self._shared = shared
        self._silence_s = silence_s
        self._note = note
        self._now = now
        self._name: str | None = None
        """Name of the holder, until the end of its lease has been noted."""
        self._refused_at: dict[int, float] = {}
        """Time at which each connection was last noted as a second writer."""
        self._caller: bank.Caller | None = None
        self._holder = SIMPLE_CLIENT
        self._heard_at = 0.0
        self._closed_at: float | None = None
        self._others: dict[int, bank.Caller] = {}
        """Open connections that the holder had before the present one; it has left them, unless the lease is shared."""
        self.refused = 0
        """Writes of others so far."""

    @property
    def holder(self) -> int:
        """Number of the holder; 0 is a simple client, or none."""
        return SIMPLE_CLIENT if self.state is LeaseState.FREE else self._holder

    @property
    def state(self) -> LeaseState:
        """Whether it is held now."""
        if self._caller is None:
            return LeaseState.FREE
        silence_s, now = self._silence_s(), self._now()
        if silence_s and now - self._heard_at > silence_s:
            return LeaseState.FREE
        if self._closed_at is None:
            return LeaseState.HELD
        return LeaseState.LINGERING if now - self._closed_at <= LINGER_S else LeaseState.FREE

    def check(self, caller: bank.Caller, holder: int | None = None) -> None:
        """Check that a caller may write; `holder` is the number that it says it has, None where it does not say.

        Raises:
            BusyError: Another client holds the lease.
        """
        held = self._caller
        if held is None or held.connection == caller.connection or self.state is LeaseState.FREE:
            return
        known = holder is not None and holder == self._holder != SIMPLE_CLIENT and caller.station == held.station
        if self._shared if caller.connection in self._others else known:
            return
        self.refused += 1
        now, before = self._now(), self._refused_at.get(caller.connection)
        if before is None or now - before >= REPEATED_AFTER_S:
            self._refused_at[caller.connection] = now
            self._note(LeaseEvent.REFUSED, caller.name)
        raise bank.BusyError(f"{held.name} holds the lease of {self._what}")

    def take(self, caller: bank.Caller, holder: int | None = None) -> bool:
        """Give the lease to a client that `check` has let pass, or renew it; return whether it has a new holder."""
        held, state = self._caller, self.state
        if held is caller and state is LeaseState.HELD and holder in (None, self._holder) and self._name == caller.name:
            self._heard_at = self._now()
            return False
        same = held is not None and caller.connection in {held.connection, *self._others}
        number = self._holder if holder is None and same else holder or SIMPLE_CLIENT
        new = held is None or state is LeaseState.FREE or not (same or number == self._holder != SIMPLE_CLIENT)
        new = new or number != self._holder
        keeps = self._shared and same and number == self._holder  # its connections, also after a silence
        if new and not keeps:
            self._others.clear()
        elif held is not None and self._closed_at is None:
            self._others[held.connection] = held
        self._others.pop(caller.connection, None)
        self._caller, self._holder = caller, number
        self._heard_at, self._closed_at = self._now(), None
        if new:
            if self._name is not None:  # it has lapsed, or the same connection has given itself another number
                self._note(LeaseEvent.ENDED, self._name)
            self._note(LeaseEvent.GRANTED, caller.name)
        self._name = caller.name
        return new

    def closed(self, caller: bank.Caller) -> bool:
        """Note that a connection has closed; return whether it held the lease, which a simple client gives up."""
        self._refused_at.pop(caller.connection, None)
        self._others.pop(caller.connection, None)
        gone = self._caller is None or self._caller.connection != caller.connection
        if gone or self._closed_at is not None:
            return False
        if self._shared and self._others:
            self._caller = self._others.popitem()[1]
            return False
        self._closed_at = self._now()
        if self._holder == SIMPLE_CLIENT:
            self._caller = None
        self.note_end()
        return True

    def note_end(self) -> None:
        """Note the end of the lease, when it has ended since the last call."""
        if self._name is not None and self.state is LeaseState.FREE:
            self._note(LeaseEvent.ENDED, self._name)
            self._name = None

    def registers(self) -> LeaseStatus:
        """Return what its registers show."""
        state, held, refused = self.state, self._caller, self.refused & 0xFFFFFFFF
        if state is LeaseState.FREE or held is None:
            return LeaseStatus(refused=refused)
        return LeaseStatus(state, self._holder, refused, codec.to_words(held.name, WHO_WORDS))


Inputs: TypeAlias = tuple[float, ...]
"""Inputs of one tick, in their order."""
_HEADER = codec.codec_of(declaration.Block("sequence header", 0, control_plc.SequenceHeader, ""))
_CRC_BYTES = 4


class InputSequence(NamedTuple):
    """A header and its rows, one row a tick."""

    header: control_plc.SequenceHeader
    rows: Rows[Inputs]


def checksum(header: control_plc.SequenceHeader, rows: Rows[Inputs]) -> int:
    """Return the CRC-32 of header (without its CRC) and rows, whatever the word order of the link."""
    crc = zlib.crc32(_HEADER.encode(header)[:-_CRC_BYTES])
    return zlib.crc32(struct.pack(f">{len(rows[0]) * len(rows) if rows else 0}f", *chain.from_iterable(rows)), crc)


def with_checksum(header: control_plc.SequenceHeader, rows: Rows[Inputs]) -> InputSequence:
    """Return the sequence with its CRC filled in."""
    return InputSequence(header._replace(crc=checksum(header, rows)), rows)
