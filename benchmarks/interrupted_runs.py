"""Ctrl-C or SIGTERM at random instants of a run, of a plan with faults and of a study: how they end, and what is left.

Each process gets the signal at a seeded instant: half of them count from its start, the others, where there is a run,
from the moment at which the run is under way. It should end with 128 and the signal's number and
without a traceback, and what it has recorded should be readable with pandas, DuckDB and, exported, `scipy.io.loadmat`.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final, NamedTuple

import duckdb
import pandas as pd
from scipy.io import loadmat

PATIENCE_S: Final = 120.0
LOOK_S: Final = 0.05
COMMANDS: Final = {
    "in-process": ("run", "--in-process", "--load", "6h", "--figures", "png"),
    "networked": ("run", "--load", "6h", "--figures", "png"),
    "chaos": ("chaos", "undisturbed", "--duration", "6h"),
    "study": ("study", "trade-off", "--seeds", "1", "--duration", "10min", "--workers", "1"),
}


class End(NamedTuple):
    """How a process ended."""

    code: int
    complaints: str
    left: str
    """What was recorded, in a few words."""
    sound: bool


def coldloop(*words: str) -> list[str]:
    """Return a command line."""
    return [sys.executable, "-m", "coldloop_rig", *words]


def interrupt(command: tuple[str, ...], number: signal.Signals, after_s: float, out: Path, *, under_way: bool) -> End:
    """Start a command, send it a signal after a while from its start, or from its run's, and look at what is left."""
    process = subprocess.Popen(
        coldloop(*command, "--out", str(out)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while under_way and process.poll() is None and not (out / "manifest.json").exists():
        time.sleep(LOOK_S)
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
    _, complaints = process.communicate(timeout=PATIENCE_S)
    left, readable = outcomes(out) if command[0] == "study" else records(out)
    expected = {128 + number, -number}  # the latter: before the interpreter was up
    sound = process.returncode in expected and "Traceback" not in complaints and readable
    return End(process.returncode, "; ".join(complaints.strip().splitlines()[-2:]), left, sound)


def records(out: Path) -> tuple[str, bool]:
    """Read the trace of a run in all ways; return its length in words, and whether all agree."""
    if not (out / "manifest.json").exists():
        return "nothing recorded", not (out / "trace.parquet").exists()
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    trace = out / "trace.parquet"
    rows = len(pd.read_parquet(trace))
    found = duckdb.sql(f"select count(*), max(time_s) from '{trace}'").fetchall()  # noqa: S608 our own file
    export = subprocess.run(coldloop("export", str(out), "--mat"), capture_output=True, text=True, check=False)
    ticks = loadmat(out / "run.mat", simplify_cells=True)["trace"]["tick"] if not export.returncode else ()
    in_matlab = 1 if isinstance(ticks, int) else len(ticks)
    agree = rows == summary["ticks"] == found[0][0] == in_matlab
    return f"{rows} ticks, complete: {summary['complete']}", agree and not summary["complete"]


def outcomes(out: Path) -> tuple[str, bool]:
    """Read all runs of a study that were done."""
    files = [file for file in out.rglob("*.json") if not file.name.startswith(".")] if out.exists() else []
    try:
        for file in files:
            json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        return f"{file} is damaged", False
    return f"{len(files)} files of runs and results", True


def main() -> int:
    """Interrupt each command at all instants, and print; return 1 when one did not end as it should."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--count", type=int, default=20, help="instants of each command")
    parser.add_argument("--only", choices=COMMANDS, nargs="+", default=list(COMMANDS))
    parser.add_argument("--signal", choices=("SIGINT", "SIGTERM"), default="SIGINT")
    parser.add_argument("--latest", type=float, default=12.0, help="s after the start")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # shells let background jobs ignore it, and so would their children
    draw = random.Random(options.seed)  # noqa: S311 not for secrets
    unsound = 0
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.only:
            for instant in range(options.count):
                after_s = draw.uniform(0.0, options.latest)
                under_way = name != "study" and bool(instant % 2)
                out = Path(scratch, f"{name}{instant}")
                end = interrupt(COMMANDS[name], signal.Signals[options.signal], after_s, out, under_way=under_way)
                unsound += not end.sound
                mark = "ok " if end.sound else "BAD"
                since = "of run  " if under_way else "of start"
                print(
                    f"{mark} {name:10} {after_s:6.2f} s {since} rc {end.code:4}  {end.left:32} {end.complaints}",
                    flush=True,
                )
    print(f"{unsound} did not end as they should")
    return 1 if unsound else 0


if __name__ == "__main__":
    sys.exit(main())
