"""The observer of a rig: reads over Modbus what its services show, for page, status, recorder and fault injection.

A service has records of the present, and rings of rows: row n of the plant's ticks, of the optimiser's updates and of a
journal's events is in place n modulo the number of rows. Readers follow a ring and pass on each row once.
"""

import asyncio
import time
from collections.abc import Callable, Collection
from typing import Final, Protocol, TypeVar

from coldloop.errors import LinkError, RequestRefusedError
from coldloop.modbus.client import REQUESTS_AT_ONCE, RegisterClient
from coldloop.registers import common, optimizer_plc, plant
from coldloop.service.journal import ANY_SUBJECT

R = TypeVar("R", bound=tuple[object, ...])

BATCH: Final = 64
"""Ticks to wait for before reading, in lock-step."""
MARGIN: Final = 8
"""Rows of the history that may be overwritten while others are read."""
NO_ROLE: Final = (1, 2)
"""Exceptions with which a server refuses a write to a client that has not the role for it."""
MOST_KEPT: Final = 100_000
"""Events that a journal can be believed to keep; ours keep 10,000."""


class Subscriber(Protocol):
    """Takes what is read of a session: a recorder, or what is before one."""

    @property
    def next_tick(self) -> int:
        """First tick that is still to come."""

    def sample(self, sample: plant.PlantSample) -> None:
        """Take a tick."""

    def station(self, sample: plant.StationSample) -> None:
        """Take what goes with a tick that is about to come."""

    def update(self, update: optimizer_plc.Optimization) -> None:
        """Take an update."""

    def event(self, event: common.Event, service: str = "control_plc") -> None:
        """Take an event."""


async def read_ring(client: RegisterClient, record: type[R], ring: int, first: int, last: int) -> list[R]:
    """Return the rows of the numbers `first` to `last`, `ring` or fewer; one that was overwritten has a newer number.

    Raises:
        LinkError: The service does not answer, or refuses.
    """
    start, count = first % ring, max(0, last - first + 1)
    behind = min(count, ring - start)
    rows = await client.read_rows(record, start, behind)
    return rows + await client.read_rows(record, 0, count - behind)


async def read_alarms(control: RegisterClient) -> list[common.Alarm]:
    """Return the alarms of a control PLC, by number."""
    return await control.read_rows(common.Alarm, 0, len(common.alarms_of(control.process)))


async def last_update(optimizer: RegisterClient) -> optimizer_plc.Optimization | None:
    """Return the update that an optimiser has done last; None before the first."""
    newest = (await optimizer.read(common.Identity)).heartbeat - 1
    return (
        None
        if newest < 0
        else (await read_ring(optimizer, optimizer_plc.Optimization, optimizer_plc.HISTORY_ROWS, newest, newest))[0]
    )


