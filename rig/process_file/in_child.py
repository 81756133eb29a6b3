"""Work on a process file in a child process: its plant may be native code, which only ends with its process."""

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from coldloop.errors import ColdloopError, UsageError
from rig.interruption import SIGNALS

LIMIT_S: Final = 300.0
"""How long the plant of a process file may take, unless the user says otherwise."""


def text_of_child(path: Path, work: Callable[[], str], limit_s: float) -> str:
    """Return what a child process returns, which does this work on a process file.

    Raises:
        ColdloopError: As the work does; or the child has crashed, or has taken longer than the limit.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_work, args=(work, limit_s, sender))
    child.start()
    sender.close()
    try:
        found: str | ColdloopError | None = receiver.recv() if receiver.poll(limit_s) else None
    except EOFError:
        child.join()
        code = child.exitcode or 0
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        found = UsageError(f"{path}: its plant has ended the process that it ran in ({how}); mend it")
    finally:
        child.kill()
        child.join()
    if isinstance(found, str):
        return found
    raise found or UsageError(
        f"{path}: its plant has not come to an end within {limit_s:g} s; mend it, or give it longer with "
        "`coldloop process FILE --limit SECONDS --out MODEL`, and then --process MODEL"
    )


def _work(work: Callable[[], str], limit_s: float, sender: Connection) -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    signal.alarm(int(limit_s) + 1)  # where the parent has gone
    try:
        found: str | ColdloopError = work()
    except ColdloopError as error:
        found = error
    sender.send(found)
