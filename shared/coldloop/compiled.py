"""Numerical kernels, compiled once and cached.

Kernels are compiled without fast-math and without contraction of multiply-add, loops run in the order they are
written: the same inputs give the same bits in every process and on every processor.

The cache lives in `COLDLOOP_CACHE_DIR`, or in the user's cache directory, in a folder named after a digest of the
sources of all compiled modules: numba itself does not notice that a kernel called from another file has changed.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

COMPILED_PACKAGES = ("coldloop", "plant", "control_plc", "optimizer_plc", "rig.compiled")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` in nopython mode on its first call for given types, or load it from the cache."""
    return cast("Callable[P, R]", numba.njit(cache=True, error_model="numpy")(function))


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` as `kernel` does, and copy its code into each kernel that calls it.

    For small functions in inner loops: a call that passes tables costs more than reading them. The bits are the same.
    """
    return cast("Callable[P, R]", numba.njit(cache=True, error_model="numpy", forceinline=True)(function))


def _sources_digest() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for package in COMPILED_PACKAGES:
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for source in sorted(Path(folder).rglob("*.py")):
                digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _cache_directory() -> Path:
    chosen = os.environ.get("COLDLOOP_CACHE_DIR")
    home_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "coldloop"
    for root in [Path(chosen)] if chosen else [home_cache, Path(tempfile.gettempdir()) / "coldloop-cache"]:
        folder = root / f"kernels-{_sources_digest()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        return folder
    return Path(tempfile.mkdtemp(prefix="coldloop-kernels-"))


numba.config.CACHE_DIR = str(_cache_directory())  # type: ignore[attr-defined]
