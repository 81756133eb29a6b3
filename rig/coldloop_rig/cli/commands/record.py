"""`coldloop record`: records a session under way from now on, without changing it.

It leaves the folder that a run leaves; `coldloop page FOLDER` replays it.
"""

import argparse
from typing import TYPE_CHECKING

from coldloop_rig.cli.commands.options import add_result_options, add_rig_options, configuration, rig_endpoints
from coldloop_rig.durations import duration

if TYPE_CHECKING:
    from coldloop_rig.cosim.scenario import Job


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_rig_options(parser)
    parser.add_argument("--duration", type=duration, default=duration("1h"),
                        help="plant time, such as 2h or 90s (default: 1h; Ctrl-C ends it before)")  # fmt: skip
    add_result_options(parser, "session")


def execute(options: argparse.Namespace) -> int:
    """Record, and write the results."""
    from coldloop_rig.cli.recorded_job import record
    from coldloop_rig.figures.worker import FigureProcess

    with FigureProcess(options.figures) as figure:
        return record(_job(options), options, figure)


def _job(options: argparse.Namespace) -> "Job":
    """Return the recording that the options ask for."""
    from coldloop_rig.cosim.networked_run import as_attached, session_under_way
    from coldloop_rig.cosim.scenario import Job
    from coldloop_rig.results.way import Way

    effective = configuration(options)
    ends = tuple(rig_endpoints(options, effective.settings))
    effective = as_attached(effective, ends)
    ticks = options.duration.ticks(effective.settings.process.tick_s)
    return Job(effective, session_under_way(effective, ends).scenario(ticks), Way.RECORDED, ends)
