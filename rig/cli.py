"""The command `coldloop`."""

import argparse
import logging
import platform
import sys
from collections.abc import Sequence
from typing import NoReturn

from coldloop import __version__
from coldloop.errors import ColdloopError
from rig.commands import budget, config, model, registers, run

COMMANDS = (run, registers, model, config, budget)
INTERRUPTED = 130


class OneLineParser(argparse.ArgumentParser):
    """Reports a usage error as one line."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = OneLineParser(prog="coldloop", description="A networked PLC rig for fast MPC on a helium refrigerator.")
    parser.set_defaults(execute=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=OneLineParser)
    for command in COMMANDS:
        command.add_parser(commands)
    version = commands.add_parser("version", help="the version")
    version.set_defaults(execute=_print_version)
    return parser


def _print_version(_: argparse.Namespace) -> int:
    sys.stdout.write(f"coldloop {__version__} (Python {platform.python_version()})\n")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 done, 1 failed, 2 asked for wrongly."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if options.execute is None:
        parser.print_help()
        return 0
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        return int(options.execute(options))
    except ColdloopError as error:
        sys.stderr.write(f"coldloop: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("coldloop: interrupted; no results were written\n")
        return INTERRUPTED
    except BrokenPipeError:
        return 0


if __name__ == "__main__":
    sys.exit(main())
