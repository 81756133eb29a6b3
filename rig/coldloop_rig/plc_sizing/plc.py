"""PLCs: the reference one, from the times of the Cholesky factorisation in the paper, others by profiles, and exports.

A profile is a TOML file with memory, speed and where the figures are from (`docs/budget.md`). The cost of an export on
its PLC follows from its manifest: operations of its calls, bytes, times.
"""

import math
import os
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Final, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, Field, PositiveFloat, ValidationError, field_validator, model_validator
from scipy.optimize import nnls

from coldloop import config, errors, text
from coldloop.table import read_table
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_rig.plc_sizing.operations import dense_cholesky
from coldloop_rig.text_tables import markdown_table

MEMORY_BYTES = 2_000_000
"""The memory card, shared by code and variables: the paper's 2 Mb, which 4 * 700^2 bytes just fit."""
QPOASES_ON_LAPTOP_S = 120e-6
"""One iteration of qpOASES on the paper's laptop."""


class CholeskyTimes(NamedTuple):
    """Measured times; shape (25,) each."""

    size: Array
    plc_s: Array
    laptop_s: Array


class SpeedCurve(NamedTuple):
    """Time of a factorisation, c1 n + c2 n^2 + c3 n^3 in seconds: the work at the start of loops, and within them."""

    c1: float
    c2: float
    c3: float

    def time_s(self, n: float) -> float:
        """Return the time of a Cholesky factorisation of size n, in seconds."""
        return n * (self.c1 + n * (self.c2 + n * self.c3))

    def flops_per_s(self, length: float) -> float:
        """Return the speed in loops as long as those of a factorisation of size `length`."""
        return dense_cholesky(length).flops / self.time_s(length)


def cholesky_times() -> CholeskyTimes:
    """Read the paper's table."""
    table = np.loadtxt(Path(__file__).parent / "data" / "cholesky_times.csv", delimiter=",", skiprows=4)
    return CholeskyTimes(table[:, 0], table[:, 1] * 1e-3, table[:, 2] * 1e-6)


def fitted(size: Array, plc_s: Array) -> SpeedCurve:
    """Return the curve without negative coefficients that has the least sum of squared relative errors."""
    powers = np.stack([size, size**2, size**3], axis=1) / plc_s[:, None]
    coefficients, _ = nnls(powers, np.ones(len(size)))
    return SpeedCurve(*coefficients.tolist())


def reference_curve() -> SpeedCurve:
    """Return the curve of the paper's table."""
    times = cholesky_times()
    return fitted(times.size, times.plc_s)


def residuals(curve: SpeedCurve, times: CholeskyTimes) -> Array:
    """Return the relative errors of the curve, shape (25,)."""
    return np.array([curve.time_s(n) for n in times.size.tolist()]) / times.plc_s - 1.0


def slow_down(times: CholeskyTimes, size: float) -> float:
    """Return how many times longer than the laptop the PLC takes, between the sizes of the table."""
    return float(np.interp(size, times.size, times.plc_s / times.laptop_s))


LISTING: Final = "`coldloop docs keys` lists the keys"
SHIPPED: Final = files("coldloop_rig.plc_sizing") / "profiles"
FEWEST_SIZES: Final = 3  # fewest sizes with a measured factorisation time, for a curve of three coefficients
TIMES_HEADER: Final = ("size", "plc_ms")  # first columns of a file of factorisation times

LARGEST_SIZE: Final = 10_000
SHORTEST_MS, LONGEST_MS = 1e-6, 1e9


class PlcProfile(BaseModel, frozen=True, extra="forbid", use_attribute_docstrings=True):
    """Properties of a PLC that decide whether a controller runs on it."""

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
        """Return its speed in loops of this length. Raises ConfigurationError: the factorisations cannot be read."""
        if self.factorisations is not None:
            return fitted(*_times(self.factorisations)).flops_per_s(length)
        return 1e9 / self.overhead / (self.operation_ns or math.inf)  # one of both is given


