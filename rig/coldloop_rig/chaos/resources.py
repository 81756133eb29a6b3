"""What the processes of a run use: resident memory, and lines of their logs."""

import contextlib
import re
from pathlib import Path

from coldloop_rig.cosim.local_services import LocalServices
from coldloop_rig.cosim.wiring import SERVICES


def resident_mb(services: LocalServices) -> dict[str, float]:
    """Return the resident memory of the services that run, where the system reports it (Linux)."""
    sizes = {}
    for service, process in services.processes.items():
        with contextlib.suppress(OSError):
            found = re.search(r"VmRSS:\s*(\d+) kB", Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8"))
            if found:
                sizes[service] = int(found[1]) / 1024
    return sizes


def log_lines(services: LocalServices) -> dict[str, int]:
    """Return the number of lines in each log."""
    counts = {}
    for service in SERVICES:
        with services.log(service).open("rb") as log:
            counts[service] = sum(1 for _ in log)
    return counts
