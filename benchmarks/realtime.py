"""Deadline misses and lateness of scans in real time."""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path


def main() -> None:
    """Run each case, and print."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--case", nargs=2, action="append", metavar=("FACTOR", "DURATION"),
                        help="may be repeated (default: 1 for 2min, 20 for 1h)")  # fmt: skip
    for factor, duration in parser.parse_args().case or [("1", "2min"), ("20", "1h")]:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "coldloop_rig", "run", "--mode", "realtime", "--factor", factor,
                       "--duration", duration, "--load", "a", "--out", folder]  # fmt: skip
            subprocess.run(command, check=True, capture_output=True)
            summary = json.loads((Path(folder) / "summary.json").read_text())
        print(f"factor {factor}, {duration}: {summary['deadline_misses']} misses, {summary['overruns']} overruns "
              f"in {summary['ticks']} scans; lateness max {summary['lateness_max_ms']:.2f} ms, "
              f"p99 {summary['lateness_p99_ms']:.2f} ms")  # fmt: skip


if __name__ == "__main__":
    main()
