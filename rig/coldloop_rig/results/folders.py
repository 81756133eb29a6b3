"""Folders and files of results."""

import contextlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Any, Final

from coldloop.errors import ResultsError, UsageError
from coldloop.text import whole_text

try:
    import fcntl
except ImportError:  # Windows: two runs may share a folder
    fcntl = None  # type: ignore[assignment]


_LOCKED: Final[dict[tuple[int, int], int]] = {}
"""Descriptors of the folders that this process has claimed, by device and inode; they are held to its end."""


def claim_folder(folder: Path, *, force: bool) -> None:
    """Make the folder of a run, new or empty unless `force` is set, and keep other processes from it to our end.

    Raises UsageError: it has files in it, it cannot be written to, or another process has claimed it.
    """
    if not str(folder).isprintable():
        raise UsageError(f"{str(folder)!a}: a name that cannot be printed; choose another --out")
    try:
        taken = not force and folder.is_dir() and any(folder.iterdir())
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; choose another --out") from None
    if taken:
        raise UsageError(f"{folder}: the folder is not empty; name another one with --out, or overwrite with --force")
    prepare_folder(folder)
    if fcntl is None:
        return
    with contextlib.ExitStack() as unlocked:
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        unlocked.callback(os.close, descriptor)
        status = os.fstat(descriptor)
        key = status.st_dev, status.st_ino
        if key in _LOCKED:
            return
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"{folder}: another run is being written there; name another folder with --out") from None
        except OSError:  # a file system without locks
            return
        _LOCKED[key] = descriptor
        unlocked.pop_all()


def claim_folder_of_now(parent: Path, name: str) -> Path:
    """Make and return a folder named after what is run and when. Raises UsageError: it cannot be written to."""
    prepare_folder(parent)
    of_now = f"{name}-{datetime.now():%Y%m%d-%H%M%S}"  # noqa: DTZ005 the user's clock
    folder = parent / of_now
    for number in count(2):
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            break
        folder = parent / f"{of_now}-{number}"
    return folder


def prepare_folder(folder: Path) -> None:
    """Make the folder of a run. Raises UsageError if it cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; choose a folder that can be written to with --out") from None


@contextlib.contextmanager
def writing(place: Path, remedy: str = "choose another --out") -> Iterator[None]:
    """Have files written in this context. Raises ResultsError, in a line: one cannot be written."""
    try:
        yield
    except OSError as error:
        raise ResultsError(f"{place}: {error.strerror or error}; {remedy}") from None


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON document."""
    whole_text(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def installed_version(name: str) -> str:
    """Return the version of a package, or that it is absent."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
