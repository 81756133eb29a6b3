"""Wall time of the solver comparison with one worker and with two."""

import argparse
import tempfile
import time
from pathlib import Path

from coldloop.process.cold_box import TICK_S
from coldloop.process.updating_periods import duration
from coldloop_studies.execution import Workers, conduct
from coldloop_studies.reproduction import STUDIES
from coldloop_studies.study import StudyOptions


def seconds(workers: int, options: StudyOptions) -> float:
    """Return the time of a whole study, workers started and stopped."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        conduct(STUDIES["solver-comparison"], options, Workers(workers), Path(folder))
        return time.perf_counter() - began


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--duration", type=duration, help="plant time of each run (default: eight hours)")
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    options = StudyOptions(arguments.seeds, arguments.duration and arguments.duration.ticks(TICK_S))
    one, two = (seconds(workers, options) for workers in (1, 2))
    print(f"36 runs a draw: one worker {one:.0f} s, two workers {two:.0f} s, ratio {one / two:.2f}")


if __name__ == "__main__":
    main()
