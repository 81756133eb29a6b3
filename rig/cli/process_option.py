"""The option --process: the process of a command, and of the services that it starts."""

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Final

from coldloop.config import model_file_in
from coldloop.errors import UsageError

OPTION: Final = "--process"
MODEL: Final = "model.file"
_NAMED: Final = ContextVar[Path | None]("model file of the option", default=None)


@contextmanager
def named_process(arguments: Sequence[str]) -> Iterator[list[str]]:
    """Let settings be for the process that the arguments name, or the environment; give the arguments without it.

    Raises:
        ColdloopError: There is no such file, or it cannot be made into a model file.
    """
    left, named = _split(arguments)
    model = Path(str(in_environment)) if (in_environment := model_file_in(os.environ)) else None
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
