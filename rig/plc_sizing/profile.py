"""A PLC as a profile: a TOML file with its memory, its speed and where the figures are from (`docs/budget.md`)."""

import math
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Final, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from coldloop.config import load_configuration
from coldloop.errors import ConfigurationError, UsageError
from rig.plc_sizing.reference_plc import Array, fitted

LISTING: Final = "docs/budget.md lists the keys"
SHIPPED: Final = files("rig.plc_sizing") / "profiles"
FEWEST_SIZES: Final = 3
"""Of a factorisation, for a curve of three coefficients."""
TIMES_HEADER: Final = ("size", "plc_ms")
"""First columns of a file of factorisation times."""

_Positive = Annotated[float, Field(strict=True, gt=0.0, allow_inf_nan=False)]


class PlcProfile(BaseModel):
    """What decides whether a controller runs on a PLC."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=80)]
    source: Annotated[str, Field(min_length=1)]
    """Where the figures are from."""
    memory_bytes: Annotated[int, Field(strict=True, ge=1)]
    """For the data of the optimiser; numbers are of single precision."""
    cycle_s: _Positive | None = None
    """Time after which its cycle monitoring stops a program."""
    factorisations: Path | None = None
    """CSV of measured times of the Cholesky factorisation: size, plc_ms; beside the profile."""
    operation_ns: _Positive | None = None
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
    shipped = SHIPPED / f"{name}.toml"
    if "/" not in name and shipped.is_file():
        with as_file(SHIPPED) as folder:
            return _read(folder / f"{name}.toml")
    if not Path(name).exists():
        raise UsageError(f"--plc {name}: neither a file nor one of {', '.join(shipped_profiles())}")
    return _read(Path(name))


def _read(path: Path) -> PlcProfile:
    profile = load_configuration(PlcProfile, file=path, environment={}, option="--plc", listing=LISTING).settings
    if profile.factorisations is None:
        return profile
    return profile.model_copy(update={"factorisations": path.parent / profile.factorisations})


def _times(path: Path) -> tuple[Array, Array]:
    """Return sizes and times in seconds."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise ConfigurationError(f"{path}: not UTF-8 text; save it as UTF-8") from None
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}; name a CSV file with `factorisations`") from None
    rows = [(number, line.split(",")) for number, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not rows or tuple(cell.strip() for cell in rows[0][1][:2]) != TIMES_HEADER:
        raise ConfigurationError(f"{path}: the first line must be the header {','.join(TIMES_HEADER)}")
    found = {}
    for number, cells in rows[1:]:
        try:
            size, plc_ms = (float(cell) for cell in cells[:2])
        except ValueError:
            raise ConfigurationError(f"{path}: line {number}: not a size and a time in milliseconds") from None
        if not (1.0 <= size < np.inf and 0.0 < plc_ms < np.inf):
            raise ConfigurationError(f"{path}: line {number}: a size of at least 1 and a time above 0 are needed")
        found[size] = plc_ms * 1e-3
    if len(found) < FEWEST_SIZES:
        raise ConfigurationError(f"{path}: {len(found)} sizes; the curve needs {FEWEST_SIZES} or more")
    return np.array(list(found)), np.array(list(found.values()))
