"""Preparations for kernels: announce that they are compiled, load numba without what it takes along.

Compiling takes long and happens once. A user of kernels names their owner with `kernels_of`; the cache of kernels
reports each one that it does not have to `needs_compiling`. Nothing is announced if all are cached.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Final


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
    with _hidden(*TAKEN_ALONG):
        import numba  # noqa: F401, PLC0415

        with contextlib.suppress(ImportError, AttributeError):  # elsewhere: the first kernel does it
            from numba.core.registry import cpu_target  # noqa: PLC0415

            cpu_target.target_context.refresh()


@contextlib.contextmanager
def _hidden(*packages: str) -> Iterator[None]:
    """Let imports of packages that are not loaded yet fail."""
    names = [name for name in packages if name not in sys.modules]
    sys.modules.update(dict.fromkeys(names))  # type: ignore[arg-type] # None is a module that cannot be had
    try:
        yield
    finally:
        for name in names:
            del sys.modules[name]