class SampleReader:
    """Reads the plant's history in a session as it grows, from tick `first` on, before tick `end`.

    With `realtime` ticks come one by one; otherwise some are waited for. With `tolerant` ticks that are not kept any
    more are left out, and the plant may go back after a restart; each tick is then read as soon as possible, for a
    plant that is killed takes its history with it.
    """

    def __init__(
        self, client: RegisterClient, subscriber: Subscriber, session: int, end: int, *, first: int = 0,
        realtime: bool, tolerant: bool,
    ) -> None:  # fmt: skip
        self._client = client
        self._subscriber = subscriber
        self._session = session
        self._end = end
        self._at_once = 1 if tolerant or realtime else BATCH
        self._tolerant = tolerant
        self.read_until = first
        """First tick that is still to be read."""
        self.has_station: bool | None = None
        """Whether the plant is a whole refrigerator; None while that is not known."""

    async def read(self) -> int:
        """Read the ticks that have gone by since the last call; return the plant's tick.

        Raises:
            LinkError: The plant does not answer, is in another session, or has overwritten ticks.
        """
        identity = await self._client.read(common.Identity)
        if identity.session != self._session:
            raise LinkError(
                f"{self._client.peer} was taken over by session {identity.session}, or was restarted without a "
                "retained state: one run at a time"
            )
        last = min(identity.tick, self._end)
        if self._tolerant:
            self.read_until = max(min(self.read_until, last), last - plant.HISTORY_ROWS + MARGIN)
        if last - self.read_until >= max(1, min(self._at_once, self._end - self.read_until)):
            await self._read_rows(last)
        return identity.tick

    async def _read_rows(self, last: int) -> None:
        """Read the ticks before `last`, as many together as requests may be under way."""
        while self.read_until < last:
            first = self.read_until
            until = min(last, first + REQUESTS_AT_ONCE)
            samples = await read_ring(self._client, plant.PlantSample, plant.HISTORY_ROWS, first, until - 1)
            if self.has_station is None:  # the first row that is read decides
                (station,) = await read_ring(self._client, plant.StationSample, plant.STATION_ROWS, first, first)
                self.has_station = any(station.signals)
            if self.has_station:
                rows = await read_ring(self._client, plant.StationSample, plant.STATION_ROWS, first, until - 1)
                for tick, station in enumerate(rows, first):
                    if any(station.signals) and station.tick == tick:
                        self._subscriber.station(station)
            for tick, sample in enumerate(samples, first):
                if sample.tick == tick:
                    self._subscriber.sample(sample)
                elif not self._tolerant:
                    raise LinkError(
                        f"{self._client.peer} has overwritten tick {tick} before it was recorded: "
                        "choose a lower --factor"
                    )
                self.read_until = tick + 1


class UpdateReader:
    """Reads the optimiser's history as it grows, in a session; None is the present one, whichever that is.

    It begins with number `first`; None begins with the last ones. With `tolerant` updates that are not kept any more
    are left out, and their numbers may go back after a restart. Of more than `most` new ones only the newest are read.
    """

    def __init__(
        self, client: RegisterClient, take: Callable[[optimizer_plc.Optimization], None], session: int | None = None, *,
        first: int | None = None, tolerant: bool = True, most: int = optimizer_plc.HISTORY_ROWS,
    ) -> None:  # fmt: skip
        self._client = client
        self._take = take
        self._session = session
        self._follows_sessions = session is None
        self._tolerant = tolerant
        self._most = most
        self._next = first
        self._last: optimizer_plc.Optimization | None = None

    async def read(self, identity: common.Identity | None = None) -> int:
        """Read the updates that have been done since the last call; return how many were new.

        Args:
            identity: Of the optimiser, if it has been read just before.

        Raises:
            LinkError: The optimiser does not answer, or has overwritten updates.
        """
        identity = identity or await self._client.read(common.Identity)
        if identity.session != self._session:
            if not self._follows_sessions:
                return 0
            self._session, self._next, self._last = identity.session, None, None
        known = identity.heartbeat - self._most if self._next is None else self._next
        new = ((identity.heartbeat - known + 0x8000) & 0xFFFF) - 0x8000  # the heartbeat wraps
        newest = known + new
        if not 0 <= new <= self._most:
            if not self._tolerant:
                raise LinkError(f"{self._client.peer} has overwritten update {known} before it was recorded")
            known = max(0, newest - self._most)
        found = 0
        for number, update in enumerate(
            await read_ring(self._client, optimizer_plc.Optimization, optimizer_plc.HISTORY_ROWS, known, newest - 1),
            known,
        ):
            later = self._last is None or update.tick > self._last.tick
            # a row whose update was abandoned for a newer one is empty, or as it was 256 updates before
            if (update.update - number) & 0xFFFF == 0 and update.tau_u > 0 and later:
                self._take(update)
                self._last = update
                found += 1
        self._next = newest
        return found

    async def read_until(self, ticks: int, last: int, patience_s: float) -> None:
        """Read on until update `last` is there, and one that reaches beyond the run (LinkError: it does not come)."""
        deadline = time.monotonic() + patience_s
        while self._last is None or self._last.update < last or self._last.tick + self._last.tau_u < ticks:
            if time.monotonic() > deadline:
                raise LinkError(f"{self._client.peer} stopped after update {(self._next or 0) - 1}: see its log")
            await self.read()
            await asyncio.sleep(0.002)


