"""One stream of changes for all browsers: encoded once, sent to each; a slow browser delays no other."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Callable
from typing import Final

from coldloop_hmi.access import Party

WAITING: Final = 16
"""Messages that wait for one browser."""


class Stream:
    """What one browser is sent.

    Args:
        party: Whose browser it is.
    """

    def __init__(self, party: Party) -> None:
        self.party = party
        self._messages: asyncio.Queue[bytes | None] = asyncio.Queue(WAITING)
        self.is_behind = True
        """It has missed messages: it needs the whole state next."""

    def offer(self, message: bytes) -> None:
        """Add a message; a browser that is too slow loses all that wait."""
        try:
            self._messages.put_nowait(message)
        except asyncio.QueueFull:
            self._drop()
            self.is_behind = True

    def end(self) -> None:
        """End it: nothing follows."""
        self._drop()
        self._messages.put_nowait(None)

    def _drop(self) -> None:
        while not self._messages.empty():
            self._messages.get_nowait()

    async def next(self) -> bytes | None:
        """Return the next message; None at its end."""
        return await self._messages.get()


class Broadcast:
    """Fans messages out.

    Args:
        whole: Returns the whole state as a message, for a browser that begins.
        most: Streams at a time. When there are so many, a user who has logged in takes the place of a stranger, and
            within either group a party takes the place of one that has at least two more.
    """

    def __init__(self, whole: Callable[[], bytes], most: int) -> None:
        self._whole = whole
        self._most = most
        self._streams: dict[Stream, None] = {}  # the oldest first

    def __len__(self) -> int:
        return len(self._streams)

    def send(self, message: bytes) -> None:
        """Send a message to all browsers; those that are behind get the whole state in its place."""
        whole: bytes | None = None
        for stream in self._streams:
            if stream.is_behind:
                whole = whole or self._whole()
                stream.is_behind = False
                stream.offer(whole)
            else:
                stream.offer(message)

    def begin(self, party: Party) -> Stream | None:
        """Begin a stream with the whole state; return None where there is no room for it."""
        if len(self._streams) >= self._most:
            loser = self._giving_way(party)
            if loser is None:
                return None
            del self._streams[loser]
            loser.end()
        stream = Stream(party)
        stream.is_behind = False
        stream.offer(self._whole())
        self._streams[stream] = None
        return stream

    def _giving_way(self, party: Party) -> Stream | None:
        """Return the stream that gives way to a newcomer: the oldest one of the party that has most."""
        group = [stream for stream in self._streams if stream.party.has_session == party.has_session]
        least = Counter(stream.party for stream in group)[party] + 2
        strangers = [stream for stream in self._streams if not stream.party.has_session]
        if party.has_session and strangers:
            group, least = strangers, 1
        counts = Counter(stream.party for stream in group)
        if not counts:
            return None
        largest, count = counts.most_common(1)[0]
        return next(stream for stream in group if stream.party == largest) if count >= least else None

    async def messages(self, stream: Stream) -> AsyncIterator[bytes]:
        """Yield the whole state, and then what changes, until the stream ends."""
        try:
            while (message := await stream.next()) is not None:
                yield message
        finally:
            self._streams.pop(stream, None)
