"""`coldloop down`: ends a rig that `coldloop up` has started here."""

import argparse
import sys

from rig.commands.options import port_base

PATIENCE_S = 15.0


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--port-base", type=port_base, metavar="PORT",
                        help="first port of the rig (default: 5020)")  # fmt: skip
    parser.set_defaults(execute=execute)


def execute(options: argparse.Namespace) -> int:
    """End it, and wait until it has ended."""
    from rig.started_rigs import ports_from, take_down

    pid = take_down(ports_from(options.port_base)[0], PATIENCE_S)
    sys.stdout.write(f"the rig is down (process {pid})\n")
    return 0
