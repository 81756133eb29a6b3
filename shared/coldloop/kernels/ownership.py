"""Which code is ours: only of that does more count for a digest than its name."""

import functools
import sys
import sysconfig
from pathlib import Path
from typing import Any, Final

PROJECT: Final = frozenset(
    {
        "coldloop",
        "coldloop_plant",
        "coldloop_control_plc",
        "coldloop_optimizer_plc",
        "coldloop_hmi",
        "coldloop_rig",
        "tests",
    }
)
"""Packages that are ours wherever they are installed; what is not part of an installed distribution is ours, too."""
NOT_DECISIVE: Final = frozenset({
    "coldloop.kernels.cache_folder", "coldloop.kernels.compiled", "coldloop.kernels.data",
    "coldloop.kernels.description", "coldloop.kernels.first_use", "coldloop.kernels.implementations",
    "coldloop.kernels.lean_numba", "coldloop.kernels.ownership", "coldloop.kernels.reach", "coldloop.service.logs",
})  # fmt: skip
"""Modules that decide where results are kept and what is logged, and not what results are."""


def label(value: Any) -> str:  # noqa: ANN401 anything
    """Return the full name of a function or a class, or that of an object's type."""
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    if not isinstance(name, str):
        return label(type(value))
    return f"{getattr(value, '__module__', None)}.{name}"


@functools.cache
def is_own(module: str | None) -> bool:
    """Return whether a module is ours: neither Python's nor that of an installed distribution."""
    package = (module or "").partition(".")[0]
    if package in PROJECT:
        return True
    if not package or package in sys.builtin_module_names or package in sys.stdlib_module_names - {"__main__"}:
        return False
    found = sys.modules.get(package)
    places = [getattr(found, "__file__", None), *getattr(found, "__path__", ())]
    installed = {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")}
    return any(place and installed.isdisjoint(Path(place).parents) for place in places)


def is_decisive(holder: Any) -> bool:  # noqa: ANN401 anything
    """Return whether more counts of a function, a class or an instance than its name."""
    module = getattr(holder, "__module__", None)
    return module not in NOT_DECISIVE and is_own(module)


def is_decisive_module(name: str) -> bool:
    """Return whether what a module has counts."""
    return name not in NOT_DECISIVE and is_own(name)
