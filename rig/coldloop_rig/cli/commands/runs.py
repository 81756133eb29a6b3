"""Commands about a run: done, recorded, repeated, drawn, compared."""

import argparse
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from coldloop.errors import NOT_FINITE, UsageError
from coldloop.process.updating_periods import duration
from coldloop.service import add_configuration_options
from coldloop_rig.cli.commands import options as common

if TYPE_CHECKING:
    from coldloop_rig.cosim.scenario import Job
    from coldloop_rig.figures.worker import FigureProcess


def _declare_run(parser: argparse.ArgumentParser) -> None:
    add_configuration_options(parser)
    parser.add_argument("--mode", choices=common.MODES, help="default: lockstep")
    parser.add_argument("--factor", type=float, help="real time only: seconds of plant time per second (default: 1)")
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--in-process", action="store_true", help="one process and direct calls instead of Modbus/TCP")
    way.add_argument("--attach", nargs=3, type=common.endpoint, metavar="HOST:PORT",
                     help="use a rig that is up: plant, control PLC, optimiser PLC")  # fmt: skip
    way.add_argument("--optimizer", type="export", metavar="export:FOLDER",
                     help="the exported optimiser in the place of ours (`coldloop docs plc-export`)")  # fmt: skip
    parser.add_argument("--duration", type=duration, help="plant time, such as 2h or 90s (default: that of the load)")
    common.add_loop_options(parser, "another draw such as a@2, or ")
    common.add_result_options(parser, "<load>")


def execute_run(options: argparse.Namespace) -> int:
    """One run of the loop, recorded, evaluated and drawn."""
    common.check_load(options.load)
    from coldloop_rig.figures.worker import FigureProcess

    with FigureProcess(options.figures) as figure:
        if options.in_process:
            from coldloop.kernels.cache import load_numba_alone

            figure.start()  # a short run would wait for matplotlib
            load_numba_alone()
        return _do(_run_job(options), options, figure)


def _run_job(options: argparse.Namespace) -> "Job":
    from coldloop.modbus.settings import Endpoint
    from coldloop_rig.cosim.scenario import Job
    from coldloop_rig.results.recording import Way
    from coldloop_rig.runs.running import check_certificates, make_scenario

    effective = common.configuration(options)
    settings = effective.settings
    realtime = settings.session.mode == "realtime"
    if options.in_process and realtime:
        raise UsageError("--in-process runs in lock-step: drop it, or --mode realtime")
    factor_from = effective.sources.get("session.factor")
    if factor_from and not realtime and (settings.session.factor != 1.0 or factor_from.startswith("--")):
        raise UsageError(f"{factor_from}: a factor has no effect in lock-step; add --mode realtime")
    ticks = options.duration.ticks(settings.process.tick_s) if options.duration else None
    scenario = make_scenario(settings, ticks)
    if options.attach:
        from coldloop_rig.cosim.networked_run import as_attached
        from coldloop_rig.cosim.wiring import QUIET_S

        ends = [
            Endpoint(host=end.host, port=end.port, tls=settings.rig.tls, timeout_s=QUIET_S) for end in options.attach
        ]
        return Job(as_attached(effective, ends), scenario, Way.ATTACHED, tuple(ends))
    common.refuse_ineffective(effective, common.OWN_PORTS)
    if options.in_process:
        return Job(effective, scenario, Way.IN_PROCESS)
    check_certificates(settings)
    return Job(effective, scenario, Way.LOCALHOST, optimizer=common.exported(options.optimizer, settings))


def _do(job: "Job", options: argparse.Namespace, figure: "FigureProcess") -> int:
    """Do a job into the folder of --out, and print a short result; return the exit code.

    Raises:
        ColdloopError: It is not complete; what was recorded is in the folder.
    """
    from coldloop_rig.results.folders import claim_folder, claim_folder_of_now
    from coldloop_rig.results.recording import Way
    from coldloop_rig.runs.running import plain_arguments, remarks, run_into

    told = [] if job.way in (Way.RECORDED, Way.ATTACHED) else remarks(job.effective)  # remarks are for a PLC of ours
    name = "session" if job.way is Way.RECORDED else Path(job.effective.settings.plant.load).stem
    out = options.out or claim_folder_of_now(Path("runs"), name)
    claim_folder(out, force=options.force)
    sys.stdout.write("".join(f"{line}\n" for line in told))
    sys.stdout.flush()
    settings, progress = job.effective.settings, None
    process = settings.process
    if job.way is not Way.IN_PROCESS or job.scenario.ticks > 2400:  # in one process these ticks take half a second
        from coldloop_rig.progress import RunProgress

        progress = RunProgress(job.scenario.ticks, process)
    with progress or nullcontext():
        summary = run_into(out, job, plain_arguments(options), figure, [progress] if progress else [])
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
    if not summary["failed_updates"]:
        return 0
    from coldloop.process.lti_model import load
    from coldloop_rig.process_file.judgement import unheld

    failed = summary["failed_updates"]
    sys.stderr.write("coldloop: " + "; ".join(filter(None, (
        f"{failed} of {failed + summary['updates']} updates have no answer: what the optimiser computed is not finite",
        unheld(process.banded, load(settings.model.file).A),
        "`coldloop docs fail-safe#no-answer`",
    ))) + "\n")  # fmt: skip
    return NOT_FINITE