def shipped_profiles() -> list[str]:
    """Return the names of the profiles that come with Coldloop."""
    return sorted(entry.name.removesuffix(".toml") for entry in SHIPPED.iterdir() if entry.name.endswith(".toml"))


def find_profile(name: str) -> PlcProfile:
    """Return a shipped profile, or that of a file. Raises UsageError: there is none, or something in it is wrong."""
    if name in shipped_profiles():
        with as_file(SHIPPED) as folder:
            return _read(folder / f"{name}.toml")
    if not os.path.exists(name):  # noqa: PTH110 a path raises an error where a name is too long
        raise errors.UsageError(f"--plc {name}: neither a file nor one of {', '.join(shipped_profiles())}")
    return _read(Path(name))


def _read(path: Path) -> PlcProfile:
    profile = config.load_configuration(PlcProfile, file=path, environment={}, option="--plc", listing=LISTING).settings
    if profile.factorisations is None:
        return profile
    return profile.model_copy(update={"factorisations": path.parent / profile.factorisations})


def _times(path: Path) -> tuple[Array, Array]:
    """Return sizes, in rising order, and times in seconds."""
    table = read_table(path, TIMES_HEADER, "name a CSV file with `factorisations`", errors.ConfigurationError)
    found: dict[float, float] = {}
    for (number, _), size, plc_ms in zip(table.rows, *table.columns(TIMES_HEADER), strict=True):
        if not (1.0 <= size <= LARGEST_SIZE and SHORTEST_MS <= plc_ms <= LONGEST_MS):
            raise errors.ConfigurationError(
                f"{path}: line {number}: sizes are from 1 to {LARGEST_SIZE}, times from {SHORTEST_MS:g} to "
                f"{LONGEST_MS:g} ms"
            )
        if size in found:
            raise errors.ConfigurationError(
                f"{path}: line {number}: the size {size:g} is there twice; leave one time of it"
            )
        found[size] = plc_ms * 1e-3
    if len(found) < FEWEST_SIZES:
        raise errors.ConfigurationError(f"{path}: {len(found)} sizes; the curve needs {FEWEST_SIZES} or more")
    sizes, times = np.array(sorted(found)), np.array([found[size] for size in sorted(found)])
    if (np.diff(times) <= 0.0).any():
        raise errors.ConfigurationError(f"{path}: a larger size takes no longer than a smaller one; times have to rise")
    return sizes, times


# -- exports -----------------------------------------------------------------------------------------------------------

MANIFEST: Final = "manifest.json"
MOST_BYTES: Final = 2**24
ITERATION: Final = "iteration"
COLUMNS: Final = ("call", "least", "mean", "most recorded", "worst case")

Count = Annotated[float, Field(ge=0)]


class CallCost(BaseModel, frozen=True, extra="forbid"):
    """Operations of a call of one kind."""

    least: Count
    mean: Count
    most: Count
    """Largest number of operations in a recorded call."""
    worst: Count | None = None
    """Largest number of operations that a call can have; None if not known."""

    @property
    def bound(self) -> float:
        """The most that is known of."""
        return self.worst or self.most


class ExportCost(BaseModel, frozen=True, extra="ignore"):
    """Operations and bytes that an export needs."""

    variables: Annotated[int, Field(ge=1)]
    operations: dict[str, CallCost]
    """Operations of a call, by the kind of the call."""
    bytes: dict[str, int]
    """Bytes of memory, by use."""
    self_test: dict[str, int] = {}
    """Iterations and operations of the solver in the self-test."""
    work: Annotated[int, Field(ge=0)] = 0
    """Operations that a call is given to do; 0 where each call does all of its kind."""
    piece: Annotated[int, Field(ge=0)] = 0
    """Operations that a call does beyond `work` at most."""
    longest_period_s: PositiveFloat = 5.0
    """Longest updating period; exports that do not say it are of the cold box."""

    @property
    def calls(self) -> dict[str, float]:
        """Most operations of a call, by what it does."""
        if self.work:
            return {"call": self.work + self.piece}
        return {f"call ({name})": call.bound for name, call in self.operations.items()}

    @property
    def memory(self) -> int:
        """Bytes without the self-test."""
        return sum(size for what, size in self.bytes.items() if not what.startswith("self-test"))

    def seconds(self, operations: float, profile: PlcProfile) -> float:
        """Return the time of so many operations on a PLC."""
        return operations / profile.flops_per_s(self.variables)


