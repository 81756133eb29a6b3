"""Everything that Coldloop raises on purpose.

    ColdloopError
    ├── UsageError                  exit code 2: the request cannot be carried out
    │   ├── ConfigurationError      a key, a value or a configuration file
    │   └── LoadFileError           a load profile
    ├── ResultsError                the files of a run cannot be written
    ├── RunInterruptedError         a signal stopped a run; exit code 128 and the signal's number
    ├── StudyError                  a run of a study failed
    ├── ModelFileError              a prediction model that is missing, damaged or of another plant
    └── LinkError                   the bus: a port, a peer, an answer
        ├── PortInUseError
        ├── PeerUnreachableError
        │   └── UntrustedPeerError  its certificate is invalid
        ├── DamagedAnswerError      the seal of an answer is broken, or missing
        │   └── ImplausibleAnswerError  it has a value that its register cannot have
        ├── UnfitValueError         a value of our own that its register cannot hold
        └── RequestRefusedError     the peer answered with a Modbus exception

A message is one line that says what, where, and what to do. `foreign` guards every call into code that is not ours:
an FMU, a plant's class, a solver, a rule, an estimator.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

NOT_FINITE: Final = 3
"""Exit code of a run, or a study, that is complete, and in which updates had no answer."""
BUSY: Final = 6
"""Modbus exception code of a server at which another client holds the lease of the role."""


def printable(text: str) -> str:
    """Return a text as one printable line: without line ends and control characters."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


class ColdloopError(Exception):
    """Root of the tree; `exit_code` is what a program ends with when it cannot continue."""

    exit_code = 1

    def __str__(self) -> str:
        """Return the message, which is one line."""
        return printable(super().__str__())


class UsageError(ColdloopError):
    """The request cannot be carried out."""

    exit_code = 2


class ConfigurationError(UsageError):
    """A configuration key or value is wrong, or its file cannot be read."""


class LoadFileError(UsageError):
    """A load profile cannot be read."""


class ResultsError(ColdloopError):
    """The files of a run cannot be written."""


class RunInterruptedError(ColdloopError):
    """A signal stopped a run."""

    def __init__(self, signal_name: str, signal_number: int) -> None:
        super().__init__(f"interrupted by {signal_name}")
        self.exit_code = 128 + signal_number


class StudyError(ColdloopError):
    """A run of a study failed."""


class ModelFileError(ColdloopError):
    """A prediction model is missing, damaged, or does not belong to the plant."""


class LinkError(ColdloopError):
    """The bus failed."""


class PortInUseError(LinkError):
    """A server cannot listen at its address."""


class PeerUnreachableError(LinkError):
    """A peer does not answer, or does not speak as its register map says."""


class UntrustedPeerError(PeerUnreachableError):
    """A peer cannot prove its identity; trying again does not help."""


class DamagedAnswerError(LinkError):
    """A record that should be sealed arrived without its seal, or with a broken one."""


class ImplausibleAnswerError(DamagedAnswerError):
    """A record arrived with a value that its register cannot have; its seal says nothing about that."""


class UnfitValueError(LinkError):
    """A value to be written does not fit its register: at its limit, or too large."""


class RequestRefusedError(LinkError):
    """A peer answered a request with a Modbus exception."""

    def __init__(self, message: str, exception_code: int) -> None:
        super().__init__(message)
        self.exception_code = exception_code


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
