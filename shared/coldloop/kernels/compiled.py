"""Numerical kernels, compiled once and cached.

Kernels are compiled without fast-math and without contraction of multiply-add, loops run in the order they are
written: the same inputs give the same bits in every process and on every processor.

The cache lives in `COLDLOOP_CACHE_DIR`, or in the user's cache directory, in a folder named after a digest of the
sources of all compiled modules: numba itself does not notice that a kernel called from another file has changed. What
takes long to compute and depends on those sources is kept there too.

Processes that need the same kernel at once compile it once: one does, the others wait for it (`SharedCache`).
"""

import contextlib
import hashlib
import os
import stat
import sys
import tempfile
import zlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numba.core.caching import FunctionCache
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.kernels.first_use import needs_compiling

try:
    import fcntl
except ImportError:  # Windows: processes may compile the same kernel twice
    fcntl = None  # type: ignore[assignment]

P = ParamSpec("P")
R = TypeVar("R")

COMPILED_PACKAGES = ("plant", "optimizer_plc")
COMPILED_MODULES = (
    "coldloop.kernels.borrowing", "coldloop.kernels.compiled", "coldloop.kernels.single_precision",
    "coldloop.process.cold_box", "coldloop.process.signals", "control_plc.output_limits",
    "control_plc.sensors", "rig.cosim.compiled.cold_box_plants", "rig.cosim.compiled.loops",
    "rig.cosim.compiled.own_plants", "rig.cosim.compiled.plants", "rig.cosim.compiled.portable",
    "rig.cosim.compiled.records",
)  # fmt: skip
"""What kernels call from other packages."""


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` in nopython mode on its first call for given types, or load it from the cache."""
    return _cached(function, numba.njit(error_model="numpy")(function))


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` as `kernel` does, and copy its code into each kernel that calls it.

    For small functions in inner loops: a call that passes tables costs more than reading them. The bits are the same.
    """
    return _cached(function, numba.njit(error_model="numpy", forceinline=True)(function))


def _cached(function: Callable[P, R], dispatcher: Any) -> Callable[P, R]:  # noqa: ANN401 numba has no types
    cache = SharedCache(function)  # type: ignore[no-untyped-call]
    compile_kernel = dispatcher.compile

    def compile_in_turn(signature: Any) -> Any:  # noqa: ANN401
        try:
            return compile_kernel(signature)
        finally:
            cache.unlock()

    dispatcher._cache = cache  # noqa: SLF001 as numba's enable_caching does
    dispatcher.compile = compile_in_turn
    return cast("Callable[P, R]", dispatcher)


class SharedCache(FunctionCache):
    """numba's cache of one function, locked by the process that compiles a kernel until it is saved.

    Without the lock two processes compile the same kernel, and may save different ones under the same name. It is one
    byte of a file, for each function another; a process that ends lets go of it. Locks are taken from callers to what
    they call, so no two processes wait for each other.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        """Return the kernel for a signature; None, with the lock, when this process is to compile it."""
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        if found is None:
            self._lock()
            # another process may have compiled it meanwhile
            found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
            if found is None:
                needs_compiling()
        return found

    def _lock(self) -> None:
        if _locks is not None:
            with contextlib.suppress(OSError):  # a file system without locks: a kernel may be compiled twice
                fcntl.lockf(_locks, fcntl.LOCK_EX, 1, self._place)

    def unlock(self) -> None:
        """Let others compile."""
        if _locks is not None:
            with contextlib.suppress(OSError):
                fcntl.lockf(_locks, fcntl.LOCK_UN, 1, self._place)

    @property
    def _place(self) -> int:
        """The byte that is this function's."""
        return zlib.crc32(f"{self.cache_path}/{self._impl.filename_base}".encode())


def _sources_digest() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for package in COMPILED_PACKAGES:
        for source in sorted(source for folder in _folders(package) for source in folder.rglob("*.py")):
            digest.update(source.read_bytes())
    for module in COMPILED_MODULES:
        package, *path = module.split(".")
        for folder in _folders(package):
            digest.update(folder.joinpath(*path).with_suffix(".py").read_bytes())
    return digest.hexdigest()[:16]


