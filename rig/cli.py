"""The command `coldloop`."""

import argparse
import logging
import platform
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Final, NoReturn

from coldloop import __version__
from coldloop.errors import ColdloopError

COMMANDS: Final = {
    "run": "run the loop and record it",
    "chaos": "a run with faults on purpose, and what became of it",
    "study": "do the runs of a study and draw its figure",
    "reproduce": "all studies of the paper, one report and a scorecard",
    "budget": "what the reference PLC can compute, and in which time",
    "events": "the journal of a running service",
    "registers": "the register maps",
    "certificates": "certificates for Modbus/TCP Security on a test site",
    "model": "the prediction model",
    "config": "the effective configuration and where each value comes from",
}
INTERRUPTED = 130


class OneLineParser(argparse.ArgumentParser):
    """Reports a usage error as one line."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def make_parser(chosen: str | None) -> argparse.ArgumentParser:
    """Return the parser of all commands, with the options of the chosen one; what others need is not even imported."""
    parser = OneLineParser(prog="coldloop", description="A networked PLC rig for fast MPC on a helium refrigerator.")
    parser.set_defaults(execute=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=OneLineParser)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary)
        if name == chosen:
            module = import_module(f"rig.commands.{name}")
            command.description = module.__doc__
            module.declare(command)
    version = commands.add_parser("version", help="the version")
    version.set_defaults(execute=_print_version)
    return parser


def _print_version(_: argparse.Namespace) -> int:
    sys.stdout.write(f"coldloop {__version__} (Python {platform.python_version()})\n")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 done, 1 failed, 2 asked for wrongly."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    parser = make_parser(given[0] if given else None)
    options = parser.parse_args(given)
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
        sys.stderr.write("coldloop: interrupted; runs of a study that were done are kept, nothing else was written\n")
        return INTERRUPTED
    except BrokenPipeError:
        return 0


if __name__ == "__main__":
    sys.exit(main())
