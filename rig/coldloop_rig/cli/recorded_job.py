"""A job as commands run it: claims its folder, shows a progress bar, prints a short result."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from coldloop.errors import NOT_FINITE
from coldloop.process.declaration import Process
from coldloop.process.lti_model import load as load_model
from coldloop_rig.cosim.scenario import Job
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.results.folders import claim_folder, claim_folder_of_now
from coldloop_rig.results.recording import Sink
from coldloop_rig.results.way import Way
from coldloop_rig.runs.manifest import plain_arguments
from coldloop_rig.runs.remarks import remarks
from coldloop_rig.runs.running import run_into

SHORT_RUN_TICKS: Final = 2400
"""Ten minutes of plant time: in one process half a second at the most."""


def record(job: Job, options: argparse.Namespace, figure: FigureProcess) -> int:
    """Do a job with the options --out and --force; return the exit code, `NOT_FINITE` where updates had no answer.

    Raises:
        ColdloopError: It is not complete; what was recorded is in the folder.
    """
    told = [] if job.way in (Way.RECORDED, Way.ATTACHED) else remarks(job.effective)  # of a PLC that is ours
    name = "session" if job.way is Way.RECORDED else Path(job.effective.settings.plant.load).stem
    out = options.out or claim_folder_of_now(Path("runs"), name)
    claim_folder(out, force=options.force)
    sys.stdout.write("".join(f"{line}\n" for line in told))
    sys.stdout.flush()
    with _progress(job) as sinks:
        summary = run_into(out, job, plain_arguments(options), figure, sinks)
    _tell(out, summary, job.effective.settings.process)
    if not summary["failed_updates"]:
        return 0
    sys.stderr.write(f"coldloop: {_failure(summary, job)}\n")
    return NOT_FINITE


@contextmanager
def _progress(job: Job) -> Iterator[list[Sink]]:
    """Show a progress bar during the run, unless the run is too short."""
    if job.way is Way.IN_PROCESS and job.scenario.ticks <= SHORT_RUN_TICKS:
        yield []
        return
    from coldloop_rig.progress import RunProgress  # noqa: PLC0415 a short run starts without it

    with RunProgress(job.scenario.ticks, job.effective.settings.process) as progress:
        yield [progress]


def _failure(summary: dict[str, Any], job: Job) -> str:
    from coldloop_rig.process_file.judgement import unheld  # noqa: PLC0415 a run that succeeds does without

    failed, model = summary["failed_updates"], load_model(job.effective.settings.model.file)
    return "; ".join(filter(None, (
        f"{failed} of {failed + summary['updates']} updates have no answer: what the optimiser computed is not finite",
        unheld(job.effective.settings.process.banded, model.A),
        "`coldloop docs fail-safe#no-answer`",
    )))  # fmt: skip


def _tell(out: Path, summary: dict[str, Any], process: Process) -> None:
    updates = "no updates"
    if summary["updates"]:
        updates = f"{summary['updates']} updates, tau_u {summary['tau_u_mean']:.2f} s on average over time"
    outside = ", ".join(f"{one.name} {summary[f'{one.name}_outside_dead_band_pct']:.2f} %" for one in process.banded)
    sys.stdout.write(
        f"{summary['ticks']} ticks, {updates}, {summary['realtime_factor'] or 0:,.0f} x real time\n"
        f"outside the bands: {outside}; "
        f"J_BF {summary['J_BF']:.4g}; deadline misses {summary['deadline_misses']}\n"
        f"trace {summary['trace_sha256']}\n"
        f"results in {out}\n"
    )
