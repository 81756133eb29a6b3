"""Checks the traces on record, or writes them anew.

usage: scripts/traces [--record REASON] [CONFIGURATION]...
"""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

from tests.harness.traces import record as files
from tests.harness.traces.configurations import CONFIGURATIONS
from tests.harness.traces.judge import differences, unmatched
from tests.harness.traces.record import Found, Record, RecordError
from tests.harness.traces.workers import found_now


def main(words: Sequence[str]) -> int:
    """Check or record; return 1 where something differs."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False,
        prog="scripts/traces",
        description="Checks traces of runs in one process against tests/traces.json.",
    )
    parser.add_argument("configurations", nargs="*", metavar="CONFIGURATION", help="which ones; by default all")
    parser.add_argument("--record", metavar="REASON", help="write them anew, with the reason why they have moved")
    options = parser.parse_args(words)
    unknown = [name for name in options.configurations if name not in CONFIGURATIONS]
    if unknown:
        parser.error(f"no configurations: {', '.join(unknown)}; there are: {'; '.join(CONFIGURATIONS)}")
    names = options.configurations or list(CONFIGURATIONS)
    try:
        return check(names) if options.record is None else make(names, options.record)
    except RecordError as error:
        sys.stderr.write(f"{error}\n")
        return 2


def make(names: Sequence[str], reason: str) -> int:
    """Write traces anew."""
    old = files.read() if files.FILE.exists() else None
    record = files.renewed(old, found_now(names), CONFIGURATIONS, reason, datetime.now(UTC).date())
    files.write(record)
    moved = record["reasons"][0]["configurations"]
    sys.stdout.write(f"{files.FILE.name}: {len(record['configurations'])} configurations, {len(moved)} new or moved\n")
    return 0


def check(names: Sequence[str]) -> int:
    """Compare traces with those on record; print what differs."""
    began = time.monotonic()
    record = files.read()
    wanted = [name for name in names if name in record["configurations"]]
    found: Found = found_now(wanted) if wanted else record
    skipped = dict(skips(record, found, wanted))
    lines = [*unmatched(record["configurations"], names, CONFIGURATIONS), *judged(record, found, wanted)]
    sys.stdout.writelines(f"{line}\n" for line in [*skipped.values(), *lines])
    moved = {name for name in wanted for line in lines if line.startswith(f"{name}: ")}
    sys.stdout.write(
        f"{len(wanted)} configurations in {time.monotonic() - began:.0f} s: {len(moved)} have moved,"
        f" {len(skipped)} skipped, {len(wanted) - len(moved) - len(skipped)} are the same\n"
    )
    if lines:
        made_with = ", ".join(f"{key} {value}" for key, value in record["made_with"].items())
        sys.stdout.write(f"recorded with {made_with}\n")
    return 1 if lines else 0


def comparable(record: Record, found: Found, name: str) -> bool:
    """Return whether the traces of a configuration are of one kind of processor, where that matters."""
    pair = (record["configurations"][name], found["configurations"][name])
    return len({left.get("processor") for left in pair}) == 1


def skips(record: Record, found: Found, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each configuration that depends on the kind of processor, and this is another, with a line that says so."""
    for name in names:
        if not comparable(record, found, name):
            there, here = (one["configurations"][name].get("processor", "any") for one in (record, found))
            yield name, f"{name}: skipped: its last bits are those of LAPACK on {there}, and this is {here}"


def judged(record: Record, found: Found, names: Sequence[str]) -> Iterator[str]:
    """Yield a line for each difference."""
    for name in names:
        if comparable(record, found, name):
            left, now = record["configurations"][name], found["configurations"][name]
            yield from (f"{name}: {line}" for line in differences(left, now, found["names"][now["process"]]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
