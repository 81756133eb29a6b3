"""The command `coldloop`."""

import argparse
import logging
import os
import platform
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import Final, NoReturn

from coldloop import __version__
from coldloop.errors import ColdloopError, UsageError, printable
from coldloop.process.declaration import VARIABLE
from rig.cli.process_option import OPTION, load_named_process
from rig.interruption import INTERRUPTION

COMMANDS: Final = {
    "run": "run the loop and record it",
    "up": "keep the rig up, in real time, on fixed ports",
    "down": "end a rig that is up",
    "status": "what a rig that is up is doing",
    "page": "the operator's page of a rig that is up, or of recorded runs",
    "set": "load, mode, setpoint, factor, pause, resume, acknowledge: commands to a rig that is up",
    "record": "record a session that is under way, to be replayed",
    "fault": "kill, pause, sensor: inject faults into a rig that is up",
    "rerun": "repeat a recorded run and compare the traces",
    "plot": "draw a recorded run again, as PNG, PDF or SVG",
    "report": "one HTML page of a recorded run, with interactive plots",
    "compare": "a table and a figure of several recorded runs",
    "export": "a recorded run as CSV, MATLAB or HDF5 files; or the solver as C99 or Structured Text for a PLC",
    "chaos": "a run with injected faults, and its evaluation",
    "proxy": "a proxy that delays, loses, damages, cuts or refuses Modbus/TCP traffic",
    "study": "do the runs of a study and draw its figure",
    "reproduce": "all studies of the paper, one report and a scorecard",
    "budget": "what the reference PLC can compute, and in which time",
    "events": "the journal of a running service",
    "registers": "the register maps",
    "certificates": "certificates for Modbus/TCP Security on a test site",
    "model": "the prediction model",
    "new": "a folder with a process file and a plant to begin with",
    "process": "a process file: checked, linearised, judged, made into a model file",
    "design": "which decision and constraint instants the problem needs, by what each set costs",
    "exergy": "where a refrigerator loses the exergy that it is given",
    "identify": "by how much the gains of the prediction model should be scaled to predict a recorded run",
    "config": "the effective configuration and where each value comes from",
    "completion": "a script that completes commands and options in a shell",
}
INTERRUPTED = 130
OF_THE_COLD_BOX: Final = ("study", "reproduce", "model", "exergy")
"""Commands that are about its equations, its loads or the paper's figures."""
OF_ANY_PROCESS: Final = ("periods",)
"""Studies that are not."""


class OneLineParser(argparse.ArgumentParser):
    """Reports a usage error as one line."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {printable(message)}; see {self.prog} --help\n")


def make_parser(chosen: str | None) -> argparse.ArgumentParser:
    """Return the parser of all commands, with the options of the chosen one; other commands are not imported."""
    parser = OneLineParser(prog="coldloop", description="A networked PLC rig for fast MPC on a helium refrigerator.")
    parser.add_argument("--version", action="version", version=_version())
    parser.add_argument(OPTION, metavar="FILE", help="another process than the cold box: a process file, or a"
                        " model file made from one")  # fmt: skip
    parser.set_defaults(execute=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=OneLineParser)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary)
        if name == chosen:
            module = import_module(f"rig.cli.commands.{name}")
            command.description = module.__doc__
            module.declare(command)
            command.set_defaults(execute=module.execute)
    version = commands.add_parser("version", help="the version")
    version.set_defaults(execute=_print_version)
    return parser


def _version() -> str:
    return f"coldloop {__version__} (Python {platform.python_version()})"


def _print_version(_: argparse.Namespace) -> int:
    sys.stdout.write(f"{_version()}\n")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 done, 1 failed, 2 wrong usage, 3 not finite, 130 interrupted."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    with INTERRUPTION:
        if "_ARGCOMPLETE" in os.environ:
            _complete()
        try:
            given = load_named_process(given)
            code = _execute(make_parser(given[0] if given else None), given)
            sys.stdout.flush()
        except UsageError as error:
            sys.stderr.write(f"coldloop: {error}\n")
            return error.exit_code
        except BrokenPipeError:
            _discard_output()
            return 0
        except OSError as error:  # commands report errors of their own files: what is left is standard output
            _discard_output()
            sys.stderr.write(f"coldloop: {error.filename or 'standard output'}: {error.strerror or error}\n")
            return 1
        return code


def _execute(parser: argparse.ArgumentParser, given: Sequence[str]) -> int:
    options, unknown = parser.parse_known_args(given)
    if unknown:
        parser.prog = " ".join([parser.prog, *given[: options.execute is not None]])
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    named = given[1] if len(given) > 1 else None
    if os.environ.get(VARIABLE) and given and given[0] in OF_THE_COLD_BOX and named not in OF_ANY_PROCESS:
        sys.stderr.write(f"coldloop: {given[0]}: of the cold box alone; leave out {OPTION} and unset {VARIABLE}\n")
        return UsageError.exit_code
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
        sys.stderr.write("coldloop: interrupted\n")
        return INTERRUPTED


def _complete() -> NoReturn:
    """Print the shell's completions of the line."""
    from argcomplete import autocomplete  # noqa: PLC0415 only a shell needs it

    words = os.environ.get("COMP_LINE", "").split()
    parser = make_parser(words[1] if len(words) > 1 and words[1] in COMMANDS else None)
    autocomplete(parser)
    sys.exit(0)


def _discard_output() -> None:
    """Let the interpreter's last flush of standard output succeed."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
