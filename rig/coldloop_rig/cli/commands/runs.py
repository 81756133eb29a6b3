"""Commands about runs (done, recorded, repeated, drawn, compared), and about plant, model and controller."""

import argparse
import math
import sys
from contextlib import nullcontext
from functools import partial
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Final

from coldloop.errors import NOT_FINITE, UsageError
from coldloop.process.updating_periods import duration
from coldloop.service import add_configuration_options
from coldloop.text import require_regular_file, whole_text
from coldloop_rig.cli.commands import options as common
from coldloop_rig.text_tables import aligned, fitted, width

if TYPE_CHECKING:
    from coldloop.process.lti_model import LtiModel
    from coldloop_optimizer_plc.qp.problem import PredictiveProblem
    from coldloop_rig.cosim.scenario import Job
    from coldloop_rig.figures.worker import FigureProcess
    from coldloop_rig.settings import Settings


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
    from coldloop_rig.results.recording import Way
    from coldloop_rig.results.run_folder import claim_folder, claim_folder_of_now
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
    from coldloop_rig.results.run_folder import writing

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
    from coldloop_rig.results.run_folder import writing

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


FILES: Final = ("process.toml", "my_plant.py")
INSTALLED: Final = Path(__file__).parents[2] / "examples"
"""Folder of the examples in a wheel; a clone has them beside the packages."""
EXAMPLES: Final = (
    "cool_down", "efficient_refrigerator", "optimiser_by_registers", "optimiser_with_do_mpc", "outside_package",
    "quadruple_tank", "smaller_turbine", "wood_berry",
)  # fmt: skip


def _declare_new(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type="into", metavar="FOLDER", help="a new folder, or one without such files")
    parser.add_argument("--example", choices=EXAMPLES, metavar="NAME",
                        help=f"the files of an example instead: {', '.join(EXAMPLES)}")  # fmt: skip


