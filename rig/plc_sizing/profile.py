"""A PLC as a profile: a TOML file with its memory, its speed and where the figures are from (`docs/budget.md`)."""

import math
import os
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Final, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from coldloop.config import load_configuration
from coldloop.errors import ConfigurationError, UsageError
from rig.plc_sizing.reference_plc import Array, fitted

LISTING: Final = "`coldloop docs keys` lists the keys"
SHIPPED: Final = files("rig.plc_sizing") / "profiles"
FEWEST_SIZES: Final = 3
"""Of a factorisation, for a curve of three coefficients."""
TIMES_HEADER: Final = ("size", "plc_ms")
"""First columns of a file of factorisation times."""

LARGEST_FILE: Final = 1_000_000
"""Bytes of a file of times."""
LARGEST_SIZE: Final = 10_000
SHORTEST_MS, LONGEST_MS = 1e-6, 1e9


class PlcProfile(BaseModel):
    """What decides whether a controller runs on a PLC."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    name: Annotated[str, Field(min_length=1, max_length=80)]
    """As sentences and tables have it."""
    source: Annotated[str, Field(min_length=1)]
    """Where the figures are from."""
    memory_bytes: Annotated[int, Field(strict=True, ge=1, le=10**15)]
    """For the data of the optimiser; numbers are of single precision."""
    cycle_s: Annotated[float, Field(strict=True, ge=1e-4, le=1e3)] | None = None
    """Time after which its cycle monitoring stops a program."""
    factorisations: Path | None = None
    """CSV of measured times of the Cholesky factorisation: size, plc_ms; beside the profile."""
    operation_ns: Annotated[float, Field(strict=True, ge=1e-3, le=1e9)] | None = None
    """Time of a floating-point operation by its data sheet, if no factorisation has been timed."""
    overhead: Annotated[float, Field(strict=True, ge=1.0, le=1000.0)] = 1.0
    """Times as long as that which an operation takes in a program: indices, loops, loads and stores."""

    @field_validator("name", "source")
    @classmethod
    def _on_one_line(cls, value: str) -> str:
        if not value.isprintable():
            raise ValueError("has a line end or a control character; write it on one line")
        return value

    @model_validator(mode="after")
    def _one_speed(self) -> Self:
        if (self.factorisations is None) == (self.operation_ns is None):
            raise ValueError("give either factorisations or operation_ns: the speed is one of them")
        if self.factorisations is not None and "overhead" in self.model_fields_set:
            raise ValueError("overhead belongs to operation_ns; measured factorisations have theirs in them")
        return self

    def flops_per_s(self, length: float) -> float:
        """Return its speed in loops of this length.

        Raises:
            ConfigurationError: The file of the factorisations cannot be read.
        """
        if self.factorisations is not None:
            return fitted(*_times(self.factorisations)).flops_per_s(length)
        return 1e9 / self.overhead / (self.operation_ns or math.inf)  # one of both is given


def shipped_profiles() -> list[str]:
    """Return the names of the profiles that come with Coldloop."""
    return sorted(entry.name.removesuffix(".toml") for entry in SHIPPED.iterdir() if entry.name.endswith(".toml"))


def find_profile(name: str) -> PlcProfile:
    """Return a shipped profile, or that of a file.

    Raises:
        UsageError: There is none of this name, or something in it is wrong; one line that says what.
    """
    if name in shipped_profiles():
        with as_file(SHIPPED) as folder:
            return _read(folder / f"{name}.toml")
    if not os.path.exists(name):  # noqa: PTH110 a path raises an error where a name is too long
        raise UsageError(f"--plc {name}: neither a file nor one of {', '.join(shipped_profiles())}")
    return _read(Path(name))


def _read(path: Path) -> PlcProfile:
    profile = load_configuration(PlcProfile, file=path, environment={}, option="--plc", listing=LISTING).settings
    if profile.factorisations is None:
        return profile
    return profile.model_copy(update={"factorisations": path.parent / profile.factorisations})


def _times(path: Path) -> tuple[Array, Array]:
    """Return sizes, in rising order, and times in seconds."""
    rows = _rows(path)
    if not rows or tuple(cell.strip() for cell in rows[0][1][:2]) != TIMES_HEADER:
        raise ConfigurationError(f"{path}: the first line must be the header {','.join(TIMES_HEADER)}")
    found: dict[float, float] = {}
    for number, cells in rows[1:]:
        size, plc_ms = _pair(f"{path}: line {number}", cells)
        if size in found:
            raise ConfigurationError(f"{path}: line {number}: the size {size:g} is there twice; leave one time of it")
        found[size] = plc_ms * 1e-3
    if len(found) < FEWEST_SIZES:
        raise ConfigurationError(f"{path}: {len(found)} sizes; the curve needs {FEWEST_SIZES} or more")
    sizes, times = np.array(sorted(found)), np.array([found[size] for size in sorted(found)])
    if (np.diff(times) <= 0.0).any():
        raise ConfigurationError(f"{path}: a larger size takes no longer than a smaller one; times have to rise")
    return sizes, times


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return the lines that are no comments, with their numbers."""
    try:
        with path.open("rb") as file:  # a device has no end
            content = file.read(LARGEST_FILE + 1)
        if len(content) > LARGEST_FILE:
            raise ConfigurationError(f"{path}: not a file of times: more than {LARGEST_FILE} bytes")
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ConfigurationError(f"{path}: not UTF-8 text; save it as UTF-8") from None
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}; name a CSV file with `factorisations`") from None
    return [(number, line.split(",")) for number, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]


def _pair(where: str, cells: list[str]) -> tuple[float, float]:
    """Return a size and its time in milliseconds."""
    try:
        size, plc_ms = (float(cell) for cell in cells[:2])
    except ValueError:
        raise ConfigurationError(f"{where}: not a size and a time in milliseconds") from None
    if not (1.0 <= size <= LARGEST_SIZE and SHORTEST_MS <= plc_ms <= LONGEST_MS):
        raise ConfigurationError(
            f"{where}: sizes are from 1 to {LARGEST_SIZE}, times from {SHORTEST_MS:g} to {LONGEST_MS:g} ms"
        )
    return size, plc_ms
