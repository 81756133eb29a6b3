"""The folder in which this user's rigs keep what others must neither read nor change.

It is `coldloop` in `XDG_RUNTIME_DIR`, if that is a folder of this user, or `coldloop-UID` in the folder for temporary
files. Folders are used only if they belong to this user and are closed to others, and are not links: another user may
have made them first where everybody can write. Files are opened without following links.
"""

import os
import stat
import tempfile
from pathlib import Path
from typing import IO, Final

from coldloop.errors import UsageError

OWN_ONLY: Final = 0o700
MOST_BYTES: Final = 65536
"""Size of a file about a rig, at most."""


def base_folder() -> Path:
    """Return where the folders of all rigs of this user are; it need not be there."""
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    if runtime.is_absolute() and runtime.is_dir() and runtime.stat().st_uid == os.getuid():
        return runtime / "coldloop"
    return Path(tempfile.gettempdir()) / f"coldloop-{os.getuid()}"


def make_private(folder: Path) -> Path:
    """Make a folder within one that exists, closed to others; return it.

    Raises:
        UsageError: It cannot be made, or its place is taken by a file of another user.
    """
    try:
        folder.mkdir(mode=OWN_ONLY, exist_ok=True)
    except FileExistsError:
        pass  # not a folder: said below
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; set XDG_RUNTIME_DIR to a folder of your own") from None
    if not is_private(folder):
        raise UsageError(
            f"{folder}: not a folder of this user alone (owner, mode 0700, no link); remove it, or set XDG_RUNTIME_DIR "
            "to a folder of your own"
        )
    return folder


def make_own_folder(name: str) -> Path:
    """Make a private folder of this name in the one of all rigs; return it.

    Raises:
        UsageError: It cannot be made, or belongs to another user.
    """
    return make_private(make_private(base_folder()) / name)


def is_private(folder: Path) -> bool:
    """Return whether something is a folder that belongs to this user and is closed to all others."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077


def read_own(file: Path) -> str:
    """Return the text of a small file in a private folder.

    Raises:
        OSError: It is not there, or cannot be read.
        ValueError: It is not a regular file of this user, is too large, or is not UTF-8 text.
    """
    with open(file, "rb", opener=_not_following) as content:
        status = os.fstat(content.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid():
            raise ValueError("not a file of this user")
        data = content.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise ValueError("too large")
    return data.decode("utf-8")


def new_own(file: Path) -> IO[bytes]:
    """Return a new file in a private folder, open for writing; what was there under its name is removed.

    Raises:
        OSError: It cannot be made.
    """
    file.unlink(missing_ok=True)
    return open(file, "xb", opener=_not_following)


def write_own(file: Path, text: str) -> None:
    """Write a file in a private folder, which appears whole; what was there under its name is replaced.

    Raises:
        OSError: It cannot be written.
    """
    draft = file.with_name(f".{file.name}.draft")
    try:
        with new_own(draft) as content:
            content.write(text.encode())
        draft.replace(file)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(file)) from None


def _not_following(path: str, flags: int) -> int:
    """Open without following a link, and without waiting for a pipe's other end."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, mode=0o600)
