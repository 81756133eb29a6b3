"""`coldloop run`: one run of the loop, recorded, evaluated and drawn."""

import argparse
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from coldloop.errors import UsageError
from coldloop.service.command_line import add_configuration_options
from rig.cli.commands.choices import FIGURE_FORMATS, LOADS, MODES, PRESETS, SOLVERS
from rig.cli.commands.options import (
    OWN_PORTS,
    PLACES,
    check_load,
    configuration,
    endpoint,
    refuse_ineffective,
    updating_period,
)
from rig.durations import duration

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rig.cosim.job import Job
    from rig.figures.worker import FigureProcess
    from rig.results.recording import Sink

SHORT_RUN_TICKS: Final = 2400
"""Ten minutes of plant time: in one process half a second at the most."""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--mode", choices=MODES, help="default: lockstep")
    parser.add_argument("--factor", type=float, help="in real time: seconds of plant time in a second (default: 1)")
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--in-process", action="store_true", help="one process and direct calls instead of Modbus/TCP")
    way.add_argument("--attach", nargs=3, type=endpoint, metavar="HOST:PORT",
                     help="use a rig that is up: plant, control PLC, optimiser PLC")  # fmt: skip
    parser.add_argument("--duration", type=duration, help="plant time, such as 2h or 90s (default: that of the load)")
    load = parser.add_argument(
        "--load",
        help=f"{', '.join(LOADS)}, another draw such as a@2, or a CSV file time_s,load_w (default: 2h)",
    )  # fmt: skip
    load.completer = lambda **_: LOADS  # type: ignore[attr-defined]  # argcomplete looks for it
    parser.add_argument("--solver", choices=SOLVERS, help="default: ode")
    parser.add_argument("--preset", choices=PRESETS, help="penalties and start of the solver (default: tuned)")
    parser.add_argument("--updating-period", type=updating_period, metavar="adaptive|SECONDS",
                        help="default: adaptive")  # fmt: skip
    parser.add_argument("--seed", type=int, help="seed of the sensors' noise (default: 1)")
    parser.add_argument("--out", type=Path, help="folder for the results (default: runs/<load>-<time>)")
    parser.add_argument("--force", action="store_true", help="replace the run in a folder that is not empty")
    parser.add_argument("--figures", nargs="+", choices=FIGURE_FORMATS, default=["png"], metavar="FORMAT",
                        help="png, pdf, svg (default: png)")  # fmt: skip
    parser.set_defaults(execute=execute)


def execute(options: argparse.Namespace) -> int:
    """Run, and write the results."""
    check_load(options.load)
    from rig.figures.worker import FigureProcess

    with FigureProcess(options.figures) as figure:
        if options.in_process:
            from coldloop.kernels.lean_numba import load_numba_alone

            figure.start()  # a short run would wait for matplotlib
            load_numba_alone()
        return _run(options, figure)


def _run(options: argparse.Namespace, figure: "FigureProcess") -> int:
    from rig.results.folders import claim_folder, claim_folder_of_now
    from rig.runs.manifest import plain_arguments
    from rig.runs.running import run_into

    job = _job(options)
    load = Path(job.effective.settings.plant.load).stem
    out = options.out or claim_folder_of_now(Path("runs"), load)
    claim_folder(out, force=options.force)
    with _progress(job) as sinks:
        summary = run_into(out, job, plain_arguments(options), figure, sinks)
    _tell(out, summary)
    return 0


@contextmanager
def _progress(job: "Job") -> "Iterator[list[Sink]]":
    """Show a bar while the run goes on; one that is over before it could be read has none."""
    from rig.cosim.job import Way

    if job.way is Way.IN_PROCESS and job.scenario.ticks <= SHORT_RUN_TICKS:
        yield []
        return
    from rig.progress import RunProgress

    with RunProgress(job.scenario.ticks) as progress:
        yield [progress]


def _job(options: argparse.Namespace) -> "Job":
    """Return the run that the options and the configuration ask for."""
    from coldloop.modbus.endpoints import Endpoint
    from rig.cosim.job import Job, Way
    from rig.runs.running import check_certificates, make_scenario

    effective = configuration(options)
    settings = effective.settings
    realtime = settings.session.mode == "realtime"
    if options.in_process and realtime:
        raise UsageError("--in-process runs in lock-step: drop it, or --mode realtime")
    factor_from = effective.sources.get("session.factor")
    if factor_from and not realtime and (settings.session.factor != 1.0 or factor_from.startswith("--")):
        raise UsageError(f"{factor_from}: a factor has no effect in lock-step; add --mode realtime")
    scenario = make_scenario(settings, options.duration)
    if options.attach:
        ends = [Endpoint(host=end.host, port=end.port, tls=settings.rig.tls) for end in options.attach]
        from rig.cosim.networked_run import as_attached

        return Job(as_attached(effective, ends), scenario, Way.ATTACHED, tuple(ends))
    refuse_ineffective(effective, {**dict.fromkeys(PLACES, OWN_PORTS), "session.autostart": "it begins a session"})
    if options.in_process:
        return Job(effective, scenario, Way.IN_PROCESS)
    check_certificates(settings)
    return Job(effective, scenario, Way.LOCALHOST)


def _tell(out: Path, summary: dict[str, Any]) -> None:
    updates = "no updates"
    if summary["updates"]:
        updates = f"{summary['updates']} updates, tau_u {summary['tau_u_mean']:.2f} s on average over time"
    sys.stdout.write(
        f"{summary['ticks']} ticks, {updates}, {summary['realtime_factor'] or 0:,.0f} x real time\n"
        f"outside the bands: L1 {summary['L1_outside_band_pct']:.2f} %, T5 {summary['T5_outside_band_pct']:.2f} %; "
        f"J_BF {summary['J_BF']:.4g}; deadline misses {summary['deadline_misses']}\n"
        f"trace {summary['trace_sha256']}\n"
        f"results in {out}\n"
    )
