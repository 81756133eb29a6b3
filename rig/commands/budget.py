"""`coldloop budget`: what the reference PLC can do in an updating period, and whether its memory holds the problem."""

import argparse
import math
import sys

from coldloop.command_line import add_configuration_options
from rig.commands.options import configuration, fixed_updating_period


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--power", type=_power, metavar="P", help="one power relative to the PLC (default: several)")
    parser.add_argument("--updating-period", dest="period", type=fixed_updating_period, metavar="SECONDS",
                        help="one updating period (default: 1 to 5 s)")  # fmt: skip
    parser.set_defaults(execute=execute)


def _power(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def execute(options: argparse.Namespace) -> int:
    """Print the tables."""
    from rig.budget_tables import budget_tables

    sys.stdout.write(budget_tables(configuration(options).settings, options.power, options.period))
    return 0
