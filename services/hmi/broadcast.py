"""One stream of changes for all browsers: encoded once, sent to each; for a slow browser nobody waits."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Final

WAITING: Final = 16
"""Messages that wait for one browser."""


class Stream:
    """What one browser is sent."""

    def __init__(self) -> None:
        self._messages: asyncio.Queue[bytes] = asyncio.Queue(WAITING)
        self.is_behind = True
        """It has missed messages: it needs the whole state next."""

    def offer(self, message: bytes) -> None:
        """Add a message; a browser that is too slow loses all that wait."""
        try:
            self._messages.put_nowait(message)
        except asyncio.QueueFull:
            while not self._messages.empty():
                self._messages.get_nowait()
            self.is_behind = True

    async def next(self) -> bytes:
        """Return the next message."""
        return await self._messages.get()


class Broadcast:
    """Fans messages out.

    Args:
        whole: Returns the whole state as a message, for a browser that begins.
        most: Streams at a time.
    """

    def __init__(self, whole: Callable[[], bytes], most: int) -> None:
        self._whole = whole
        self._most = most
        self._streams: set[Stream] = set()

    def __len__(self) -> int:
        return len(self._streams)

    @property
    def is_full(self) -> bool:
        """Whether no more browsers are served."""
        return len(self._streams) >= self._most

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

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield the whole state, and then what changes."""
        stream = Stream()
        stream.is_behind = False
        stream.offer(self._whole())
        self._streams.add(stream)
        try:
            while True:
                yield await stream.next()
        finally:
            self._streams.discard(stream)
