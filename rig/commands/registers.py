"""`coldloop registers`: the register maps, as a table, Markdown, CSV or JSON."""

import argparse
import sys

from rig.commands.choices import REGISTER_FORMATS, SERVICES


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--format", choices=REGISTER_FORMATS, default="table")
    parser.add_argument("--service", choices=SERVICES, help="default: all")
    parser.set_defaults(execute=execute)


def execute(options: argparse.Namespace) -> int:
    """Print the list."""
    from rig.register_listing import FORMATS, MAPS

    maps = [MAPS[options.service]] if options.service else list(MAPS.values())
    sys.stdout.write(FORMATS[options.format](maps))
    return 0
