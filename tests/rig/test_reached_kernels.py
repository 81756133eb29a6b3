"""The digest of a kernel is of all that numba has linked to it."""

import re
import sys
from collections.abc import Iterator
from types import FunctionType
from typing import Any

import pytest
from numba.core.dispatcher import Dispatcher

from coldloop.kernels.compiled import _parts, cache_folder
from coldloop.kernels.reach import label, reached
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.results.recording import Recorder
from coldloop_rig.runs.running import make_scenario
from coldloop_rig.settings import Settings
from tests.rig.test_precompile import OURS

pytestmark = pytest.mark.usefixtures("compiles")

MANGLED = re.compile(rb"_ZN(?:08NumbaEnv)?((?:\d+[A-Za-z_]\w*)+)")


def kernels() -> Iterator[Dispatcher]:
    """Return the kernels of all modules that have been compiled, or loaded, in each of their forms."""
    found = {
        id(form): form
        for name, module in tuple(sys.modules.items())
        if name.partition(".")[0] in OURS
        for value in vars(module).values()
        if isinstance(value, Dispatcher)
        for form in (value, value.for_kernels)
        if form.overloads
    }
    yield from found.values()


def words(mangled: str) -> list[str]:
    """Return the parts of a name, each of which has its length before it."""
    found = []
    while (match := re.match(r"\d+", mangled)) is not None:
        start, length = match.end(), int(match.group())
        found.append(mangled[start : start + length])
        mangled = mangled[start + length :]
    return found


def linked(kernel: Any, signature: tuple[Any, ...]) -> set[str]:  # noqa: ANN401 numba has no types
    """Return the functions of ours that the machine code of a kernel names."""
    cache = kernel._cache  # noqa: SLF001 numba has no other way
    code = cache_folder.read(cache.file_name(signature, kernel.targetctx.codegen()))
    assert code is not None
    names = {".".join(words(name.decode())) for name in MANGLED.findall(code)}
    return {name for name in names if name.partition(".")[0] in OURS}


def test_all_functions_that_are_linked_to_a_kernel_count_for_it() -> None:
    settings = Settings()
    scenario = make_scenario(settings, 240)
    OneProcessRig(settings, compiled=True).run(scenario, Recorder(scenario.ticks))
    seen: set[str] = set()
    for kernel in kernels():
        for signature in kernel.overloads:
            classes = [part for each in signature for part in _parts(each)]
            counted = {label(each) for each in reached(kernel, *classes) if isinstance(each, FunctionType)}
            found = {name.split("._3clocals")[0] for name in linked(kernel, signature)}
            seen |= found
            assert not found - counted, kernel
    assert len(seen) > 150