def read_cost(folder: Path) -> ExportCost:
    """Return what an export needs, from its folder. Raises UsageError: it is no export."""
    try:
        return ExportCost.model_validate(
            text.parsed_json(text.read_bytes(text.held_file(folder, MANIFEST, ""), "", most=MOST_BYTES))
        )
    except (errors.UsageError, ValueError, ValidationError):
        raise errors.UsageError(f"{folder}: has no manifest of an export (coldloop export plc --out FOLDER)") from None


def cost_text(cost: ExportCost, profile: PlcProfile | None = None) -> str:
    """Return tables of operations and bytes, with the times on a PLC and a line for each thing that does not fit."""
    header = (*COLUMNS, *(("worst case, s",) if profile else ()))
    title = "Operations of a call:"
    if cost.work:
        header = ("what", *header[1:])
        took = f", {cost.seconds(cost.work + cost.piece, profile):.3g} s" if profile else ""
        title = f"Operations, in calls that do {cost.work:,} and at most {cost.piece:,} more{took}:"
    rows = []
    for name, call in cost.operations.items():
        counts = ("" if each is None else f"{each:,.0f}" for each in (call.least, call.mean, call.most, call.worst))
        rows.append((name, *counts, *((f"{cost.seconds(call.bound, profile):.3f}",) if profile else ())))
    memory = [(what, f"{size:,}") for what, size in cost.bytes.items()]
    tables = [markdown_table(header, rows, title), markdown_table(("bytes", ""), memory)]
    if profile:
        found = misfits(cost, profile)
        tables += ["\n".join(found) if found else f"{profile.name}: it fits, in memory and time."]
    return "\n\n".join(tables) + "\n"


def misfits(cost: ExportCost, profile: PlcProfile) -> list[str]:
    """Return a line for each thing that does not fit into a PLC."""
    found = []
    if cost.memory > profile.memory_bytes:
        found.append(f"{profile.name}: memory: it takes {cost.memory:,} of {profile.memory_bytes:,} bytes")
    remedy = "give a call less work" if cost.work else "set that higher"
    for call, operations in cost.calls.items():
        longest_s = cost.seconds(operations, profile)
        if profile.cycle_s is not None and longest_s > profile.cycle_s:
            found.append(f"{profile.name}: a {call} takes up to {longest_s:.3g} s, and its cycle monitoring"
                         f" stops a program after {profile.cycle_s:g} s: {remedy}")  # fmt: skip
    once_s = cost.seconds(sum(call.bound for call in cost.operations.values()), profile)
    longest_s = cost.longest_period_s
    if once_s > longest_s:
        found.append(f"{profile.name}: time: with one iteration it takes up to {once_s:.3g} s, and the longest updating"
                     f" period is {longest_s:g} s")  # fmt: skip
    return found


def profile_of(cost: ExportCost, total_us: float) -> str:
    """Return the profile of a PLC that took so long for the iterations of the self-test, as TOML.

    Its name and memory are for the user to fill in. Raises UsageError: the export has no self-test of the solver.
    """
    if not cost.self_test:
        raise errors.UsageError("--took: this export has no self-test of the solver alone; name the folder above it")
    nanoseconds = 1e3 * total_us / cost.self_test["operations"]
    return (
        'name = "our PLC"\n'
        f'source = "self-test of the export: {cost.self_test["iterations"]} iterations in {total_us:g} us"\n'
        f"memory_bytes = {cost.memory}  # what the export takes: put the PLC's here\n"
        f"operation_ns = {nanoseconds:.4e}\n"
    )
