"""Lines that are written by a thread: a slow or absent reader never holds up the program."""

import io
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, TextIO

CAPACITY: Final = 1000
"""Lines that wait to be written; a line has a few hundred bytes."""
FLUSH_S: Final = 1.0
"""How long the end of a program waits for the reader of its lines."""

Write = Callable[[str], object]


class LineWriter:
    """A bounded queue of lines and the thread that writes them.

    Args:
        write: Writes one line; it may block, and is called by the thread alone.
        capacity: Lines that may wait.

    Attributes:
        dropped: Lines that found the queue full, since the start.
    """

    def __init__(self, write: Write, capacity: int = CAPACITY) -> None:
        self.dropped = 0
        self._write = write
        self._capacity = capacity
        self._lines: deque[str] = deque()
        self._changed = threading.Condition()
        self._writing = self._closed = False
        # A daemon: the interpreter does not wait for it at the end, when it may be blocked for good.
        threading.Thread(target=self._run, name="log lines", daemon=True).start()

    def put(self, line: str) -> bool:
        """Let a line be written after those before it; return False when it was dropped instead."""
        with self._changed:
            if self._closed or len(self._lines) >= self._capacity:
                self.dropped += 1
                return False
            self._lines.append(line)
            self._changed.notify_all()
            return True

    def flush(self, within_s: float = FLUSH_S) -> bool:
        """Wait until all lines are written; return whether they were, in time."""
        end = time.monotonic() + within_s
        with self._changed:
            while self._lines or self._writing:
                if not self._changed.wait(end - time.monotonic()):
                    return False
        return True

    def close(self, within_s: float = FLUSH_S) -> bool:
        """Take no more lines, and flush."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        return self.flush(within_s)

    def _run(self) -> None:
        while (line := self._next()) is not None:
            try:
                self._write(line)
            except (OSError, ValueError):  # the reader has gone, or the stream is closed
                with self._changed:
                    self.dropped += 1
            with self._changed:
                self._writing = False
                self._changed.notify_all()

    def _next(self) -> str | None:
        """Wait for a line and take it; None when there will be none."""
        with self._changed:
            while not self._lines and not self._closed:
                self._changed.wait()
            self._writing = bool(self._lines)
            return self._lines.popleft() if self._lines else None


def to_stream(stream: TextIO) -> Write:
    """Return how to write a line to a stream.

    A stream with a file descriptor is written to past its buffer: the interpreter takes the buffer's lock when it ends,
    and aborts when a thread that is blocked in a write holds it.
    """
    try:
        descriptor = stream.fileno()
    except io.UnsupportedOperation:
        return lambda line: stream.write(f"{line}\n")

    def write(line: str) -> None:
        data = memoryview(f"{line}\n".encode(errors="backslashreplace"))
        while data:
            data = data[os.write(descriptor, data) :]

    return write
