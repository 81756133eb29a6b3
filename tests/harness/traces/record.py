"""The file of traces on record: what is in it, read and written."""

import json
from collections.abc import Collection
from datetime import date
from pathlib import Path
from typing import Final, TypedDict

from tests.harness.traces.judge import Left, Names

FILE: Final = Path(__file__).parents[2] / "traces.json"
LARGEST_BYTES: Final = 2_000_000


class RecordError(Exception):
    """The file cannot be read or written; one line that says why and what to do."""


class Platform(TypedDict):
    """Versions and processor that a record was made with."""

    python: str
    numpy: str
    scipy: str
    numba: str
    processor: str
    """Kind of processor that OpenBLAS computes for."""


class Reason(TypedDict):
    """Reason for traces that are new or have moved at a date."""

    date: str
    reason: str
    configurations: list[str]
    """Configurations whose traces are new or have moved."""


class Found(TypedDict):
    """Results of runs, by configuration."""

    made_with: Platform
    services: list[str]
    """Services by the numbers that events have."""
    names: dict[str, Names]
    """Names of columns by process, for readers: a renaming moves no trace."""
    configurations: dict[str, Left]


class Record(Found):
    """The whole file."""

    reasons: list[Reason]
    """The newest first."""


def read(file: Path | None = None) -> Record:
    """Read a file.

    Raises:
        RecordError: There is none, or what is there is no record.
    """
    file = file or FILE
    try:
        record: Record = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecordError(f"{file}: {error.strerror}; make one with scripts/traces --record REASON") from None
    except ValueError as error:
        raise RecordError(f"{file}: {error}; take it back from the last commit") from None
    return record


def write(record: Record, file: Path | None = None) -> None:
    """Write a file, with one line for each block of rows, event and indicator.

    Raises:
        RecordError: It is too large.
    """
    file = file or FILE
    text = json.dumps(record, indent=1, ensure_ascii=False) + "\n"
    if len(text.encode()) > LARGEST_BYTES:
        raise RecordError(f"{file}: would have {len(text.encode())} bytes, at most {LARGEST_BYTES}: shorten some runs")
    file.write_text(text, encoding="utf-8")


def renewed(old: Record | None, found: Found, known: Collection[str], reason: str, today: date) -> Record:
    """Return a record with what was found in the place of what it had.

    Args:
        old: What is on record, if anything is.
        found: New traces, of some or of all configurations.
        known: All configurations that there are: others are left out.
        reason: Why traces are new or have moved.
        today: Date of the record.
    """
    before = old["configurations"] if old else {}
    traces = {**before, **found["configurations"]}
    traces = {name: traces[name] for name in known if name in traces}
    moved = [name for name, left in traces.items() if left != before.get(name)]
    newest = Reason(date=today.isoformat(), reason=reason, configurations=moved)
    return Record(
        reasons=[newest, *(old["reasons"] if old else [])],
        made_with=found["made_with"],
        services=found["services"],
        names={**(old["names"] if old else {}), **found["names"]},
        configurations=traces,
    )
