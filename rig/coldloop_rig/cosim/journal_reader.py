"""Reads the journal of a running service over Modbus."""

from collections.abc import Collection
from typing import Final

from coldloop.errors import LinkError, RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.operating.rings import read_ring
from coldloop.registers.audit import EVENT_ROWS, QUERY_ROWS, Event, JournalAnswer, JournalPage, JournalQuery
from coldloop.service.journal import ANY_SUBJECT

NO_ROLE: Final = (1, 2)
"""Exceptions with which a server refuses a write to a client that has not the role for it."""


MOST_KEPT: Final = 100_000
"""Events that a journal can be believed to keep; ours keep 10,000."""


class JournalReader:
    """Reads a journal incrementally, from a given event on.

    Args:
        client: Of the service.
        first: Number of the first event to read.
        kinds: Kinds of events to read; all when empty.

    Queries are for operators. To a client without that role the last `EVENT_ROWS` events are readable.
    """

    def __init__(self, client: RegisterClient, first: int = 1, kinds: Collection[int] = ()) -> None:
        self._client = client
        self._kinds = frozenset(kinds)
        self._next = first
        self._newest = 0
        self._read: list[Event] = []
        """Read before a request that failed."""
        self.limited = False
        """Queries are refused: only the last events can be read."""
        self.missed = 0
        """Events that were wanted, and are not kept any more."""
        self.restarted = False
        """The service numbers its events from 1 again: it has lost its count in a restart."""

    async def read_on(self) -> list[Event]:
        """Return the events up to the newest one that have not been returned yet.

        Raises:
            LinkError: The service does not answer, or refuses, or contradicts itself; the next call returns what was
                read so far.
        """
        restarts = 0
        while True:
            page, found = await self._page()
            self._check(page)
            if page.newest < self._newest:
                restarts += 1
                if restarts > 1:
                    raise LinkError(f"{self._client.peer}: its journal reports another last event at each query")
                self.restarted, self._next, self._newest = True, 1, 0
                continue
            if 1 < self._next < page.oldest:
                self.missed += page.oldest - self._next
            self._read += [event for event in found if not self._kinds or event.kind in self._kinds]
            self._newest = page.newest
            if page.next_first <= self._next:
                self._next = max(self._next, page.newest + 1)
                events, self._read = self._read, []
                return events
            self._next = page.next_first

    def _check(self, page: JournalPage) -> None:
        """Refuse a page on which reading would not come to an end."""
        kept = page.newest - max(page.oldest, 1) + 1
        ahead = page.next_first <= page.newest if page.next_first else True
        if not (0 <= kept <= MOST_KEPT and ahead):
            raise LinkError(
                f"{self._client.peer}: its journal contradicts itself: events {page.oldest} to {page.newest}, next "
                f"{page.next_first}"
            )

    async def _page(self) -> tuple[JournalPage, list[Event]]:
        if not self.limited:
            kind = next(iter(self._kinds)) if len(self._kinds) == 1 else 0
            query = JournalQuery(self._next, kind, ANY_SUBJECT)
            try:
                page, rows = await self._client.query(query, JournalPage, JournalAnswer, QUERY_ROWS)
            except RequestRefusedError as error:
                if error.exception_code not in NO_ROLE:
                    raise
                self.limited = True
            else:
                return page, [Event(*row) for row in rows[: page.found]]
        return await self._last_events()

    async def _last_events(self) -> tuple[JournalPage, list[Event]]:
        """Read what the block of the last events has from the next one on."""
        page = await self._client.read(JournalPage)
        first = max(self._next, page.newest - EVENT_ROWS + 1)
        rows = await read_ring(self._client, Event, EVENT_ROWS, first, page.newest)
        events = sorted(event for event in rows if event.number >= first)  # newer ones may have come meanwhile
        newest = max([page.newest, *(event.number for event in events)])
        return JournalPage(max(page.oldest, newest - EVENT_ROWS + 1), newest, len(events)), events
