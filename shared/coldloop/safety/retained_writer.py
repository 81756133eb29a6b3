"""Writes retained states in a thread: the scan never waits for a disk."""

import logging
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

from coldloop.safety.retained import RetainedFile

log = logging.getLogger("coldloop.safety.retained")

PAUSE_S: Final = 0.02
"""Between two writes: in lock-step thousands of scans a second need not all reach the disk."""
RETRY_S: Final = 1.0
"""After a write that failed."""
CLOSING_S: Final = 2.0
"""How long the end of a program waits for the disk."""


class RetainedStateWriter:
    """Writes the newest state to a file, whenever there is a newer one than that on the disk.

    A failure is logged once, and so is the first write after it that succeeds; until then the newest state is tried
    again and again.

    Args:
        file: Where to.
        pause_s: Time between writes.
        retry_s: Time between writes that fail.

    Attributes:
        failed: Why the newest state is not on the disk, when the last write failed; else None. Any thread may read it.
    """

    def __init__(self, file: RetainedFile, *, pause_s: float = PAUSE_S, retry_s: float = RETRY_S) -> None:
        self.failed: str | None = None
        self._file = file
        self._pause_s = pause_s
        self._retry_s = retry_s
        self._changed = threading.Condition()
        self._newest: Mapping[str, Any] | None = None
        self._kept = self._written = 0
        """Number of the newest state, and of the one on the disk."""
        self._closed = self._ended = False
        self._thread = threading.Thread(target=self._run, name="retained state", daemon=True)
        self._thread.start()

    def keep(self, state: Mapping[str, Any]) -> None:
        """Let a state be written in the place of those before it; returns at once.

        The state is encoded as JSON later, by the thread: neither it nor anything in it may change any more. Make it of
        numbers, strings, tuples and named tuples, and of lists and mappings that are new in each call.
        """
        with self._changed:
            self._newest = state
            self._kept += 1
            self._changed.notify_all()

    def flush(self, within_s: float = CLOSING_S) -> bool:
        """Wait until the newest state is on the disk; return whether it is, in time."""
        end = time.monotonic() + within_s
        with self._changed:
            while self._written < self._kept and not self._ended:
                if not self._changed.wait(end - time.monotonic()):
                    return False
            return self._written == self._kept

    def close(self, within_s: float = CLOSING_S) -> bool:
        """Write the newest state and end the thread; return whether the state is on the disk, in time."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(within_s)
        return self.flush(0.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._written < self._kept)
                state, number = self._newest, self._kept
                closing = self._closed
            if state is not None and self._written < number:
                self._write(state, number)
            if closing:
                break
            with self._changed:  # a close ends the pause
                self._changed.wait_for(lambda: self._closed, self._retry_s if self.failed else self._pause_s)
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _write(self, state: Mapping[str, Any], number: int) -> None:
        try:
            self._file.save(state)
        except Exception as error:  # noqa: BLE001 - whatever it is, scans continue and an alarm is raised
            self._note(str(error) or repr(error))
        else:
            self._note(None)
            with self._changed:
                self._written = number
                self._changed.notify_all()

    def _note(self, failure: str | None) -> None:
        before, self.failed = self.failed, failure
        if failure is not None and before is None:
            log.error("the state is not retained", extra={"reason": failure})
        elif failure is None and before is not None:
            log.warning("the state is retained again", extra={"file": str(self._file.path)})
