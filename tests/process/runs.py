"""Programs loaded with a process, each to its end."""

import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tests.harness.processes import PROGRAM_S, Ended, Processes


def started(processes: Processes, *arguments: object, more: Mapping[str, str] | None = None) -> Ended:
    """Run `coldloop` to its end, with more variables."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return processes.coldloop(*arguments, more=more, **pipes).ended(PROGRAM_S)


def run(
    processes: Processes, file: Path, out: Path, *options: str, more: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the summary of a run of a process file."""
    code, _, complaints = started(processes, "--process", file, "run", "--out", out, *options, more=more)
    assert code == 0, complaints
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return summary
