"""The journal of a service: what happened, when, and who did it.

Events are numbered without gaps, over restarts too where the service retains its count. They are kept in memory, are
shown in registers (the last ones, and those that a query selects) and are written to the log.
"""

import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from itertools import islice
from typing import Final

from coldloop.registers.audit import (
    EVENT_ROWS,
    QUERY_ROWS,
    WHO_WORDS,
    Event,
    EventKind,
    JournalAnswer,
    JournalPage,
    JournalQuery,
)
from coldloop.registers.bank import RegisterBank
from coldloop.registers.text import to_words

KEPT: Final = 10_000
"""Events kept in memory."""
ANY_SUBJECT: Final = 0xFFFF


class Journal:
    """Numbers events and keeps the last ones.

    Args:
        boot: Number of this start of the service, from 1.
        count: Number of the last event before it.
        now: Time, seconds since 1970 UTC.
    """

    def __init__(self, *, boot: int = 1, count: int = 0, now: Callable[[], float] = time.time) -> None:
        self.boot = boot
        self.count = count
        self._now = now
        self._events: deque[Event] = deque(maxlen=KEPT)

    def continue_from(self, boot: int, count: int) -> None:
        """Number on from before a restart; the events of this start so far keep their order."""
        kept = [event._replace(number=count + place, boot=boot) for place, event in enumerate(self._events, 1)]
        self.boot, self.count = boot, count + len(kept)
        self._events = deque(kept, maxlen=KEPT)

    def note(
        self, tick: int, kind: EventKind, subject: int = 0, cause: int = 0, *, value: float = 0.0, who: str = ""
    ) -> None:
        """Add an event."""
        self.count += 1
        seconds = self._now()
        self._events.append(
            Event(
                self.count, self.boot & 0xFFFF, tick & 0xFFFFFFFF, int(seconds), int(seconds % 1 * 1000), kind,
                subject & 0xFFFF, cause & 0xFFFF, value, to_words(who, WHO_WORDS),
            )
        )  # fmt: skip

    @property
    def oldest(self) -> int:
        """Number of the oldest event kept; 0 is none."""
        return self._events[0].number if self._events else 0

    def since(self, number: int) -> list[Event]:
        """Return the events after event `number`, those that are still kept."""
        if number >= self.count:
            return []
        return list(islice(self._events, max(0, number + 1 - self.oldest), None))

    def select(self, query: JournalQuery) -> tuple[JournalPage, list[JournalAnswer]]:
        """Return the first events that a query selects, and where to go on."""
        found: list[JournalAnswer] = []
        numbers = range(self.oldest, self.count + 1)
        for event in islice(self._events, bisect_left(numbers, query.first), None):
            if len(found) == QUERY_ROWS:
                return JournalPage(self.oldest, self.count, len(found), event.number), found
            kind, subject = query.kind in (0, event.kind), query.subject in (ANY_SUBJECT, event.subject)
            if kind and subject:
                found.append(JournalAnswer(*event))
        return JournalPage(self.oldest, self.count, len(found), 0), found


class JournalPublication:
    """Shows a journal in the registers of its service."""

    def __init__(self, journal: Journal, bank: RegisterBank) -> None:
        self._journal = journal
        self._bank = bank
        self._shown = journal.count

    @property
    def is_behind(self) -> bool:
        """There are events that have not been shown."""
        return self._journal.count != self._shown

    def show(self) -> list[Event]:
        """Put new events into the registers; return them."""
        events = self._journal.since(self._shown)
        for event in events[-EVENT_ROWS:]:
            self._bank.put(event, event.number % EVENT_ROWS)
        self._shown = self._journal.count
        if events:
            self._bank.put(JournalPage(self._journal.oldest, self._journal.count))
        return events

    def answer(self, query: JournalQuery) -> None:
        """Put what a query selects into the registers."""
        page, found = self._journal.select(query)
        self._bank.put(page)
        for row in range(QUERY_ROWS):
            self._bank.put(found[row] if row < len(found) else JournalAnswer(), row)
