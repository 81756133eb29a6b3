"""Results of a configuration, and the differences of two of them, by name."""

from collections.abc import Collection, Iterator, Sequence
from typing import Final, NotRequired, TypedDict

from tests.harness.traces.checks import Table, difference, sizes_of

SHOWN: Final = 4
"""Columns of a difference that are named."""


class Names(TypedDict):
    """Names of columns, by place: for messages, never compared."""

    trace: list[str]
    updates: list[str]
    indicators: list[str]


class Left(TypedDict):
    """Results of a run, as they are in the file."""

    process: str
    processor: NotRequired[str]
    """Kind of processor that the last bits depend on, by OpenBLAS's name; without it they are the same on all."""
    trace: Table
    end: list[str]
    """Outputs, then states of the plant after the last tick, all digits of double precision, separated by spaces: the
    trace has single precision, which rounds away what moves the last bits of a plant only."""
    updates: Table
    instants: str
    """Tick of each update, separated by spaces: for messages, never compared."""
    events: list[str]
    """Each as the numbers of service, kind, tick, subject, cause."""
    indicators: list[str]
    """Each to its last digit."""


def differences(recorded: Left, found: Left, names: Names) -> Iterator[str]:
    """Yield what differs, each in a line that names tick and column, update and field, event, or indicator."""
    yield from _of_table(("tick", "column"), recorded["trace"], found["trace"], names["trace"])
    yield from _of_end(recorded, found, names["trace"])
    instants = found["instants"].split()
    yield from _of_table(("update", "field"), recorded["updates"], found["updates"], names["updates"], instants)
    yield from _of_list("event", recorded["events"], found["events"], [])
    yield from _of_list("indicator", recorded["indicators"], found["indicators"], names["indicators"])


def _of_table(
    kinds: tuple[str, str], recorded: Table, found: Table, names: Sequence[str], instants: Sequence[str] = ()
) -> Iterator[str]:
    """Yield where two tables begin to differ; `kinds` are the words for a row and a column."""
    row, column = kinds
    before, now = sizes_of(recorded), sizes_of(found)
    if before != now:
        yield f"{column}s: {' + '.join(map(str, before))} on record, now {' + '.join(map(str, now))}"
        return
    if recorded["rows"] != found["rows"]:
        yield f"{row}s: {recorded['rows']} on record, now {found['rows']}"
    seen = difference(recorded, found)
    if seen is None:
        return
    place = f"{row} {seen.first}" if seen.first == seen.last else f"{row}s {seen.first} to {seen.last}"
    place += f" at tick {instants[seen.first]}" if instants else ""
    named = [f"{number} {names[number]}" for number in seen.columns]
    later = f"; {len(seen.others)} other {column}s elsewhere" if seen.others else ""
    yield f"{place}: {column} {shortened(named)}{later}"


def _of_end(recorded: Left, found: Left, names: Sequence[str]) -> Iterator[str]:
    """Yield the line of what differs after the last tick; these columns are behind those of load and inputs."""
    first = sizes_of(recorded["trace"])[0]
    before, now = ([value for group in left["end"] for value in group.split()] for left in (recorded, found))
    pairs = enumerate(zip(before, now, strict=False), first)
    differing = [(column, one, other) for column, (one, other) in pairs if one != other]
    if differing:
        column, one, other = differing[0]
        more = f"; {len(differing) - 1} other columns too" if len(differing) > 1 else ""
        yield f"after tick {found['trace']['rows'] - 1}: column {column} {names[column]}: {one}, now {other}{more}"


def shortened(names: Sequence[str]) -> str:
    """Return the first of some names, and how many more there are."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def _of_list(kind: str, recorded: Sequence[str], found: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    """Yield the first that differs of what follows each other, or each that differs of what has names."""
    if len(recorded) != len(found):
        yield f"{kind}s: {len(recorded)} on record, now {len(found)}"
    pairs = enumerate(zip(recorded, found, strict=False))
    lines = (
        f"{kind} {number}{f' {names[number]}' if names else ''}: {one} on record, now {other}"
        for number, (one, other) in pairs
        if one != other
    )
    if names:
        yield from lines
    else:
        yield from [line for _, line in zip(range(1), lines, strict=False)]


def unmatched(recorded: Collection[str], wanted: Sequence[str], known: Collection[str]) -> Iterator[str]:
    """Yield a line for each configuration that is not on record, and for each on record that there is not.

    Args:
        recorded: What is on record, by configuration.
        wanted: Configurations that are checked.
        known: All that there are.
    """
    yield from (f"{name}: is not on record" for name in wanted if name not in recorded)
    yield from (f"{name}: is on record, and no such configuration exists" for name in recorded if name not in known)
