"""Real-time factor of a run: in one process, and as three processes over Modbus/TCP."""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path


def realtime_factor(*options: str) -> tuple[float, str]:
    """Run; return the speed and the hash of the trace."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "coldloop_rig", "run", "--out", folder, *options]
        subprocess.run(command, check=True, capture_output=True)
        summary = json.loads((Path(folder) / "summary.json").read_text())
    return float(summary["realtime_factor"]), str(summary["trace_sha256"])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--load", default="2h")
    parser.add_argument("--duration", default="2h")
    parser.add_argument("--repeat", type=int, default=3, help="runs of each kind; the median is printed")
    options = parser.parse_args()
    for period in ("adaptive", "2.5"):
        common = ("--load", options.load, "--duration", options.duration, "--updating-period", period)
        one = sorted(realtime_factor("--in-process", *common) for _ in range(options.repeat))
        three = sorted(realtime_factor(*common) for _ in range(options.repeat))
        same = len({trace for _, trace in (*one, *three)}) == 1
        print(f"tau_u {period}: one process {one[len(one) // 2][0]:.0f} x real time, networked "
              f"{three[len(three) // 2][0]:.0f} x; one trace: {same}")  # fmt: skip


if __name__ == "__main__":
    main()
