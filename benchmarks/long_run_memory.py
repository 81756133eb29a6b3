"""Memory of recorder and programs during a long run in one process: it should not grow with the length of the run.

The load is that of the named hours, drawn again for each round of six. Results are recorded as those of `coldloop run`.
"""

import argparse
import csv
import gc
import re
from pathlib import Path
from typing import Final

import numpy as np

from coldloop.config import load_configuration
from coldloop.process.cold_box import TICK_S
from coldloop.process.lti_model import load as load_model
from coldloop_plant.load import HOUR_TICKS, HOURS, concatenated, telegraph
from coldloop_rig.cosim.scenario import Job
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.results.recording import SampleBlock, Sink, Way
from coldloop_rig.results.run_folder import claim_folder
from coldloop_rig.runs.running import make_scenario, run_into
from coldloop_rig.settings import Settings

NAMES: Final = "abcdef"
DRAW_SEEDS: Final = 1000
SETTLED_H: Final = 10
"""From here on memory is expected to be flat: the first row groups of the trace have been written."""


class MemoryLog(Sink):
    """Writes the resident memory of this process, and the number of its objects, once an hour of plant time."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self.rows: list[tuple[float, float, int]] = []
        self._next = 0

    def block(self, block: SampleBlock) -> None:
        """Look, once an hour."""
        if block.first >= self._next:
            self._next += HOUR_TICKS
            self.rows.append((block.first * TICK_S / 3600, resident_mb(), len(gc.get_objects())))
            with self._file.open("w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerows([("hour", "resident_mb", "objects"), *self.rows])


def resident_mb() -> float:
    """Return the resident memory of this process (Linux)."""
    found = re.search(r"VmRSS:\s*(\d+) kB", Path("/proc/self/status").read_text(encoding="utf-8"))
    return int(found[1]) / 1024 if found else float("nan")


def write_load(file: Path, hours: int, mean_w: float) -> None:
    """Write a load of so many hours."""
    drawn = [
        telegraph(family._replace(seed=family.seed + DRAW_SEEDS * (hour // len(NAMES))), mean_w)
        for hour in range(hours)
        for family in [HOURS[NAMES[hour % len(NAMES)]]]
    ]
    load = concatenated(drawn)
    rows = [(tick * TICK_S, watts) for tick, watts in zip(load.times, load.watts, strict=True)]
    with file.open("w", newline="", encoding="utf-8") as out:
        csv.writer(out).writerows([("time_s", "load_w"), *rows])


def main() -> None:
    """Run, and print memory over time."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--hours", type=int, default=1000)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results; memory.csv grows in it")
    options = parser.parse_args()
    claim_folder(options.out, force=False)
    load_file = options.out / "load.csv"
    write_load(load_file, options.hours, load_model(Settings().model.file).w0)
    effective = load_configuration(Settings, environment={}, options={"plant.load": (str(load_file), "--load")})
    job = Job(effective, make_scenario(effective.settings, options.hours * HOUR_TICKS), Way.IN_PROCESS)
    memory = MemoryLog(options.out / "memory.csv")
    with FigureProcess(["png"]) as figure:
        summary = run_into(options.out, job, {}, figure, [memory])
    hours, resident, objects = np.array(memory.rows).T
    print(f"{summary['ticks']} ticks, {summary['realtime_factor']:,.0f} x real time, trace {summary['trace_sha256']}")
    for share in np.linspace(0, len(hours) - 1, min(len(hours), 11)).astype(int):
        print(f"{hours[share]:6.0f} h  {resident[share]:8.1f} MB  {objects[share]:9.0f} objects")
    settled = hours >= SETTLED_H
    if settled.sum() > 1:
        slope, _ = np.polyfit(hours[settled], resident[settled], 1)
        print(f"from {SETTLED_H} h on: {resident[settled].min():.1f} to {resident[settled].max():.1f} MB, "
              f"{1000 * slope:+.2f} MB in 1000 h")  # fmt: skip


if __name__ == "__main__":
    main()
