"""Work on a process file in a child process: its plant may be native code, which only ends with its process."""

import multiprocessing
import signal
import tempfile
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from coldloop.errors import ColdloopError, UsageError
from coldloop_rig.interruption import SIGNALS


def text_of_child(path: Path, work: Callable[[], str], limit_s: int) -> str:
    """Return what a child process returns, which does this work on a process file.

    Raises:
        ColdloopError: As the work does; or the child has crashed, or has taken longer than the limit.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    with tempfile.TemporaryDirectory(prefix="coldloop-") as folder:  # whatever ends the child, nothing is left
        child = context.Process(target=_work, args=(work, limit_s, folder, sender))
        child.start()
        sender.close()
        try:
            found: str | ColdloopError = receiver.recv()
        except EOFError:
            found = ""
        child.join()
    code = child.exitcode or 0
    if code == -signal.SIGALRM:
        found = UsageError(
            f"{path}: its plant has not come to an end within {limit_s} s; mend it, or give it longer with `coldloop "
            "process FILE --limit SECONDS --out MODEL`, and then --process MODEL"
        )
    elif not found:
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        found = UsageError(f"{path}: its plant has ended the process that it ran in ({how}); mend it")
    if isinstance(found, ColdloopError):
        raise found
    return found


def _work(work: Callable[[], str], limit_s: int, folder: str, sender: Connection) -> None:
    tempfile.tempdir = folder
    for number in (*SIGNALS, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    signal.alarm(limit_s)  # it ends this process, whatever runs in it and whether its parent is still there
    try:
        sender.send(work())
    except ColdloopError as error:
        sender.send(error)
