"""`coldloop import`: a historian's export made into a record for `plant.step_test`; says what it assumed and dropped.

It reads a line for each time or for each reading; commas, semicolons or tabs; dates, or seconds from any start. Inputs
hold between readings, outputs are averaged, and gaps cut the record into pieces.
"""

import argparse
import sys
from pathlib import Path


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("export", type="read", metavar="RECORD", help="text file of a historian or a spreadsheet")
    add("--inputs", nargs="+", required=True, metavar="NAME",
        help="inputs, load, other disturbances, which hold between readings; others are outputs")  # fmt: skip
    add("--map", action="append", default=[], metavar="TAG=NAME",
        help="name of a tag in the record; other tags are then left out; TAG=time_s: column of time")  # fmt: skip
    add("--zone", metavar="ZONE", help="of times without one, as in Europe/Berlin")
    add("--good", nargs="+", default=[], metavar="TEXT",
        help="what a quality says of good readings, beside good, ok and such words, and 192 to 255")  # fmt: skip
    add("--every", type=float, metavar="SECONDS", help="between rows (default: as usual between an output's readings)")
    add("--gap", type=float, metavar="SECONDS", help="without a reading that cuts the record (default: 5 rows)")
    add("--out", type="write", required=True, metavar="FILE", help="the record to write")


def execute(options: argparse.Namespace) -> int:
    """Write the record; print what was done."""
    from zoneinfo import available_timezones

    from coldloop.errors import UsageError
    from coldloop.whole_file import require_regular_file, whole_text
    from coldloop_rig.process_file.historian import Request, record_of
    from coldloop_rig.results.folders import writing

    out: Path = options.out
    require_regular_file(out)
    if out.resolve() == options.export.resolve():
        raise UsageError(f"{out}: is the export; name another file with --out")
    names = dict(each.rpartition("=")[::2] for each in options.map)
    if "" in {*names, *names.values()} or len({*names.values()}) < len(options.map):
        raise UsageError("--map: write --map TAG=NAME, with another name for each tag")
    if not all(given is None or 0.0 < given < float("inf") for given in (options.every, options.gap)):
        raise UsageError("--every and --gap: a number of seconds above 0")
    if options.zone is not None and options.zone not in available_timezones():
        raise UsageError(f"--zone {options.zone}: no such zone; write one as in Europe/Berlin, or UTC")
    inputs, good = tuple(options.inputs), tuple(options.good)
    request = Request(options.export, names, inputs, options.zone, good, options.every, options.gap)
    text, said = record_of(request)
    with writing(out):
        whole_text(out, text)
    sys.stdout.write("".join(f"{line}\n" for line in (*said, f"written    to {out}")))
    return 0
