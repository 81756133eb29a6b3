"""The folder of compiled kernels and of what takes long to compute, shared by processes and versions of Coldloop.

It is `kernels` in `COLDLOOP_CACHE_DIR`, or in the user's cache directory. The name of a file has a digest of all that
its content depends on, so nothing in the folder is ever out of date. What nobody has used for `KEPT_DAYS` is deleted by
a process that adds something, once a day; so are the folders of versions that had one for each state of the sources.

Compiling takes long and happens once. A user of kernels names their owner with `kernels_of`; the cache of kernels
reports each one that it does not have to `needs_compiling`. Nothing is announced if all are cached.
"""

import contextlib
import os
import shutil
import stat
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from coldloop.errors import ConfigurationError

try:
    import fcntl
except ImportError:  # Windows: processes may compile the same kernel twice
    fcntl = None  # type: ignore[assignment]

NAME: Final = "kernels"
LOCKS: Final = "locks"
TIDIED: Final = "tidied"
OF_OLDER_VERSIONS: Final = "kernels-" + 16 * "[0-9a-f]"
CHECKSUM_BYTES: Final = 4
KEPT_DAYS: Final = 60
DAY_S: Final = 86_400.0
_MASK: Final = threading.Lock()


class CacheFolder:
    """A folder whose files appear whole or not at all."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._locks: int | None = None
        if fcntl is not None:
            with contextlib.suppress(OSError):  # another user's, who shares the folder
                self._locks = os.open(path / LOCKS, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)

    def read(self, name: str) -> bytes | None:
        """Return the content of a file, and note that it is used; None where there is none, or a damaged one."""
        path = self.path / name
        try:
            found = path.read_bytes()
        except OSError:
            return None
        with contextlib.suppress(OSError):  # another user's
            if time.time() - path.stat().st_mtime > DAY_S:
                path.touch()
        checksum, content = found[:CHECKSUM_BYTES], found[CHECKSUM_BYTES:]
        return content if zlib.crc32(content).to_bytes(CHECKSUM_BYTES, "big") == checksum else None

    def has(self, name: str) -> bool:
        """Return whether there is a file, damaged or not."""
        return (self.path / name).is_file()

    def write(self, name: str, content: bytes) -> None:
        """Write a file that every user reads, as images are made by root; nothing is written where that fails."""
        with contextlib.suppress(OSError):
            handle, draft = tempfile.mkstemp(dir=self.path, prefix="draft-")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(zlib.crc32(content).to_bytes(CHECKSUM_BYTES, "big") + content)
                Path(draft).chmod(0o644)
                Path(draft).replace(self.path / name)
            finally:
                Path(draft).unlink(missing_ok=True)
            self._tidy()

    def lock(self, name: str) -> None:
        """Wait until no other process has locked a name; a process that ends lets go of its locks."""
        if self._locks is not None:
            with contextlib.suppress(OSError):  # a file system without locks: a kernel may be compiled twice
                fcntl.lockf(self._locks, fcntl.LOCK_EX, 1, zlib.crc32(name.encode()))

    def unlock(self, name: str) -> None:
        """Let other processes lock a name."""
        if self._locks is not None:
            with contextlib.suppress(OSError):
                fcntl.lockf(self._locks, fcntl.LOCK_UN, 1, zlib.crc32(name.encode()))

    def _tidy(self) -> None:
        """Delete what has not been used for long, once a day."""
        tidied, now = self.path / TIDIED, time.time()
        if tidied.exists() and now - tidied.stat().st_mtime < DAY_S:
            return
        tidied.touch()
        for path in (*self.path.iterdir(), *self.path.parent.glob(OF_OLDER_VERSIONS)):
            with contextlib.suppress(OSError):
                if path.name == LOCKS or now - path.stat().st_mtime < KEPT_DAYS * DAY_S:
                    continue
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()


def find_cache_folder(name: str = NAME) -> Path:
    """Return a folder for a cache that only this user can write to: its files are loaded as code.

    `name` is what is kept, such as kernels. ConfigurationError: others can write to the one that the environment names.
    """
    chosen = os.environ.get("COLDLOOP_CACHE_DIR")
    roots = [Path(tempfile.gettempdir()) / f"coldloop-cache-{os.getuid() if hasattr(os, 'getuid') else 0}"]
    with contextlib.suppress(RuntimeError):  # a user without a home
        roots.insert(0, Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "coldloop")
    for root in [Path(chosen)] if chosen else roots:
        folder = root / name
        try:
            root.mkdir(mode=0o755, parents=True, exist_ok=True)
            folder.mkdir(mode=0o755, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            closed = _is_closed(root, sticky=True) and _is_closed(folder)
            with _MASK:  # it is read by setting it
                mask = os.umask(0o077)
                os.umask(mask)
            if closed and not mask & stat.S_IWOTH:
                folder.chmod(0o700)
        except OSError as error:
            if chosen:
                sys.stderr.write(
                    f"COLDLOOP_CACHE_DIR={chosen}: {error.strerror}; {name} are made for this process alone\n"
                )
            continue
        if closed:
            return folder
        if chosen:
            raise ConfigurationError(
                f"COLDLOOP_CACHE_DIR={chosen}: others can write to {folder}, and {name} are loaded as code: name a "
                "folder of your own, or take the permission away (chmod -R go-w)"
            )
    return Path(tempfile.mkdtemp(prefix=f"coldloop-{name}-"))


def _is_closed(folder: Path, *, sticky: bool = False) -> bool:
    """Return whether only this user and an administrator can write to a folder; the user's own group is left alone.

    `sticky`: others may write to it if they cannot replace what this user has in it, as in /tmp.
    """
    if not hasattr(os, "getuid"):  # Windows has no such modes
        return True
    status = folder.stat()
    by_others = status.st_mode & stat.S_IWOTH or (status.st_mode & stat.S_IWGRP and status.st_gid != os.getgid())
    return status.st_uid in (0, os.getuid()) and not (by_others and not (sticky and status.st_mode & stat.S_ISVTX))


@dataclass
class Kernels:
    """Kernels that may have to be compiled."""

    owner: str
    """Owner of the kernels, such as "the refrigerator"."""
    about_s: int
    """Seconds that compiling all of them takes."""


Announce = Callable[..., None]


def write_line(*kernels: Kernels) -> None:
    """Announce on standard error; kernels of several owners are compiled at the same time, where there are cores."""
    owners = " and of ".join(each.owner for each in kernels)
    seconds = [each.about_s for each in kernels]
    about_s = max(seconds) if (os.cpu_count() or 1) > 1 else sum(seconds)
    with contextlib.suppress(OSError):
        sys.stderr.write(
            f"coldloop: compiling the kernels of {owners}; this takes about {about_s} s and happens once\n"
        )
        sys.stderr.flush()


_needed: ContextVar[Kernels | None] = ContextVar("kernels that are needed", default=None)
"""Kernels that the user has asked for at present, in this thread; what they need themselves is a part of them."""
_announced: set[str] = set()
_announce: Announce = write_line


def announce(*kernels: Kernels) -> None:
    """Announce what is compiled now, in the way that was chosen."""
    _announce(*kernels)


def announce_with(announce: Announce) -> None:
    """Use `announce` from now on."""
    global _announce  # noqa: PLW0603 one user a process
    _announce = announce


@contextlib.contextmanager
def kernels_of(owner: str, about_s: int) -> Iterator[None]:
    """Announce what is compiled in this context as the kernels of `owner`."""
    token = _needed.set(_needed.get() or Kernels(owner, about_s))
    try:
        yield
    finally:
        _needed.reset(token)


def needs_compiling() -> None:
    """Announce the kernels that are needed at present, unless they have been announced."""
    needed = _needed.get()
    if needed is not None and needed.owner not in _announced:
        _announced.add(needed.owner)
        _announce(needed)


TAKEN_ALONG: Final = ("cffi", "coverage", "scipy", "yaml")
"""Packages that numba imports wherever they are installed, in a third of its time; our kernels have no use for them."""


def load_numba_alone() -> None:
    """Import numba, and what it needs to load a compiled kernel; what is hidden from it can be imported afterwards.

    Others may have kernels that need it: this is for processes that are Coldloop's alone.
    """
    hidden = [name for name in TAKEN_ALONG if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type] # None is a module that cannot be had
    try:
        import numba  # noqa: F401, PLC0415

        with contextlib.suppress(ImportError, AttributeError):  # elsewhere: the first kernel does it
            from numba.core.registry import cpu_target  # noqa: PLC0415

            cpu_target.target_context.refresh()
    finally:
        for name in hidden:
            del sys.modules[name]
