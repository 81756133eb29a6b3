"""`coldloop design`: which decision and constraint instants the problem needs, by what each set costs in the loop."""

import argparse
import sys
from pathlib import Path

from coldloop.service.command_line import add_configuration_options
from rig.cli.commands.options import check_load, configuration


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--load", dest="loads", nargs="+", metavar="LOAD", default=["a"],
                        help="loads to compare them under: names or CSV files (default: a)")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the proposed set as a configuration (TOML)")


def execute(options: argparse.Namespace) -> int:
    """Compare, print; write the proposal when there is --out."""
    from coldloop.errors import UsageError
    from coldloop.whole_file import require_regular_file, whole_text
    from rig.progress import make_console
    from rig.studies import instants

    for name in options.loads:
        check_load(name)
    if options.out is not None:
        require_regular_file(options.out)
    settings = configuration(options).settings
    with make_console().status("") as status:
        found = instants.judged(
            settings, options.loads, lambda done, of: status.update(f"{done} of {of} sets of instants")
        )
    sys.stdout.write(instants.table(found, options.loads))
    if options.out is not None:
        try:
            whole_text(options.out, instants.configuration(found))
        except OSError as error:
            raise UsageError(f"{options.out}: {error.strerror}; name a file that can be written with --out") from None
        sys.stdout.write(f"written to {options.out}\n")
    return 0
