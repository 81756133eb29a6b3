"""The journal of a service: what happened, when, and who did it.

Events are numbered without gaps, over restarts too where the service retains its count. They are kept in memory, are
shown in registers (the last ones, and those that a query selects) and are written to the log.
"""

import time
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
LOOKED_AT: Final = 500
"""Events that one query looks at, so that its answer takes a fraction of a millisecond."""
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
        self.before = count
        """Number of the last event before this start."""
        self.noted = 0
        """Events of this start."""
        self._now = now
        self._events: deque[Event] = deque(maxlen=KEPT)

    @property
    def count(self) -> int:
        """Number of the newest event; 0 is none."""
        return self.before + self.noted

    @property
    def oldest(self) -> int:
        """Number of the oldest event kept; 0 is none."""
        return self._events[0].number if self._events else 0

    def continue_from(self, boot: int, count: int) -> None:
        """Continue the numbering of an earlier start after its event `count`; present events are renumbered."""
        moved = count - self.before
        self._events = deque(
            [event._replace(number=event.number + moved, boot=boot & 0xFFFF) for event in self._events], maxlen=KEPT
        )
        self.boot, self.before = boot, count

    def note(
        self, tick: int, kind: EventKind, subject: int = 0, cause: int = 0, *, value: float = 0.0, who: str = ""
    ) -> None:
        """Add an event; its arguments are the fields of `Event`."""
        self.noted += 1
        milliseconds = max(0, int(self._now() * 1000))
        self._events.append(
            Event(
                self.count, self.boot & 0xFFFF, tick & 0xFFFFFFFF, milliseconds // 1000 & 0xFFFFFFFF,
                milliseconds % 1000, kind, subject & 0xFFFF, cause & 0xFFFF, value, to_words(who, WHO_WORDS),
            )
        )  # fmt: skip

    def since(self, number: int) -> list[Event]:
        """Return the events after event `number`, those that are still kept."""
        return self.last(self.count - number)

    def last(self, events: int) -> list[Event]:
        """Return the last events, oldest first, at most so many and those that are still kept."""
        newest_first = islice(reversed(self._events), max(0, events))
        return list(newest_first)[::-1]

    def select(self, query: JournalQuery) -> tuple[JournalPage, list[JournalAnswer]]:
        """Return the first events that a query selects, and where the next query continues.

        At most `LOOKED_AT` events are looked at: a page may have fewer events than fit, even none, and `next_first`
        still says that there is more.
        """
        place = max(0, query.first - self.oldest)
        found: list[JournalAnswer] = []
        for event in islice(self._events, place, place + LOOKED_AT):
            place += 1
            if query.kind in (0, event.kind) and query.subject in (ANY_SUBJECT, event.subject):
                found.append(JournalAnswer(*event))
                if len(found) == QUERY_ROWS:
                    break
        next_first = self.oldest + place if place < len(self._events) else 0
        return JournalPage(self.oldest, self.count, len(found), next_first), found


class JournalPublication:
    """Shows a journal in the registers of its service."""

    def __init__(self, journal: Journal, bank: RegisterBank) -> None:
        self._journal = journal
        self._bank = bank
        self._shown = journal.noted
        self._start = journal.boot, journal.before

    @property
    def is_behind(self) -> bool:
        """There are events that have not been shown, or not with the numbers that they have by now."""
        return self._journal.noted != self._shown or self._renumbered

    @property
    def _renumbered(self) -> bool:
        return self._start != (self._journal.boot, self._journal.before)

    def show(self) -> list[Event]:
        """Put new events into the registers; return them."""
        journal = self._journal
        if not self.is_behind:
            return []
        new = shown = journal.last(journal.noted - self._shown)
        if self._renumbered:
            shown = journal.last(journal.noted)
            for row in range(EVENT_ROWS):
                self._bank.put(Event(), row)
        for event in shown[-EVENT_ROWS:]:
            self._bank.put(event, event.number % EVENT_ROWS)
        self._shown, self._start = journal.noted, (journal.boot, journal.before)
        page = self._bank.get(JournalPage)  # what the last query found may still have to be read
        self._bank.put(page._replace(oldest=journal.oldest, newest=journal.count))
        return new

    def answer(self, query: JournalQuery) -> None:
        """Put what a query selects into the registers."""
        page, found = self._journal.select(query)
        self._bank.put(page)
        for row in range(QUERY_ROWS):
            self._bank.put(found[row] if row < len(found) else JournalAnswer(), row)