def _declare_record(parser: argparse.ArgumentParser) -> None:
    common.add_rig_options(parser)
    parser.add_argument("--duration", type=duration, default=duration("1h"),
                        help="plant time, such as 2h or 90s (default: 1h; Ctrl-C ends it before)")  # fmt: skip
    common.add_result_options(parser, "session")


def execute_record(options: argparse.Namespace) -> int:
    """Records a session under way from now on, without changing it.

    It leaves the folder that a run leaves; `coldloop page FOLDER` replays it.
    """
    from coldloop_rig.cosim.networked_run import as_attached, session_under_way
    from coldloop_rig.cosim.scenario import Job
    from coldloop_rig.figures.worker import FigureProcess
    from coldloop_rig.results.recording import Way

    with FigureProcess(options.figures) as figure:
        effective = common.configuration(options)
        ends = tuple(common.rig_endpoints(options, effective.settings))
        effective = as_attached(effective, ends)
        ticks = options.duration.ticks(effective.settings.process.tick_s)
        job = Job(effective, session_under_way(effective, ends, ticks), Way.RECORDED, ends)
        return _do(job, options, figure)


def _declare_rerun(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("manifest", type="folder", metavar="MANIFEST", help="manifest.json of a run, or its folder")
    parser.add_argument("--trust", action="store_true", help="execute the plant of another process that the folder"
                        " holds; else --process names a file that gives the same model")  # fmt: skip
    parser.add_argument("--out", type="into", help="folder for the results of the repetition (default: none are kept)")
    parser.add_argument("--force", action="store_true", help="replace the run in a folder that is not empty")


def execute_rerun(options: argparse.Namespace) -> int:
    """Repeat a recorded run from its manifest, in one process, and compare the traces."""
    from coldloop.process.settings import ModelSettings
    from coldloop_rig.runs.running import repeat

    path: Path = options.manifest
    if path.is_file() and path.name != "manifest.json":
        raise UsageError(f"{path}: not the manifest.json of a run; name that, or its folder")
    folder = path.parent if path.name == "manifest.json" else path
    trusted = None if options.trust else ModelSettings().file
    same, text = repeat(folder, options.out, force=options.force, trusted=trusted)
    sys.stdout.write(text)
    return 0 if same else 1


def _declare_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type="folder", metavar="RUN", help="folder of a run")
    parser.add_argument("--figures", nargs="+", choices=common.FIGURE_FORMATS, default=["png", "pdf", "svg"],
                        metavar="FORMAT", help="png, pdf, svg (default: all)")  # fmt: skip


def execute_plot(options: argparse.Namespace) -> int:
    """The figure of a recorded run again, as PNG, PDF or SVG."""
    from coldloop_rig.figures.plot import plot_run
    from coldloop_rig.results.folders import writing

    with writing(options.run, "the figure was not written"):
        paths = plot_run(options.run, options.figures)
    sys.stdout.writelines(f"{path}\n" for path in paths)
    return 0


def _declare_report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type="folder", metavar="RUN", help="folder of a run")
    parser.add_argument("--out", type="write", metavar="FILE", help="page (default: report.html in the run's folder)")
    parser.add_argument("--force", action="store_true", help="replace a page that exists")


def execute_report(options: argparse.Namespace) -> int:
    """One HTML page of a recorded run, with interactive plots, alarms and settings."""
    from coldloop.text import require_regular_file, whole_text
    from coldloop_rig.figures.plot import run_page
    from coldloop_rig.results.folders import writing

    path: Path = options.out or options.run / "report.html"
    require_regular_file(path)
    if path.exists() and not options.force:
        raise UsageError(f"{path}: exists; name another page with --out, or overwrite with --force")
    page = run_page(options.run)
    with writing(path):
        whole_text(path, page)
    sys.stdout.write(f"{path}\n")
    return 0


def _declare_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="+", type="folder", metavar="RUN", help="folders of runs, two or more")
    parser.add_argument("--out", type="write", default=Path("compare.png"), metavar="FILE",
                        help="figure: .png, .pdf or .svg (default: compare.png)")  # fmt: skip
    parser.add_argument("--force", action="store_true", help="replace a figure that exists")


def execute_compare(options: argparse.Namespace) -> int:
    """A table and a figure of several recorded runs."""
    from coldloop_rig.figures.plot import compare

    if len(options.runs) < 2:
        raise UsageError("compare: name two runs or more")
    if options.out.suffix.removeprefix(".") not in common.FIGURE_FORMATS:
        raise UsageError(f"--out {options.out}: name a .png, .pdf or .svg file")
    if options.out.exists() and not options.force:
        raise UsageError(f"{options.out}: exists; name another figure with --out, or overwrite with --force")
    sys.stdout.write(compare(options.runs, options.out))
    return 0
