"""Text files of users, files in folders of others, and files that appear whole or not at all.

A text is UTF-8, with a byte order mark or without, or UTF-16 with one. Only a regular file is replaced.
"""

import codecs
import errno
import hashlib
import os
import socket
import stat
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from coldloop.errors import ColdloopError, UsageError

MOST_BYTES: Final = 2**28
"""Size of a file, at most."""
MARKS: Final = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
"""Byte order marks, and the encodings that they begin."""
HANDED_OVER: Final = ("/dev/stdin", "/dev/fd/", "/proc/self/fd/", os.devnull)
"""Beginnings of the names of what is read though it may be no regular file: a shell's pipes, and nothing."""


def read_text(path: Path, remedy: str, error: type[ColdloopError] = UsageError, most: int = MOST_BYTES) -> str:
    """Return the text of a file.

    Args:
        path: A regular file, or what a shell hands over (`/dev/stdin`, `<(...)`).
        remedy: Ends the message where the file cannot be read.
        error: What is raised.
        most: Size of the file in bytes.

    Raises:
        ColdloopError: It cannot be read, is too large or no text; one line, of the kind `error`.
    """
    data = read_bytes(path, remedy, error, most)
    try:
        return decoded(data)
    except UnicodeDecodeError as failure:
        raise error(f"{path}: {not_text(failure)}") from None


def read_bytes(path: Path, remedy: str, error: type[ColdloopError] = UsageError, most: int = MOST_BYTES) -> bytes:
    """Return the content of a file, as `read_text` does."""
    try:
        with open(path, "rb", opener=_opened) as file:
            fits = os.fstat(file.fileno()).st_size <= most
            data = file.read(most + 1) if fits else b""
    except (OSError, ValueError) as failure:
        raise error(f"{path}: {getattr(failure, 'strerror', failure)}; {remedy}") from None
    if not fits or len(data) > most:  # one that grows
        raise error(f"{path}: more than {most} bytes; {remedy}")
    return data


def file_digest(path: Path, remedy: str = "make it readable", error: type[ColdloopError] = UsageError) -> str:
    """Return the SHA-256 of a file of any size, in hexadecimal; `remedy` and `error` as those of `read_text`."""
    try:
        with open(path, "rb", opener=_opened) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError) as failure:
        raise error(f"{path}: {getattr(failure, 'strerror', failure)}; {remedy}") from None


def _opened(path: str, flags: int) -> int:
    """Open a regular file, without waiting for the other end of a pipe."""
    if path.startswith(HANDED_OVER):
        return os.open(path, flags)
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))  # not on Windows
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, "not a regular file")


def held_file(folder: Path, name: str, remedy: str, error: type[ColdloopError] = UsageError) -> Path:
    """Return the path of a regular file in a folder that somebody else has made.

    Args:
        folder: The folder.
        name: Of the file, relative to the folder, as the folder itself may say it.
        remedy: Ends the message.
        error: What is raised.

    Raises:
        ColdloopError: There is none, or it is something else, or outside the folder, by its name or by a link.
    """
    path = folder / name
    try:
        status = path.stat()
        inside = path.resolve().is_relative_to(folder.resolve()) and ".." not in Path(name).parts
    except (OSError, ValueError, RuntimeError) as failure:
        raise error(f"{path}: {getattr(failure, 'strerror', None) or failure}; {remedy}") from None
    if not inside or Path(name).is_absolute():
        raise error(f"{path}: outside the folder that names it; {remedy}")
    if not stat.S_ISREG(status.st_mode):
        raise error(f"{path}: not a regular file; {remedy}")
    return path


def decoded(data: bytes) -> str:
    """Return the text that bytes hold.

    Raises:
        UnicodeDecodeError: They are not UTF-8, nor UTF-16 with a byte order mark.
    """
    return data.decode(next((coding for mark, coding in MARKS.items() if data.startswith(mark)), "utf-8"))


def not_text(error: UnicodeDecodeError) -> str:
    """Return what is wrong with a file that is no text, and the remedy."""
    return f"not UTF-8 text (byte {error.start}); save it as UTF-8, not compressed"


def require_regular_file(path: Path) -> None:
    """Refuse to replace a device, a folder or a pipe by a file.

    Raises:
        UsageError: The path exists and is something else than a regular file.
    """
    if path.exists() and not path.is_file():
        raise UsageError(f"{path}: exists and is not a regular file; name another one")


def draft_of(path: Path) -> Path:
    """Return the name of a file until it is whole: another one for each process and thread."""
    return path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.{threading.get_native_id()}.draft")


def whole_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make the file under another name, then give it its own; others may do so at the same time."""
    require_regular_file(path)
    _give_name(path, write)


def whole_text(path: Path, text: str, *, synced: bool = False) -> None:
    """Write a text; `synced`: the disk has it when it gets its name, also if power fails."""
    require_regular_file(path)
    replace_file(path, text.encode(), synced=synced)


def replace_file(path: Path, data: bytes, *, synced: bool = False, private: bool = False, alone: bool = False) -> None:
    """Let a file have this content, or the one that it had; whatever is there under its name is replaced.

    Args:
        path: The file.
        data: Its content.
        synced: The disk has the content before the name, and the name when this returns, also if power fails.
        private: Nobody else can read it.
        alone: No other process writes this file: the draft of one that was killed is written over.

    Raises:
        OSError: It cannot be written.
    """

    def write(draft: Path) -> None:
        with draft.open("xb", buffering=0) as file:
            if private:
                os.fchmod(file.fileno(), 0o600)
            rest = memoryview(data)
            while rest:
                rest = rest[file.write(rest) :]
            if synced:
                os.fsync(file.fileno())

    _give_name(path, write, path.with_name(f".{path.name}.draft") if alone else None)
    if synced and os.name == "posix":  # only there a folder can be synced
        descriptor = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _give_name(path: Path, write: Callable[[Path], object], draft: Path | None = None) -> None:
    draft = draft or draft_of(path)
    try:
        draft.unlink(missing_ok=True)  # left by a process of the same number; a link is not followed
        write(draft)
        draft.replace(path)
    finally:
        with suppress(OSError):  # half a draft would only fill the disk further
            draft.unlink(missing_ok=True)
