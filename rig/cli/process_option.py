"""The option --process: the process of a command, and of the services that it starts."""

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Final

from coldloop.config import model_file_in
from coldloop.errors import UsageError
from coldloop.service.command_line import add_configuration_options

OPTION: Final = "--process"
MODEL: Final = "model.file"
_NAMED: Final = ContextVar[Path | None]("model file of the option", default=None)


@contextmanager
def named_process(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Let settings be for the process that arguments, environment or configuration name; give the other arguments.

    Raises:
        ColdloopError: There is no such file, or it cannot be made into a model file.
    """
    left, named = _split(arguments)
    file, assignments = _configured(left)
    configured = model_file_in(os.environ, file, assignments)
    model = Path(str(configured)) if configured else None
    if named is not None:
        from rig.process_file.model_of import model_file_of  # noqa: PLC0415 most commands are for the cold box

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


def _configured(arguments: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Return the configuration file and the assignments among the arguments; the command itself refuses wrong ones."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    add_configuration_options(parser)
    try:
        options, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError:
        return None, []
    return options.config, options.assignments


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
