"""The guard of every call into code that is not ours: an FMU, a plant's class, a solver, a rule, an estimator."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from coldloop.errors import ColdloopError, ModelFileError


@contextmanager
def foreign(
    what: str, instead: str = "", *, kind: type[ColdloopError] = ModelFileError, said: Sequence[str] = ()
) -> Iterator[None]:
    """Call code that is not ours: what it raises becomes one line.

    Args:
        what: Names the code, and what it was called for.
        instead: What happens instead, or what to do; the end of the line.
        kind: The error that is raised; an error of this kind passes as it is.
        said: What the code has reported itself, which is told in the place of its exception.

    Raises:
        ColdloopError: The code has raised, or has tried to end the process (`SystemExit`).
    """
    try:
        yield
    except kind:
        raise
    except (Exception, SystemExit) as error:
        reason = " ".join(said) or f"{type(error).__name__}: {error}".removesuffix(": ")
        raise kind(f"{what}: {' '.join(reason.split())}" + (f"; {instead}" if instead else "")) from error
