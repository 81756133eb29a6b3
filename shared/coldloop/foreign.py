"""The guard of every call into code that is not ours: an FMU, a plant's class, a solver, a rule, an estimator."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from coldloop.errors import ColdloopError, ModelFileError, RunInterruptedError

RENAMED: Final = frozenset({"plant", "control_plc", "optimizer_plc", "hmi", "rig"})
"""Packages that begin with `coldloop_` since version 0.4."""
MOST_SAID: Final = 2000
"""Characters of what that code says in a message."""


@contextmanager
def foreign(
    what: str, instead: str = "", *, kind: type[ColdloopError] = ModelFileError, said: Sequence[str] = ()
) -> Iterator[None]:
    """Call `what`, code that is not ours: what it raises, `SystemExit` too, becomes an error of a kind, in one line.

    `instead` ends the line: what happens instead, or what to do. `said` is what the code has reported, told in the
    place of its exception. An error of this kind passes as it is.
    """
    try:
        yield
    except (kind, KeyboardInterrupt, RunInterruptedError):  # the last two are signals
        raise
    except BaseException as error:
        reason = " ".join(said) or f"{type(error).__name__}: {_text(error)}".removesuffix(": ")
        raise kind(f"{what}: {' '.join(reason.split())[:MOST_SAID]}" + (f"; {instead}" if instead else "")) from error


def _text(error: BaseException) -> str:
    try:
        said = str(error)
    except Exception:  # noqa: BLE001 code of others, too
        return ""
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    return f"{said}: its name is coldloop_{package} since version 0.4" if package in RENAMED else said
