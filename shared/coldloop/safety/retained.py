"""State that survives a restart: one small file, replaced whole or not at all.

A draft is written beside it, synced to the disk and renamed over it, and the folder is synced (`replace_file`): a
process that is killed at any byte, or a power cut, leaves the old state or the new one. What cannot be trusted (torn,
of another program or model, no state, no ordinary file) is refused with a reason, and set aside. `RetainedStateWriter`
writes in a thread: the scan never waits for a disk.
"""

import json
import logging
import os
import stat
import threading
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from coldloop import errors, text

MAGIC = "coldloop-retained"
MOST_BYTES: Final = 2**26
"""No state is larger."""
ORDINARY: Final = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
"""Neither waits for the other end of a FIFO, nor follows a link."""
PAUSE_S: Final = 0.02
"""Between two writes: in lock-step thousands of scans a second need not all reach the disk."""
RETRY_S: Final = 1.0
"""After a write that failed."""
CLOSING_S: Final = 2.0
"""How long the end of a program waits for the disk."""


class RetainedStateError(errors.ColdloopError):
    """A retained state cannot be trusted, or cannot be written."""


class RetainSettings(BaseModel, frozen=True, extra="forbid"):
    """Folder of the retained state."""

    file: Path | None = None
    """None keeps nothing: a restarted service has no state."""


def encoded(state: Mapping[str, Any], owner: str, digest: int) -> bytes:
    """Return the bytes of a file: a line that describes the state, and the state as JSON."""
    content = json.dumps(state, separators=(",", ":")).encode()
    return _description(content, owner, digest) + content


def decoded(data: bytes, owner: str, digest: int) -> dict[str, Any]:
    """Return the state that these bytes hold.

    Raises:
        RetainedStateError: They are torn, not ours, or no state.
    """
    line, _, content = data.partition(b"\n")
    if line + b"\n" != _description(content, owner, digest):
        words = line.decode(errors="replace").split()
        complaint = "a torn retained state"
        if words[:1] != [MAGIC]:
            complaint = "not a retained state"
        elif words[1:3] != [owner, f"{digest:08x}"]:
            complaint = "the retained state of another program or model"
        raise RetainedStateError(f"{complaint}; it is not used")
    try:
        state = text.parsed_json(content)
    except ValueError:
        raise RetainedStateError("it holds no valid state; it is not used") from None
    if not isinstance(state, dict):
        raise RetainedStateError("it holds no valid state; it is not used")
    return state


def _description(content: bytes, owner: str, digest: int) -> bytes:
    fields = f"{MAGIC} {owner} {digest:08x} {len(content)} {zlib.crc32(content):08x}"
    return f"{fields} {zlib.crc32(fields.encode()):08x}\n".encode()


class RetainedFile:
    """The retained state of one program, in a file.

    `owner` is the name of the program and the version of its state, without spaces; `digest` are 32 bits of what the
    state belongs to: the model.
    """

    def __init__(self, path: Path, owner: str, digest: int) -> None:
        self.path = path
        self._owner = owner
        self._digest = digest

    def save(self, state: Mapping[str, Any], *, synced: bool = True) -> None:
        """Replace the state.

        `synced` waits until the disk has it: milliseconds, or much longer on a slow disk. Without, the state survives
        the end of the process, but not that of the machine.

        Raises:
            RetainedStateError: The file cannot be written.
        """
        if _is_device(self.path):
            raise RetainedStateError(f"{self.path}: a device; name another file in retain.file")
        try:
            text.replace_file(self.path, encoded(state, self._owner, self._digest), synced=synced, alone=True)
        except OSError as error:
            raise RetainedStateError(f"{self.path}: {error.strerror}; name another file in retain.file") from None

    def load(self) -> dict[str, Any] | None:
        """Return the state; None when there is none yet.

        Raises:
            RetainedStateError: The file is torn, or not ours.
        """
        try:
            return decoded(_read(self.path), self._owner, self._digest)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise RetainedStateError(f"{self.path}: {error.strerror}") from None
        except RetainedStateError as error:
            raise RetainedStateError(f"{self.path}: {error}") from None

    def set_aside(self) -> str:
        """Give a file that cannot be used another name, so that it is not overwritten; return words for it."""
        if _is_device(self.path):
            return "left where it is: a device"
        aside = self.path.with_name(f"{self.path.name}.refused")
        try:
            self.path.replace(aside)
        except OSError as error:
            return f"left where it is: {error.strerror}"
        return f"set aside as {aside.name}"


def _is_device(path: Path) -> bool:
    """Return whether a path is a device, such as /dev/null, which an administrator could replace for everybody."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISBLK(mode)


def _read(path: Path) -> bytes:
    """Return the content of an ordinary file."""
    with open(path, "rb", opener=lambda name, _flags: os.open(name, ORDINARY)) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise RetainedStateError("not a regular file; it is not used")
        if status.st_size > MOST_BYTES:
            raise RetainedStateError(f"{status.st_size} bytes are too many for a state; it is not used")
        return file.read(MOST_BYTES)


log = logging.getLogger("coldloop.safety.retained")


class RetainedStateWriter:
    """Writes the newest state to a file, whenever there is a newer one than that on the disk.

    A failure is logged once, and so is the first write after it that succeeds; until then the newest state is tried
    again and again. Writes are `pause_s` apart, `retry_s` where one has failed.
    """

    def __init__(self, file: RetainedFile, *, pause_s: float = PAUSE_S, retry_s: float = RETRY_S) -> None:
        self.failed: str | None = None
        """Why the newest state is not on the disk, when the last write failed; any thread may read it."""
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
        with self._changed:
            self._changed.wait_for(lambda: self._written == self._kept or self._ended, within_s)
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
        before, self.failed = self.failed, self._failure(state)
        if self.failed is not None:
            if before is None:
                log.error("the state is not retained", extra={"reason": self.failed})
            return
        if before is not None:
            log.warning("the state is retained again", extra={"file": str(self._file.path)})
        with self._changed:
            self._written = number
            self._changed.notify_all()

    def _failure(self, state: Mapping[str, Any]) -> str | None:
        try:
            self._file.save(state)
        except Exception as error:  # noqa: BLE001 - whatever it is, scans continue and an alarm is raised
            return str(error) or repr(error)
        return None