def _folders(package: str) -> list[Path]:
    """Return where a package is installed, without importing it; not every service has all of them."""
    spec = find_spec(package)
    return [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec else []


def kept(name: str, of: bytes, compute: Callable[[], NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return what `compute` returns for `of`, from the cache where it is there and whole."""
    path = Path(str(numba.config.CACHE_DIR)) / f"{name}-{hashlib.sha256(of).hexdigest()[:24]}.npy"  # type: ignore[attr-defined]
    try:
        found: NDArray[np.float64] = np.load(path)
    except (OSError, ValueError, EOFError):
        found = compute()
        with contextlib.suppress(OSError):
            _keep(path, found)
    return found


def _keep(path: Path, found: NDArray[np.float64]) -> None:
    """Write a file that appears whole or not at all; every user reads it, as the other files of the cache."""
    handle, draft = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.save(file, found)
        Path(draft).chmod(0o644)
        Path(draft).replace(path)
    finally:
        Path(draft).unlink(missing_ok=True)


def _cache_directory() -> Path:
    """Return a folder for the cache that only this user can write to: its files are loaded as code.

    Raises:
        ConfigurationError: Others can write to the one that the environment names.
    """
    chosen = os.environ.get("COLDLOOP_CACHE_DIR")
    for root in [Path(chosen)] if chosen else _usual_roots():
        folder = root / f"kernels-{_sources_digest()}"
        try:
            root.mkdir(mode=0o755, parents=True, exist_ok=True)
            folder.mkdir(mode=0o755, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            closed = _is_closed(root, sticky=True) and _is_closed(folder)
            if closed and _lets_others_write():  # to what numba makes in it
                folder.chmod(0o700)
        except OSError as error:
            if chosen:
                sys.stderr.write(
                    f"COLDLOOP_CACHE_DIR={chosen}: {error.strerror}; kernels are compiled for this process alone\n"
                )
            continue
        if closed:
            return folder
        if chosen:
            raise ConfigurationError(
                f"COLDLOOP_CACHE_DIR={chosen}: others can write to {folder}, and kernels are loaded as code: name a "
                "folder of your own, or take the permission away (chmod -R go-w)"
            )
    return Path(tempfile.mkdtemp(prefix="coldloop-kernels-"))


def _usual_roots() -> list[Path]:
    roots = [Path(tempfile.gettempdir()) / f"coldloop-cache-{_user()}"]
    with contextlib.suppress(RuntimeError):  # a user without a home
        roots.insert(0, Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "coldloop")
    return roots


def _lets_others_write() -> bool:
    """Return whether everyone can write to new files of this process."""
    mask = os.umask(0o077)
    os.umask(mask)
    return not mask & stat.S_IWOTH


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def _is_closed(folder: Path, *, sticky: bool = False) -> bool:
    """Return whether only this user and an administrator can write to a folder; the user's own group is left alone.

    Args:
        folder: Which one.
        sticky: Others may write to it if they cannot replace what this user has in it, as in /tmp.
    """
    if not hasattr(os, "getuid"):  # Windows has no such modes
        return True
    status = folder.stat()
    by_others = status.st_mode & stat.S_IWOTH or (status.st_mode & stat.S_IWGRP and status.st_gid != os.getgid())
    return status.st_uid in (0, os.getuid()) and not (by_others and not (sticky and status.st_mode & stat.S_ISVTX))


def _file_of_locks(folder: Path) -> int | None:
    if fcntl is None:
        return None
    try:
        return os.open(folder / "locks", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    except OSError:  # another user's, who shares the folder
        return None


numba.config.CACHE_DIR = str(_cache_directory())  # type: ignore[attr-defined]
_locks = _file_of_locks(Path(numba.config.CACHE_DIR))  # type: ignore[attr-defined]
