"""The option --process: the process of a command, and of the services that it starts."""

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Final

from coldloop.errors import UsageError
from coldloop.service.command_line import add_configuration_options

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
    left, named = _split(arguments)
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
    add_configuration_options(parser)
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


def _split(arguments: Sequence[str]) -> tuple[list[str], str | None]:
    left, named, rest = [], None, iter(arguments)
    for argument in rest:
        if argument == OPTION:
            named = next(rest, None)
            if named is None:
                raise UsageError(f"{OPTION}: name a process file or a model file")
        elif argument.startswith(f"{OPTION}="):
            named = argument.removeprefix(f"{OPTION}=")
        else:
            left.append(argument)
    return left, named
