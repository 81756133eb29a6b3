"""Cost of an export on its PLC, from its manifest: operations of its calls, bytes, times."""

from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, ValidationError

from coldloop.errors import UsageError
from coldloop.parsing import parsed_json
from coldloop.text_file import held_file, read_bytes
from coldloop_rig.plc_sizing.plc import PlcProfile
from coldloop_rig.text_tables import markdown_table

MANIFEST: Final = "manifest.json"
MOST_BYTES: Final = 2**24
ITERATION: Final = "iteration"
COLUMNS: Final = ("call", "least", "mean", "most recorded", "worst case")

Count = Annotated[float, Field(ge=0)]


class CallCost(BaseModel):
    """Operations of a call of one kind."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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


class ExportCost(BaseModel):
    """Operations and bytes that an export needs."""

    model_config = ConfigDict(frozen=True, extra="ignore")

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
    """Return what an export needs, from its folder.

    Raises:
        UsageError: It is no export.
    """
    try:
        return ExportCost.model_validate(parsed_json(read_bytes(held_file(folder, MANIFEST, ""), "", most=MOST_BYTES)))
    except (UsageError, ValueError, ValidationError):
        raise UsageError(f"{folder}: has no manifest of an export (coldloop export plc --out FOLDER)") from None


def cost_text(cost: ExportCost, profile: PlcProfile | None = None) -> str:
    """Return tables of operations and bytes, with the times on a PLC and a line for each thing that does not fit."""
    header = (*COLUMNS, *(("worst case, s",) if profile else ()))
    title = "Operations of a call:"
    if cost.work:
        header = ("what", *header[1:])
        took = f", {cost.seconds(cost.work + cost.piece, profile):.3g} s" if profile else ""
        title = f"Operations, in calls that do {cost.work:,} and at most {cost.piece:,} more{took}:"
    rows = [(name, *_numbers(each), *((f"{cost.seconds(each.bound, profile):.3f}",) if profile else ()))
            for name, each in cost.operations.items()]  # fmt: skip
    memory = [(what, f"{size:,}") for what, size in cost.bytes.items()]
    tables = [markdown_table(header, rows, title), markdown_table(("bytes", ""), memory)]
    if profile:
        found = misfits(cost, profile)
        tables += ["\n".join(found) if found else f"{profile.name}: it fits, in memory and time."]
    return "\n\n".join(tables) + "\n"


def _numbers(call: CallCost) -> tuple[str, ...]:
    return tuple("" if each is None else f"{each:,.0f}" for each in (call.least, call.mean, call.most, call.worst))


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

    Its name and memory are for the user to fill in.

    Raises:
        UsageError: The export has no self-test of the solver.
    """
    if not cost.self_test:
        raise UsageError("--took: this export has no self-test of the solver alone; name the folder above it")
    nanoseconds = 1e3 * total_us / cost.self_test["operations"]
    return (
        'name = "our PLC"\n'
        f'source = "self-test of the export: {cost.self_test["iterations"]} iterations in {total_us:g} us"\n'
        f"memory_bytes = {cost.memory}  # what the export takes: put the PLC's here\n"
        f"operation_ns = {nanoseconds:.4e}\n"
    )
