"""`coldloop down`: ends a rig that `coldloop up` has started here."""

import argparse
import sys

from coldloop_rig.cli.commands.options import add_rig_options, first_port_here

PATIENCE_S = 15.0


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_rig_options(parser)


def execute(options: argparse.Namespace) -> int:
    """End it, and wait until it has ended."""
    from coldloop_rig.live.started_rigs import take_down

    pid = take_down(first_port_here(options), PATIENCE_S)
    sys.stdout.write(f"the rig is down (process {pid})\n")
    return 0
