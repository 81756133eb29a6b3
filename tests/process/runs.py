"""Programs loaded with a process, each to its end."""

import json
import subprocess
from pathlib import Path
from typing import Any

from tests.harness.processes import PROGRAM_S, Ended, Processes


def started(processes: Processes, *arguments: object) -> Ended:
    """Run `coldloop` to its end."""
    return processes.coldloop(*arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE).ended(PROGRAM_S)


def run(processes: Processes, file: Path, out: Path, *options: str) -> dict[str, Any]:
    """Return the summary of a run of a process file."""
    code, _, complaints = started(processes, "--process", file, "run", "--out", out, *options)
    assert code == 0, complaints
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return summary