class JournalReader:
    """Reads the events of some kinds (all when empty) of a journal incrementally, from event number `first` on.

    With `queries` it reads all that is kept. They are for operators: to a client without that role, and without
    queries, only the last events are readable, at most `most` at once.
    """

    def __init__(
        self, client: RegisterClient, first: int = 1, kinds: Collection[int] = (), *, queries: bool = True,
        most: int = common.EVENT_ROWS,
    ) -> None:  # fmt: skip
        self._client = client
        self._kinds = frozenset(kinds)
        self._most = most
        self._next = first
        self._newest = 0
        self._read: list[common.Event] = []
        """Read before a request that failed."""
        self._last: common.Event | None = None
        self._is_doubtful = False
        self.page = common.JournalPage()
        """State of the journal when it was read last."""
        self.limited = not queries
        """Only the last events can be read, as queries are refused."""
        self.missed = 0
        """Events that were wanted, and are not kept any more."""
        self.restarted = False
        """The service numbers its events from 1 again: it has lost its count in a restart."""

    def connection_lost(self) -> None:
        """Compare the last event at the next call: the service may have restarted its count meanwhile."""
        self._is_doubtful = True

    async def read_on(self) -> list[common.Event]:
        """Return the events up to the newest one that have not been returned yet.

        Raises:
            LinkError: The service does not answer, or refuses, or contradicts itself; the next call returns what was
                read so far.
        """
        last, restarts = self._last if self._is_doubtful else None, 0
        if last and await read_ring(self._client, common.Event, common.EVENT_ROWS, last.number, last.number) != [last]:
            self._restart()
        self._is_doubtful = False
        while True:
            page, found = await self._page()
            kept = page.newest - max(page.oldest, 1) + 1
            if not (0 <= kept <= MOST_KEPT and (not page.next_first or page.next_first <= page.newest)):
                raise LinkError(  # reading would not come to an end
                    f"{self._client.peer}: its journal contradicts itself: events {page.oldest} to {page.newest}, next "
                    f"{page.next_first}"
                )
            if page.newest < self._newest:
                restarts += 1
                if restarts > 1:
                    raise LinkError(f"{self._client.peer}: its journal reports another last event at each query")
                self._restart()
                continue
            if 1 < self._next < page.oldest:
                self.missed += page.oldest - self._next
            self._read += [event for event in found if not self._kinds or event.kind in self._kinds]
            self._newest = page.newest
            if page.next_first <= self._next:
                self._next = max(self._next, page.newest + 1)
                events, self._read = self._read, []
                self._last = events[-1] if events else self._last
                return events
            self._next = page.next_first

    def _restart(self) -> None:
        self.restarted, self._next, self._newest, self._last = True, 1, 0, None

    async def _page(self) -> tuple[common.JournalPage, list[common.Event]]:
        if not self.limited:
            kind = next(iter(self._kinds)) if len(self._kinds) == 1 else 0
            query = common.JournalQuery(self._next, kind, ANY_SUBJECT)
            try:
                page, rows = await self._client.query(
                    query, common.JournalPage, common.JournalAnswer, common.QUERY_ROWS
                )
            except RequestRefusedError as error:
                if error.exception_code not in NO_ROLE:
                    raise
                self.limited = True
            else:
                return page, [common.Event(*row) for row in rows[: page.found]]
        self.page = page = await self._client.read(common.JournalPage)
        first = max(self._next, page.newest - self._most + 1)
        kept = await read_ring(self._client, common.Event, common.EVENT_ROWS, first, page.newest)
        events = sorted(event for event in kept if event.number >= first)  # newer ones may have come meanwhile
        newest = max([page.newest, *(event.number for event in events)])
        return common.JournalPage(max(page.oldest, newest - common.EVENT_ROWS + 1), newest, len(events)), events
