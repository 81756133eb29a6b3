"""Reads a process file, and checks what only a file may not have."""

from keyword import iskeyword
from pathlib import Path
from typing import Final

from coldloop.config import load_configuration
from coldloop.errors import ConfigurationError
from coldloop.process.declaration import Process

LISTING: Final = "`coldloop docs keys` lists all keys"
RESERVED: Final = frozenset((
    "tick", "session", "holder", "generation", "crc", "mode", "update", "u", "time_s", "load", "load_w", "cause",
    "driver", "bad_sensors", "stage_cost", "tau_u_s", "iterations", "j", "model_range", "none", "no_load",
))  # fmt: skip
"""Fields of registers and columns of a trace, in small letters."""


OWN: Final = ("plants", "shipped_mimic", "iterations", "forecasts", "drawing")
"""Keys of the cold box, and what is found with a model: no file of a user gives them."""


def read_process_file(path: Path) -> Process:
    """Return what a process file says.

    Raises:
        ConfigurationError: One line that names file, key and remedy.
    """
    file = load_configuration(Process, file=path, environment={}, option="FILE", listing=LISTING).settings
    if wrong := _wrong(file):
        raise ConfigurationError(f"{path}: {wrong}")
    return file


def _wrong(file: Process) -> str:  # noqa: PLR0911 a return for each
    """Return what is wrong with a process that is still without its model; empty where nothing is."""
    if own := [str(key) for key in OWN if key in file.model_fields_set]:
        return f"{own[0]}: is found with the model, or the cold box's own; leave it out"
    if own := [one.name for one in file.outputs if one.quantity]:
        return f"{own[0]}: a quantity is the cold box's own; leave it out"
    plant, signals = file.plant, (*file.inputs, *file.outputs, *file.outside)
    names = [each.name for each in signals]
    lower = [name.lower() for name in names]
    reserved = RESERVED.intersection(lower) | {name for name in names if iskeyword(name) or iskeyword(name.lower())}
    if plant == type(plant)():
        return "plant: is missing; say where it comes from, as in `coldloop docs your-plant`"
    if twice := [name for name in names if lower.count(name.lower()) > 1]:
        return f"{twice[0]}: two signals have this name (small and capital letters are the same)"
    if reserved:
        return f"{min(reserved)}: a register, a column or Python has this name already; choose another"
    if file.prediction.step_test and (plant.matrices or plant.step_test):
        return "prediction.step_test: plant.matrices and plant.step_test are a model already; keep one"
    if plant.fmu is None and (named := [one.name for one in signals if one.variable]):
        return f"{named[0]}: variable is for an FMU"
    return ""
