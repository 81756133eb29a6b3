"""The command `coldloop`; interrupts end it in good order also while its modules are imported."""

import gc
import io
import os
import sys
from pathlib import Path

from coldloop_rig.interruption import INTERRUPTION


def main() -> int:
    """Run the command line; return its exit code."""
    _open_closed_streams()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: more threads wait for each other
    gc.set_threshold(100_000)  # with 700, the default, a run of two hours looks for cycles for 0.2 s and finds none
    with INTERRUPTION:
        from coldloop_rig.cli import main as run  # noqa: PLC0415 this takes time
    code = run()
    gc.freeze()  # the interpreter would look for cycles in all modules before it ends, which takes 0.15 s
    return code


def _open_closed_streams() -> None:
    """Open what the caller has closed (`>&-`): the next file would take its number. What is written there is lost."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115 as long as the process
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal may not have each character of a unit


if __name__ == "__main__":
    sys.exit(main())
