"""Whether a process is still the one that it was: numbers of processes are given again."""

import subprocess
import sys
from pathlib import Path

STATE, STARTED = 0, 19
"""Places in /proc/PID/stat, counted behind the name of the program."""


def identity_of(pid: int) -> str | None:
    """Return what no other process has that ever had or will have this number; None if none runs that has it."""
    return _from_proc(pid) if sys.platform == "linux" else _from_ps(pid)


def _from_proc(pid: int) -> str | None:
    """Return the boot and the time since it at which the process was started."""
    try:
        status = Path(f"/proc/{pid}/stat").read_bytes()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return None
    fields = status.rpartition(b")")[2].split()  # the name before may have anything in it
    if fields[STATE] in (b"Z", b"X"):  # has ended, and its parent has not noticed
        return None
    return f"{boot} {int(fields[STARTED])}"


def _from_ps(pid: int) -> str | None:
    """Return the time at which the process was started, to the second."""
    shown = subprocess.run(  # noqa: S603
        ["ps", "-o", "lstart=", "-p", str(pid)],  # noqa: S607 where it is differs
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return shown.stdout.strip() or None
