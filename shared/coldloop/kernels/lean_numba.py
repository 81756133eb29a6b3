"""numba without the packages that it takes along wherever they are installed: a third of the time that it needs.

They are for functions, callbacks and files that our kernels do not use. Others may have kernels that do: so this is for
processes that are Coldloop's alone, and importing Coldloop does not do it.
"""

import contextlib
import sys
from collections.abc import Iterator
from typing import Final

TAKEN_ALONG: Final = ("cffi", "coverage", "scipy", "yaml")


def load_numba_alone() -> None:
    """Import numba, and what it needs to load a compiled kernel; what is hidden from it can be imported afterwards."""
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
