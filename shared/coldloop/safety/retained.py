"""State that survives a restart: one small file, replaced whole or not at all.

A draft is written beside it, synced to the disk and renamed over it, and the folder is synced: a process that is killed
at any byte, or a power cut, leaves the old state or the new one. What cannot be trusted (torn, of another program or
model, no state, no ordinary file) is refused with a reason, and set aside. `RetainedStateWriter` of
`retained_writer.py` does this off the scan's way.
"""

import contextlib
import json
import os
import stat
import zlib
from collections.abc import Mapping
from io import FileIO
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict

from coldloop.errors import ColdloopError
from coldloop.parsing import parsed_json

MAGIC = "coldloop-retained"
MOST_BYTES: Final = 2**26
"""No state is larger."""
ORDINARY: Final = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
"""Neither waits for the other end of a FIFO, nor follows a link."""


class RetainedStateError(ColdloopError):
    """A retained state cannot be trusted, or cannot be written."""


class RetainSettings(BaseModel):
    """Where the state is kept."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
        raise RetainedStateError(f"{_complaint(line, owner, digest)}; it is not used")
    try:
        state = parsed_json(content)
    except ValueError:
        raise RetainedStateError("it holds no valid state; it is not used") from None
    if not isinstance(state, dict):
        raise RetainedStateError("it holds no valid state; it is not used")
    return state


def _description(content: bytes, owner: str, digest: int) -> bytes:
    fields = f"{MAGIC} {owner} {digest:08x} {len(content)} {zlib.crc32(content):08x}"
    return f"{fields} {zlib.crc32(fields.encode()):08x}\n".encode()


def _complaint(line: bytes, owner: str, digest: int) -> str:
    words = line.decode(errors="replace").split()
    if words[:1] != [MAGIC]:
        return "not a retained state"
    if words[1:3] != [owner, f"{digest:08x}"]:
        return "the retained state of another program or model"
    return "a torn retained state"


class RetainedFile:
    """The retained state of one program.

    Args:
        path: Where it is.
        owner: Name of the program and version of its state, without spaces.
        digest: 32 bits of what the state belongs to: the model.
    """

    def __init__(self, path: Path, owner: str, digest: int) -> None:
        self.path = path
        self._owner = owner
        self._digest = digest

    def save(self, state: Mapping[str, Any], *, synced: bool = True) -> None:
        """Replace the state.

        Args:
            state: The new one.
            synced: Wait until the disk has it: milliseconds, or much longer on a slow disk. Without, the state survives
                the end of the process, but not that of the machine.

        Raises:
            RetainedStateError: The file cannot be written.
        """
        if _is_device(self.path):
            raise RetainedStateError(f"{self.path}: a device; name another file in retain.file")
        try:
            _replace(self.path, encoded(state, self._owner, self._digest), synced=synced)
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


def _new(path: Path) -> FileIO:
    """Create a draft; a leftover one is removed and not followed."""
    try:
        return path.open("xb", buffering=0)
    except FileExistsError:
        path.unlink()
        return path.open("xb", buffering=0)


def _replace(path: Path, data: bytes, *, synced: bool) -> None:
    """Let a file have this content, or the one that it had."""
    draft = path.with_name(f"{path.name}.draft")
    try:
        with _new(draft) as file:
            rest = memoryview(data)
            while rest:
                rest = rest[file.write(rest) :]
            if synced:
                os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):  # half a draft would only fill the disk further
            draft.unlink(missing_ok=True)
        raise
    if synced:
        _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Let the disk have the names in a folder; only POSIX systems can."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