def execute_new(options: argparse.Namespace) -> int:
    """A folder with a process file and a plant to begin with, commented, or with an example."""
    folder: Path = options.folder
    if options.example is None:
        place = files("coldloop_rig.process_file") / "template"
        texts = {name: (place / f"{name}.txt").read_text(encoding="utf-8") for name in FILES}
    else:
        examples = INSTALLED if INSTALLED.is_dir() else Path(__file__).parents[4] / "examples"
        name = options.example
        found = sorted(file for file in examples.rglob("*.*") if name in (file.parent.name, file.name[: len(name)]))
        texts = {file.name: file.read_text(encoding="utf-8") for file in found if file.suffix != ".pyc"}
        if not texts:
            raise UsageError(
                f"--example {name}: this installation has no examples; they are in the wheel and in a clone"
            )
    present = next((name for name in texts if (folder / name).exists()), None)
    if present is not None:
        raise UsageError(f"{folder / present}: is there already; name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            whole_text(folder / name, text)
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; name a folder that can be written to") from None
    begin = "" if options.example else f"; now coldloop process {folder / FILES[0]}"
    sys.stdout.write(f"{folder}: {', '.join(texts)}{begin}\n")
    return 0


def _declare_process(parser: argparse.ArgumentParser) -> None:
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("file", type="read", nargs="?", metavar="FILE", help="process file (TOML)")
    what.add_argument("--keys", action="store_true", help="list the keys of process files, as Markdown")
    parser.add_argument("--out", type="write", metavar="MODEL",
                        help="write the model file; then --process MODEL, or the key model.file")  # fmt: skip
    parser.add_argument("--limit", type=common.positive_count, default=300, metavar="SECONDS",
                        help="how long its plant may take, in a process of its own (default: 300)")  # fmt: skip


def execute_process(options: argparse.Namespace) -> int:
    """A process file checked, linearised and judged, and made into the model file of all programs."""
    from coldloop.process.declaration import Process
    from coldloop_rig.cli.listings import key_listing
    from coldloop_rig.process_file.judgement import described
    from coldloop_rig.process_file.making import made_from
    from coldloop_rig.process_file.reading import text_of_child

    out: Path | None = options.out
    if options.keys:
        if out is not None:
            raise UsageError("--out: writes the model of a process file; name that file, and leave out --keys")
        sys.stdout.write(key_listing(Process))
        return 0
    if out is not None:
        require_regular_file(out)
        if out.resolve() == options.file.resolve():
            raise UsageError(f"{out}: is the process file; name another one with --out")

    def work() -> str:
        made = made_from(options.file)
        return described(made) if out is None else f"{described(made)}{_saved(made.model, out)}"

    sys.stdout.write(fitted(text_of_child(options.file, work, options.limit), width()))
    return 0


def _saved(model: "LtiModel", out: Path) -> str:
    """Write a model file; return the line that says so."""
    try:
        model.save(out)
    except OSError as error:
        raise UsageError(f"{out}: {error.strerror}; name a file that can be written with --out") from None
    return f"written to {out}\n"


def _declare_import(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("export", type="read", metavar="RECORD", help="text file of a historian or a spreadsheet")
    add("--inputs", nargs="+", required=True, metavar="NAME",
        help="inputs, load, other disturbances, which hold between readings; others are outputs")  # fmt: skip
    add("--map", action="append", default=[], metavar="TAG=NAME",
        help="name of a tag in the record; other tags are then left out; TAG=time_s: column of time")  # fmt: skip
    add("--zone", metavar="ZONE", help="of times without one, as in Europe/Berlin")
    add("--good", nargs="+", default=[], metavar="TEXT",
        help="what a quality says of good readings, beside good, ok and such words, and 192 to 255")  # fmt: skip
    add("--every", type=float, metavar="SECONDS", help="between rows (default: as usual between an output's readings)")
    add("--gap", type=float, metavar="SECONDS", help="without a reading that cuts the record (default: 5 rows)")
    add("--out", type="write", required=True, metavar="FILE", help="the record to write")


def execute_import(options: argparse.Namespace) -> int:
    """A historian's export made into a record for `plant.step_test`; says what it assumed and dropped.

    It reads a line for each time or for each reading; commas, semicolons or tabs; dates, or seconds from any start.
    Inputs hold between readings, outputs are averaged, and gaps cut the record into pieces.
    """
    from zoneinfo import available_timezones

    from coldloop_rig.process_file.historian import Request, record_of
    from coldloop_rig.results.run_folder import writing

    out: Path = options.out
    require_regular_file(out)
    if out.resolve() == options.export.resolve():
        raise UsageError(f"{out}: is the export; name another file with --out")
    names = dict(each.rpartition("=")[::2] for each in options.map)
    if "" in {*names, *names.values()} or len({*names.values()}) < len(options.map):
        raise UsageError("--map: write --map TAG=NAME, with another name for each tag")
    if not all(given is None or 0.0 < given < float("inf") for given in (options.every, options.gap)):
        raise UsageError("--every and --gap: a number of seconds above 0")
    if options.zone is not None and options.zone not in available_timezones():
        raise UsageError(f"--zone {options.zone}: no such zone; write one as in Europe/Berlin, or UTC")
    inputs, good = tuple(options.inputs), tuple(options.good)
    request = Request(options.export, names, inputs, options.zone, good, options.every, options.gap)
    text, said = record_of(request)
    with writing(out):
        whole_text(out, text)
    sys.stdout.write("".join(f"{line}\n" for line in (*said, f"written    to {out}")))
    return 0


def _declare_model(parser: argparse.ArgumentParser) -> None:
    add_configuration_options(parser)
    parser.add_argument("--plant", type="read", metavar="FILE", help="plant file (TOML): parameters of another plant")
    parser.add_argument("--out", type="write", metavar="FILE", help="write the model file, for model.file")


def execute_model(options: argparse.Namespace) -> int:
    """The plant at its operating point, and its linear model as both PLCs run it."""
    from coldloop.process.lti_model import load
    from coldloop_plant.equilibrium import NoEquilibriumError
    from coldloop_plant.kinds import kind_named
    from coldloop_plant.settings import PlantKind
    from coldloop_rig.cli.listings import describe_model, held_line

    if options.out is not None:
        require_regular_file(options.out)
    settings = common.configuration(options).settings
    design = settings.optimizer_plc.program.design
    in_use = settings.model.file
    whole = settings.plant.kind is PlantKind.REFRIGERATOR
    plant = kind_named(PlantKind.REFRIGERATOR).read_plant_file(options.plant, settings.limits, whole=whole)
    if options.out is not None and options.plant is not None and options.out.resolve() == options.plant.resolve():
        raise UsageError(f"{options.out}: is the plant file; name another one with --out")
    try:
        model, text, box = describe_model(in_use, plant, design, settings.plant.station)
    except NoEquilibriumError as error:
        raise UsageError(f"{options.plant or 'the reference plant'}: {error}") from None
    sys.stdout.write(text)
    if options.out is not None:
        sys.stdout.write(_saved(model, options.out))
    sys.stdout.flush()
    if options.plant is not None:  # a long search
        sys.stdout.write(held_line(box, plant.operating_point.level_pct, design, settings.limits))
    load(in_use)
    return 0


def _declare_identify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type="folder", metavar="RUN", help="folder of a run, of half an hour or more")
    parser.add_argument("--model", type="read", metavar="FILE", help="model file (default: that of the run)")
    parser.add_argument("--out", type="write", metavar="FILE",
                        help="write the model with these factors, to be looked at, if it predicts better")  # fmt: skip


def execute_identify(options: argparse.Namespace) -> int:
    """The factors on the prediction model's gains with which it predicts what a run has measured.

    They are fitted on the first half of the record and judged on the second. The model of a run is never changed.
    """
    from coldloop.process.lti_model import load
    from coldloop_rig.results.run_folder import RunFolder, writing
    from coldloop_rig.runs.identification import describe, identify, note_of, read_record, scaled
    from coldloop_rig.runs.running import MODEL_COPY

    out: Path | None = options.out
    if out is not None:
        require_regular_file(out)
        if out.exists():
            raise UsageError(f"{out}: exists; name another file with --out")
    run = RunFolder(options.run)
    model = load(options.model or run.held(MODEL_COPY))
    found = identify(model, read_record(run, model))
    sys.stdout.write(describe(model, found))
    if out is None:
        return 0
    if not found.fitted:
        raise UsageError(f"{out}: not written: no factor can be told from this record; name a run that moves more")
    if not found.improved:
        raise UsageError(f"{out}: not written: with these factors the half held back is predicted no better")
    with writing(out):
        scaled(model, found.factors, note_of(run, model, found)).save(out)
    sys.stdout.write(
        f"written to {out}, to be looked at: nothing uses it before a configuration names it, for all three services:\n"
        f"    coldloop run --set model.file={out}\n"
    )
    return 0


USUAL_SCENARIOS: Final = 100


def _declare_budget(parser: argparse.ArgumentParser) -> None:
    add_configuration_options(parser)
    power = partial(common.positive_number, sys.float_info.max, "a positive number")
    percent = partial(common.positive_number, math.nextafter(100.0, 0.0), "a percentage above 0 and below 100")
    speed = parser.add_mutually_exclusive_group()
    speed.add_argument("--power", type=power, metavar="P",
                       help="one power relative to the paper's PLC (default: as configured)")  # fmt: skip
    speed.add_argument("--plc", type="name", metavar="PLC",
                       help="a PLC instead: a profile (TOML) or one that is shipped, and a sentence that says whether "
                       "the controller runs there; --list names them")  # fmt: skip
    add = parser.add_argument
    add("--export", type="folder", metavar="FOLDER",
        help="what an export for a PLC costs: operations of its calls and bytes; with --plc also times there, and what"
        " does not fit")  # fmt: skip
    add("--took", type=power, metavar="US",
        help="with --export: a PLC took so many microseconds for the iterations of the solver's self-test; prints its"
        " profile")  # fmt: skip
    add("--list", action="store_true", help="list the shipped PLCs")
    add("--keys", action="store_true", help="list the keys of a PLC's profile, as Markdown")
    add("--load", type="name", dest="loads", nargs="+", metavar="LOAD", default=[],
        help="with --plc: whether an adaptive updating period pays there under these loads, against --updating-period "
        "or the best fixed one")  # fmt: skip
    add("--updating-period", dest="period", type=common.fixed_updating_period, metavar="SECONDS",
        help="one updating period (default: a fifth, a half and all of a sampling period)")  # fmt: skip
    add("--certify", type=common.positive_count, nargs="?", const=USUAL_SCENARIOS, metavar="N",
        help="how many iterations are enough, by N sampled scenarios, with its confidence "
        f"(default: {USUAL_SCENARIOS})")  # fmt: skip
    add("--tolerance", type=percent, default=5.0, metavar="PERCENT",
        help="with --certify: enough is within this of the optimum (default: 5)")  # fmt: skip
    add("--confidence", type=percent, default=99.9, metavar="PERCENT",
        help="with --certify: of the bounds (default: 99.9)")  # fmt: skip


def execute_budget(options: argparse.Namespace) -> int:
    """What a PLC can do in an updating period, and whether its memory holds the problem."""
    if options.loads and options.plc is None:
        raise UsageError("--load: says whether an adaptive period pays on a PLC; name one with --plc")
    if options.took and not options.export:
        raise UsageError("--took: is of an export's self-test; name its folder with --export")
    from coldloop_rig.cli.listings import key_listing
    from coldloop_rig.plc_sizing.plc import PlcProfile, find_profile, shipped_profiles

    if options.list:
        text = aligned([(name, find_profile(name).name) for name in shipped_profiles()])
    elif options.keys:
        text = key_listing(PlcProfile)
    elif options.export:
        from coldloop_rig.plc_sizing.plc import cost_text, profile_of, read_cost

        cost = read_cost(options.export)
        plc = find_profile(options.plc) if options.plc and not options.took else None
        text = profile_of(cost, options.took) if options.took else cost_text(cost, plc)
    elif options.certify:
        from coldloop_rig.plc_sizing.intervals import certification_table

        if any(value is not None for value in (options.power, options.plc, options.period)):
            raise UsageError("--certify: uses the configured PLC; leave out --power, --plc and --updating-period")
        settings = common.configuration(options).settings
        text = certification_table(settings, options.certify, options.tolerance, options.confidence)
    else:
        text = _budget_tables(options)
    sys.stdout.write(fitted(text, width()))
    return 0


def _budget_tables(options: argparse.Namespace) -> str:
    from coldloop_rig.plc_sizing.budget import budget_tables, plc_tables, with_power
    from coldloop_rig.plc_sizing.intervals import adaptive_gain
    from coldloop_rig.plc_sizing.plc import find_profile
    from coldloop_rig.progress import make_console
    from coldloop_rig.runs.running import certificate

    if len(set(options.loads)) < len(options.loads):
        raise UsageError("--load: a load is named twice; two of the same are no evidence")
    for name in options.loads:
        common.check_load(name)
    profile = None if options.plc is None else find_profile(options.plc)
    settings = common.configuration(options).settings

    def costs(there: "Settings") -> str:
        if not options.loads:
            return ""
        with make_console().status("") as status:
            return adaptive_gain(
                there, options.loads, options.period, lambda done, of: status.update(f"{done} of {of} runs")
            )

    def executed(problem: "PredictiveProblem") -> str:
        counters = entry_points(group="coldloop.counters", name="ode")
        if not counters:
            return ""
        counter = counters["ode"].load()(problem, settings.optimizer_plc.program)
        return (
            f"ode as exported, an iteration a call, executed: {counter.unconstrained():,} operations with no row "
            f"active, {counter.worst():,} in the worst case (every row active, a bound cuts the step)\n"
        )

    if profile is not None:
        return plc_tables(
            settings, options.period, profile, lambda there: f"{certificate(there)}\n{costs(there)}".strip()
        )
    if options.power is not None:
        settings = with_power(settings, options.power)
    held, tables = certificate(settings), budget_tables(settings, options.period, executed)
    return f"{held}\n\n{tables}" if held else tables
