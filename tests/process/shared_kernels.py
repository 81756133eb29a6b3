"""Prints the constants that are compiled into kernels, as JSON: `{"module.kernel": {NAME: value}}`.

Kernels are cached for the types of their arguments: for processes that have the same types the same kernels are used.
Their index in the cache names all types that they were compiled for: each process must know those of all others.
"""

import json
import sys
from types import FunctionType

import numpy as np
from numba.core.dispatcher import Dispatcher

import rig.cosim.compiled.cold_box_plants
import rig.cosim.compiled.own_plants
import rig.cosim.compiled.stretches
import rig.cosim.one_process  # noqa: F401 all that a run has
from rig.cosim.compiled.portable import PORTABLE


def kernels() -> set[FunctionType]:
    """Return the functions that are compiled."""
    ours = ("coldloop", "plant", "optimizer_plc", "rig")
    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] in ours]
    found = {value.py_func for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return found | set(PORTABLE)


def constants(function: FunctionType) -> dict[str, str]:
    """Return what a function reads of its module."""
    read = {name: function.__globals__.get(name) for name in function.__code__.co_names}
    return {
        name: repr(value) for name, value in read.items() if isinstance(value, int | float | tuple | list | np.ndarray)
    }


if __name__ == "__main__":
    found = {f"{each.__module__}.{each.__name__}": constants(each) for each in kernels()}
    sys.stdout.write(json.dumps(found))
