"""Texts: files of users, and files that appear whole or not at all; JSON and TOML from outside; numbers in words.

A text is UTF-8, with a byte order mark or without, or UTF-16 with one. Only a regular file is replaced.

How deep a JSON or TOML text the standard library's parsers can read depends on the version of Python, and what they
return can be too deep for code that descends into it. All that is read from a file, a peer or a user is therefore read
here, and has at most `MOST_LEVELS` levels.
"""

import codecs
import errno
import hashlib
import json
import math
import os
import socket
import stat
import threading
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeVar

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
    """Return the path of a regular file in a folder that somebody else has made, which may say the name itself.

    Raises:
        ColdloopError: There is none, or it is something else, or outside the folder, by its name or by a link; of the
            kind `error`, in one line that ends with `remedy`.
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
    """Return the text that bytes hold (UnicodeDecodeError: they are not UTF-8, nor UTF-16 with a byte order mark)."""
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


def whole_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make the file under another name, then give it its own; others may do so at the same time."""
    require_regular_file(path)
    _give_name(path, write)


def whole_text(path: Path, text: str, *, synced: bool = False) -> None:
    """Write a text; `synced`: the disk has it when it gets its name, also if power fails."""
    require_regular_file(path)
    replace_file(path, text.encode(), synced=synced)


def replace_file(path: Path, data: bytes, *, synced: bool = False, private: bool = False, alone: bool = False) -> None:
    """Let a file have this content, or the one that it had (OSError); whatever is there under its name is replaced.

    Args:
        path: The file.
        data: Its content.
        synced: The disk has the content before the name, and the name when this returns, also if power fails.
        private: Nobody else can read it.
        alone: No other process writes this file: the draft of one that was killed is written over.
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
    own = f"{socket.gethostname()}.{os.getpid()}.{threading.get_native_id()}"  # of this process and thread
    draft = draft or path.with_name(f".{path.name}.{own}.draft")
    try:
        draft.unlink(missing_ok=True)  # left by a process of the same number; a link is not followed
        write(draft)
        draft.replace(path)
    finally:
        with suppress(OSError):  # half a draft would only fill the disk further
            draft.unlink(missing_ok=True)


T = TypeVar("T")
MOST_LEVELS: Final = 32
"""Objects (tables) and arrays within one another, at most."""
TOO_DEEP: Final = f"nested too deeply: more than {MOST_LEVELS} levels"
TOO_MANY_DIGITS: Final = "a number has too many digits"


def parsed_json(text: str | bytes) -> Any:  # noqa: ANN401
    """Return what a JSON text holds; bytes are UTF-8, UTF-16 or UTF-32.

    Raises:
        ValueError: It is not JSON, or beyond what can be read: a number of thousands of digits, too many levels.
    """
    try:
        return _bounded(json.loads(text))  # noqa: TID251
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


def parsed_toml(text: str) -> dict[str, Any]:
    """Return what a TOML text holds.

    Raises:
        ValueError: It is not TOML, or beyond what can be read: a number of thousands of digits, too many levels.
    """
    try:
        tree = tomllib.loads(text)  # noqa: TID251
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:
        raise ValueError(TOO_MANY_DIGITS) from None
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    return _bounded(tree)


def finite_json(document: object) -> str:
    """Return a document as JSON; numbers that are not finite are null."""

    def finite(part: object) -> object:
        if isinstance(part, Mapping):
            return {key: finite(value) for key, value in part.items()}
        if isinstance(part, list | tuple):
            return [finite(value) for value in part]
        return None if isinstance(part, float) and not math.isfinite(part) else part

    text = partial(json.dumps, ensure_ascii=False, separators=(",", ":"), default=str, allow_nan=False)
    try:
        return text(document)
    except ValueError:
        return text(finite(document))


def _bounded(tree: T) -> T:
    """Return a document that is not too deep."""
    level: list[Any] = [[tree]]
    for _ in range(MOST_LEVELS + 1):
        parts = (one.values() if isinstance(one, dict) else one for one in level)
        level = [part for each in parts for part in each if isinstance(part, dict | list)]
        if not level:
            return tree
    raise ValueError(TOO_DEEP)


PLAIN: Final = range(-4, 7)
"""Decimal exponents of numbers that are written without one."""
LONGEST_FRACTION: Final = 7
"""Digits after the point of a mark; marks that need more have an exponent."""
NEAR: Final = 1e-3
"""Tolerance of the label of a mark, in steps of the marks."""


def number_text(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, at least those before the point."""
    if not math.isfinite(value):
        return str(value)
    text, exponent = f"{value:.{digits - 1}e}".split("e")
    if float(text) == 0.0:
        return "0"
    is_plain = int(exponent) in PLAIN
    text = f"{value:.{max(0, digits - 1 - int(exponent))}f}" if is_plain else text
    text = _unsigned_zero(text.rstrip("0").rstrip(".") if "." in text else text)
    return text if is_plain else f"{text}e{int(exponent)}"


def value_text(value: float, unit: str = "") -> str:
    """Return a value of a register, which has seven digits, with its unit."""
    return f"{number_text(value, 7)} {unit}".rstrip()


def ends_text(low: float, high: float) -> str:
    """Return a range of values in words."""
    return f"{value_text(low)} to {value_text(high)}"


def axis_labels(marks: Sequence[float]) -> list[str]:
    """Return labels of the marks of a linear axis: as many digits as their step needs, so that neighbours differ."""
    known = sorted({float(mark) for mark in marks if math.isfinite(mark)})
    step = min((after - before for before, after in pairwise(known)), default=0.0)
    if step == 0.0:
        return [number_text(mark, 7) for mark in marks]
    top = max(abs(known[0]), abs(known[-1]))
    if top < 10.0**PLAIN.stop:
        for places in range(LONGEST_FRACTION + 1):
            if all(abs(float(f"{mark:.{places}f}") - mark) <= NEAR * step for mark in known):
                return [_unsigned_zero(f"{mark:.{places}f}") for mark in marks]
    digits = 1
    while digits < 17 and any(abs(float(f"{mark:.{digits - 1}e}") - mark) > NEAR * step for mark in known):
        digits += 1
    return [number_text(mark, digits) for mark in marks]


def _unsigned_zero(text: str) -> str:
    return text.removeprefix("-") if float(text) == 0.0 else text
