"""The command `coldloop`, and the process that its option --process names."""

import argparse
import errno
import logging
import os
import platform
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Final, NoReturn

from coldloop import __version__, service
from coldloop.errors import ColdloopError, UsageError, foreign, printable
from coldloop_rig.interruption import INTERRUPTION

OPTION: Final = "--process"
MODEL: Final = "model.file"
VARIABLES: Final = ("COLDLOOP__MODEL__FILE", "COLDLOOP_PROCESS")
_NAMED: Final = ContextVar[Path | None]("model file of the option", default=None)


@contextmanager
def named_process(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Let settings be for the process that arguments, environment or configuration name; give the other arguments.

    Raises:
        ColdloopError: There is no such file, or it cannot be made into a model file.
    """
    left, named, rest = list[str](), None, iter(arguments)
    for argument in rest:
        if argument == OPTION:
            named = next(rest, None)
            if named is None:
                raise UsageError(f"{OPTION}: name a process file or a model file")
        elif argument.startswith(f"{OPTION}="):
            named = argument.removeprefix(f"{OPTION}=")
        else:
            left.append(argument)
    model = _configured(left)
    if named is not None:
        from coldloop_rig.process_file.reading import model_file_of  # noqa: PLC0415 most commands are for the cold box

        model, told = model_file_of(Path(named), in_child=True)
        sys.stderr.writelines(f"coldloop: {named}: {line}\n" for line in told)
    if model is None:
        yield left
        return
    from coldloop.process.settings import SHIPPED_MODELS, model_named  # noqa: PLC0415

    token = _NAMED.set(model if named is not None else None)
    try:
        with model_named(SHIPPED_MODELS.get(str(model), model)):
            yield left
    finally:
        _NAMED.reset(token)


def _configured(arguments: Sequence[str]) -> Path | None:
    """Return the model file of the configuration; what is wrong with the arguments the command itself says."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    service.add_configuration_options(parser)
    try:
        options, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError:
        return None
    file = options.config if options.config and options.config.is_file() else None  # a pipe can be read once
    if not (file or options.assignments or any(map(os.environ.get, VARIABLES))):
        return None
    from coldloop.config import model_file_in  # noqa: PLC0415 it takes time

    named = model_file_in(os.environ, file, options.assignments)
    return Path(str(named)) if named else None


def is_another() -> bool:
    """Return whether the process of settings is another than the cold box."""
    if "coldloop.process.settings" not in sys.modules:
        return False
    from coldloop.process.cold_box import COLD_BOX  # noqa: PLC0415 it takes time
    from coldloop.process.settings import settings_process  # noqa: PLC0415

    return settings_process() != COLD_BOX


def process_setting(assignments: Iterable[str]) -> dict[str, tuple[object, str]]:
    """Return the setting that the option is, which a configuration file does not override.

    Raises:
        UsageError: It is among the assignments, too.
    """
    if (named := _NAMED.get()) is None:
        return {}
    if any(assignment.partition("=")[0].strip() == MODEL for assignment in assignments):
        raise UsageError(f"--set {MODEL}: {OPTION} names the process; drop one of them")
    return {MODEL: (str(named), OPTION)}


GROUPS: Final = {
    "a run": {
        "run": "run the loop, record it, and draw a figure",
        "rerun": "repeat a recorded run and compare the traces",
        "plot": "draw a recorded run again, as PNG, PDF or SVG",
        "report": "one HTML page of a recorded run, with interactive plots",
        "compare": "a table and a figure of several recorded runs",
    },
    "a rig that stays up": {
        "up": "start a rig in real time, on fixed ports",
        "down": "end a rig that is up",
        "status": "mode, load, outputs, updating period, alarms",
        "set": "load, mode, setpoint, factor, pause, resume, acknowledge",
        "fault": "kill or pause a service, fake a sensor, cut a link",
        "record": "record a session that is under way, to be replayed",
        "page": "the operator's page of a rig, or of recorded runs",
        "events": "the journal of a running service",
        "certificates": "certificates for Modbus/TCP Security on a test site",
        "registers": "the register maps",
    },
    "a plant and its controller": {
        "new": "a folder with a process file and a plant to begin with",
        "process": "a process file, checked, linearised, judged, made into a model file",
        "import": "a historian's export made into a record for a process file",
        "budget": "what a PLC can compute, and whether an adaptive period pays there",
        "model": "the prediction model",
        "identify": "how much the gains of the model should be scaled to predict a run",
    },
    "help and settings": {
        "docs": "the pages of the documentation, one of them or a section",
        "config": "the effective configuration and where each value comes from",
        "completion": "a script that completes commands and options in a shell",
    },
}
COMMANDS: Final = {name: said for group in GROUPS.values() for name, said in group.items()}
MODULE_OF: Final = {
    **dict.fromkeys(("run", "record", "rerun", "plot", "report", "compare"), "runs"),
    **dict.fromkeys(("new", "process", "import", "budget", "model", "identify"), "runs"),
    **dict.fromkeys(("up", "down", "status", "set", "fault", "page", "events", "certificates", "registers"), "rig"),
    **dict.fromkeys(("docs", "config", "completion"), "help"),
}
"""Modules of `coldloop_rig.cli.commands`: `_declare_NAME` declares a command's options, `execute_NAME` does it."""
BROKEN: Final = "commands that cannot be loaded"
"""Group in `coldloop --help` of commands whose package is damaged, or for another version."""
VERSION: Final = f"coldloop {__version__} (Python {platform.python_version()})"
EXTRAS: Final = {
    "CoolProp": "tables", "aiohttp": "hmi", "casadi": "qpoases", "distributed": "studies", "fmpy": "fmu",
    "h5py": "hdf5", "jinja2": "report", "markdown_it": "report", "pandas": "records", "plotly": "report",
}  # fmt: skip
"""The extra that brings a package which not every command needs."""
OF_THE_OUTPUT: Final = (errno.ENOSPC, errno.EIO, errno.EBADF, errno.EDQUOT, errno.EFBIG)
"""Errors of writing."""
OF_THE_COLD_BOX: Final = ("study", "reproduce", "model", "exergy")
"""Commands that are about its equations, its loads or the paper's figures."""


USES: Final = {"read": Path, "name": str, "folder": Path, "export": str, "write": Path, "into": Path}
"""Types of options that are paths: a file or a folder to read, a name or a file, sources to run, or what is written."""


class OneLineParser(argparse.ArgumentParser):
    """Reports a usage error as one line, and takes no abbreviations of options."""

    def __init__(self, *args: Any, **options: Any) -> None:  # noqa: ANN401 as argparse has them
        super().__init__(*args, **{"allow_abbrev": False, **options})
        for use, kind in USES.items():
            self.register("type", use, kind)

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {printable(message)}; see {self.prog} --help\n")


def make_parser(chosen: str | None) -> argparse.ArgumentParser:
    """Return the parser of all commands, with the options of the chosen one; other commands are not imported."""
    known = chosen in COMMANDS or chosen in _beside()
    parser = OneLineParser(
        prog="coldloop", epilog="" if known else _by_group(), formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Can this predictive controller run on that PLC, and how often should it update?\n"
        "A networked PLC rig for fast MPC.",
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=VERSION)
    parser.add_argument(OPTION, metavar="FILE", help="another process than the cold box: a process file, or a"
                        " model file made from one")  # fmt: skip
    parser.set_defaults(execute=None)
    commands = parser.add_subparsers(metavar="COMMAND", parser_class=OneLineParser, help="one of those below")
    for name in COMMANDS if chosen in COMMANDS else command_names():
        command = commands.add_parser(name)
        if name == chosen:
            with _of_its_package(name):
                if name in COMMANDS:
                    module = import_module(f"coldloop_rig.cli.commands.{MODULE_OF[name]}")
                    declare, execute = (getattr(module, f"{part}_{name}") for part in ("_declare", "execute"))
                else:
                    declare, execute = _beside()[name].load().COMMANDS[name]
                said = str(execute.__doc__)
                command.description = f"`coldloop {name}`: {said[0].lower()}{said[1:]}"
                declare(command)
                command.set_defaults(execute=execute)
    commands.add_parser("version").set_defaults(execute=_print_version)
    return parser


@cache
def _beside() -> dict[str, EntryPoint]:
    """Return the entry points of commands that are not the rig's own: modules with `GROUP`, `SAID` and `COMMANDS`."""
    return {point.name: point for point in entry_points(group="coldloop.commands") if point.name not in COMMANDS}


def _of_its_package(name: str) -> AbstractContextManager[None]:
    """Report what code of another package raises as a usage error of one line that names command and package."""
    if name in COMMANDS:
        return nullcontext()
    point = _beside()[name]
    package = f"package {point.dist.name}" if point.dist else "unknown package"
    return foreign(f"{name}: cannot be loaded from {point.value} ({package})", "update that package, or uninstall it",
                   kind=UsageError)  # fmt: skip


def command_names() -> list[str]:
    """Return the names of all commands, also of those that other packages bring."""
    return [*COMMANDS, *_beside()]


def command_groups() -> dict[str, dict[str, str]]:
    """Return the commands by what they are for, with a line about each; those of other packages, too.

    A command whose package cannot be loaded is in the group `BROKEN`, with the reason.
    """
    groups = {group: dict(commands) for group, commands in GROUPS.items()}
    for name, point in _beside().items():
        try:
            with _of_its_package(name):
                module = point.load()
                group, said, _ = str(module.GROUP[name]), str(module.SAID[name]), module.COMMANDS[name]
        except UsageError as error:
            group, said = BROKEN, str(error).removeprefix(f"{name}: cannot be loaded ")
        groups.setdefault(group, {})[name] = said
    return groups


def _by_group() -> str:
    groups = command_groups()
    width = max(len(name) for commands in groups.values() for name in commands) + 2
    texts = [
        f"{group}:\n" + "".join(f"  {n:{width}}{said}\n" for n, said in each.items()) for group, each in groups.items()
    ]
    return "\n".join([*texts, "coldloop COMMAND --help shows the options of one."])


def _print_version(_: argparse.Namespace) -> int:
    sys.stdout.write(f"{VERSION}\n")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 done, 1 failed, 2 wrong usage, 3 not finite, 130 interrupted."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    with INTERRUPTION:
        if "_ARGCOMPLETE" in os.environ:
            _complete()
        try:
            with named_process(given) as left:
                code = _execute(make_parser(left[0] if left else None), left)
            sys.stdout.flush()
        except ColdloopError as error:
            sys.stderr.write(f"coldloop: {error}\n")
            return error.exit_code
        except BrokenPipeError:
            _discard_output()
            return 0
        except OSError as error:  # commands report errors of their own files: what is left is mostly standard output
            place = error.filename or ("standard output" if error.errno in OF_THE_OUTPUT else given[0])
            _discard_output()
            sys.stderr.write(f"coldloop: {place}: {error.strerror or error}\n")
            return 1
        return code


def _execute(parser: argparse.ArgumentParser, given: Sequence[str]) -> int:
    options, unknown = parser.parse_known_args(given)
    if unknown:
        parser.prog = " ".join([parser.prog, *given[: options.execute is not None]])
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    named = given[1] if len(given) > 1 else None
    studies_of_any = ("periods", "compare")
    if given and given[0] in OF_THE_COLD_BOX and named not in studies_of_any and is_another():
        sys.stderr.write(f"coldloop: {given[0]}: of the cold box alone; leave out {OPTION} and unset {VARIABLES[0]}\n")
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
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        sys.stderr.write(f"coldloop: {given[0]} needs {package}: pip install 'coldloop[{EXTRAS[package]}]'\n")
        return UsageError.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("coldloop: interrupted\n")
        return 130


def _complete() -> NoReturn:
    from argcomplete import autocomplete  # noqa: PLC0415 only a shell needs it

    words = os.environ.get("COMP_LINE", "").split()
    parser = make_parser(words[1] if len(words) > 1 and words[1] in command_names() else None)
    autocomplete(parser)
    sys.exit(0)


def _discard_output() -> None:
    """Let the interpreter's last flush of standard output succeed."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
