"""`coldloop budget`: what the reference PLC can do in an updating period, and whether its memory holds the problem."""

import argparse
import math
import sys
from typing import Final

from coldloop.errors import UsageError
from coldloop.service.command_line import add_configuration_options
from rig.cli.commands.options import configuration, fixed_updating_period

USUAL_SCENARIOS: Final = 100


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument(
        "--power", type=_power, metavar="P", help="one power relative to the PLC (default: as configured)"
    )
    parser.add_argument("--updating-period", dest="period", type=fixed_updating_period, metavar="SECONDS",
                        help="one updating period (default: 1, 2.5 and 5 s)")  # fmt: skip
    parser.add_argument("--certify", type=_scenarios, nargs="?", const=USUAL_SCENARIOS, metavar="N",
                        help="how many iterations are enough, by N sampled scenarios, with its confidence "
                        f"(default: {USUAL_SCENARIOS})")  # fmt: skip
    parser.add_argument("--tolerance", type=_percent, default=5.0, metavar="PERCENT",
                        help="with --certify: enough is within this of the optimum (default: 5)")  # fmt: skip
    parser.add_argument("--confidence", type=_percent, default=99.9, metavar="PERCENT",
                        help="with --certify: of the bounds (default: 99.9)")  # fmt: skip


def _scenarios(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of at least 1")
    return int(text)


def _percent(text: str) -> float:
    value = _number(text)
    if not 0 < value < 100:
        raise argparse.ArgumentTypeError(f"'{text}' is not a percentage above 0 and below 100")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _power(text: str) -> float:
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def execute(options: argparse.Namespace) -> int:
    """Print the tables."""
    if options.certify is not None:
        from rig.plc_sizing.certification_table import certification_table

        if options.power is not None or options.period is not None:
            raise UsageError("--certify: uses the configured PLC; leave out --power and "
                             "--updating-period")  # fmt: skip
        settings = configuration(options).settings
        sys.stdout.write(certification_table(settings, options.certify, options.tolerance, options.confidence))
        return 0
    from rig.plc_sizing.budget_tables import budget_tables

    sys.stdout.write(budget_tables(configuration(options).settings, options.power, options.period))
    return 0
