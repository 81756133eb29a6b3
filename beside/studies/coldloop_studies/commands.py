"""Commands about studies."""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from coldloop import errors, service
from coldloop.process.updating_periods import duration
from coldloop_rig.cli.commands.options import Command, check_load, configuration, positive_count

if TYPE_CHECKING:
    from coldloop_studies.execution import Workers
    from coldloop_studies.study import Study, StudyOptions


STUDIES: Final = (
    "cholesky", "unlimited", "limited", "solver-comparison", "trajectories", "updating-period", "plc-2h", "adaptive-2h",
    "trade-off", "classical", "single-precision", "coupling", "disturbances",
    "robustness", "contest", "penalties", "periods", "compare",
)  # fmt: skip
SAID: Final = {
    "study": "do the runs of a study and draw its figure",
    "reproduce": "all studies of the paper, one report and a scorecard",
    "design": "which decision and constraint instants the problem needs",
}
GROUP: Final = {"study": "studies", "reproduce": "studies", "design": "a plant and its controller"}
"""Groups in which `coldloop --help` lists the commands."""
OF_RUNS: Final = ("load", "duration", "seeds", "workers", "scheduler", "quick", "shard", "merge")
"""Options that only a study with runs has a use for."""


def _declare_study(parser: argparse.ArgumentParser) -> None:
    name = parser.add_argument("name", nargs="?", metavar="NAME", help="see --list")
    name.completer = lambda **_: STUDIES  # type: ignore[attr-defined]  # argcomplete looks for it
    parser.add_argument("--list", action="store_true", help="list the studies")
    parser.add_argument("--duration", type=duration, help="plant time of each run (default: that of its load)")
    parser.add_argument("--load", type="name", nargs="+", metavar="LOAD", default=[],
                        help="named loads or CSV files time_s,load_w")  # fmt: skip
    parser.add_argument("--variants", type="read", metavar="FILE",
                        help="of `compare`: TOML, a table of settings for each variant, the reference first"
                        " (`coldloop docs compare`)")  # fmt: skip
    parts = parser.add_mutually_exclusive_group()
    parts.add_argument("--shard", metavar="I/N", help="do every N-th run only, from the I-th on, without evaluation")
    parts.add_argument("--merge", type="folder", nargs="+", metavar="FOLDER",
                       help="collect the runs of all shards from their --out folders, and evaluate"
                       )  # fmt: skip
    _add_scale_options(parser)


def _add_scale_options(parser: argparse.ArgumentParser) -> None:
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument("--draws", "--seeds", dest="seeds", type=positive_count, metavar="N",
                       help="draws of each load; of a file, draws of the sensors' noise (default: the study's own)"
                       )  # fmt: skip
    scale.add_argument("--quick", action="store_true", help="one draw, ten minutes, fewer points")
    parser.add_argument("--workers", type=positive_count, metavar="N", help="processes to use (default: one a core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a running Dask scheduler, such as tcp://host:8786")
    parser.add_argument("--out", type="into", default=Path("studies"), help="folder for all results (default: studies)")


def _workers(options: argparse.Namespace) -> "Workers":
    from coldloop_studies.execution import Workers

    if options.scheduler and options.workers:
        raise errors.UsageError("--workers starts a local cluster, --scheduler uses a running one: give one of them")
    return Workers(options.workers or os.cpu_count() or 1, options.scheduler)


def _study_options(options: argparse.Namespace) -> "StudyOptions":
    from coldloop.config import as_toml
    from coldloop.process.settings import SHIPPED_MODELS, ModelSettings
    from coldloop_studies.study import StudyOptions, read_variants

    given, model = vars(options), ModelSettings().file
    own = () if model == SHIPPED_MODELS["cold-box"] else (f"model.file={as_toml(str(model))}",)
    variants = read_variants(options.variants, own) if given.get("variants") else ()
    load, duration = tuple(given.get("load", ())), given.get("duration")
    asked = StudyOptions(options.seeds, None, load, options.quick, variants, own)
    return replace(asked, ticks=duration.ticks(asked.process.tick_s)) if duration else asked


def execute_study(options: argparse.Namespace) -> int:
    """A question that takes many runs, from the paper or beyond it."""
    if options.name is not None and options.name not in STUDIES:
        raise errors.UsageError(f"study {options.name}: unknown study; `coldloop study --list` lists them")
    if options.variants is not None and options.name != "compare":
        raise errors.UsageError("--variants: only `coldloop study compare` compares them")
    if options.variants is None and options.name == "compare":
        raise errors.UsageError(
            "study compare: name the file of the variants with --variants (`coldloop docs compare`)"
        )
    for name in options.load:
        check_load(name)
    from coldloop_studies import reproduction

    everything = {**reproduction.STUDIES, **reproduction.APART}
    if options.list or options.name is None:
        for name, study in everything.items():
            sys.stdout.write(f"{name:18} {study.title}\n")
        return 0
    return _do(everything[options.name], options)


def _do(study: "Study", options: argparse.Namespace) -> int:
    from coldloop_studies.execution import Shard, conduct, conduct_shard, merge
    from coldloop_studies.study import RUNS

    asked = _study_options(options)
    useless = [f"--{name}" for name in OF_RUNS if getattr(options, name)]
    if useless and not study.requests(asked):
        raise errors.UsageError(f"study {study.name} has no runs: {', '.join(useless)} would have no effect")
    if options.merge:
        if options.workers or options.scheduler:
            raise errors.UsageError("--merge does no runs: leave out --workers and --scheduler")
        merge(study, asked, options.merge, options.out)
    if options.shard:
        shard = Shard.parse(options.shard)
        runs = conduct_shard(study, asked, _workers(options), options.out, shard)
        sys.stdout.write(f"shard {shard} of {study.name}: {runs} runs in {options.out / RUNS}\n")
        return 0
    result = conduct(study, asked, _workers(options), options.out)
    for what, values in result.values.items():
        sys.stdout.write(f"{what}: {', '.join(f'{value:.4g}' for value in values)}\n")
    sys.stdout.write(f"results in {options.out / study.name}\n")
    return _ending(result.failed_runs)


def _ending(failed_runs: int) -> int:
    """Return the exit code of studies, and say in how many of their runs updates had no answer."""
    if not failed_runs:
        return 0
    sys.stderr.write(
        f"coldloop: in {failed_runs} runs updates have no answer: what the optimiser computed is not finite\n"
    )
    return errors.NOT_FINITE


def execute_reproduce(options: argparse.Namespace) -> int:
    """Every study of the paper, one report, and a scorecard."""
    from coldloop_studies.reproduction import reproduce

    text, failed_runs = reproduce(_study_options(options), _workers(options), options.out)
    sys.stdout.write(text)
    return _ending(failed_runs)


def _declare_design(parser: argparse.ArgumentParser) -> None:
    service.add_configuration_options(parser)
    parser.add_argument("--load", type="name", dest="loads", nargs="+", metavar="LOAD", default=["a"],
                        help="loads to compare them under: names or CSV files (default: a)")  # fmt: skip
    parser.add_argument("--figure", type="write", metavar="FILE",
                        help="draw loss and iterations over the number of variables: .png, .pdf or .svg")  # fmt: skip
    parser.add_argument("--out", type="write", metavar="FILE", help="write the proposed set as a configuration (TOML)")


def execute_design(options: argparse.Namespace) -> int:
    """Which decision and constraint instants the problem needs, by what each set costs in the loop."""
    from coldloop.text import require_regular_file, whole_text
    from coldloop_rig.cli.commands.options import FIGURE_FORMATS
    from coldloop_rig.figures.plot import save_figure
    from coldloop_rig.progress import make_console
    from coldloop_rig.results.run_folder import writing
    from coldloop_studies import instants

    for name in options.loads:
        check_load(name)
    for path in filter(None, (options.figure, options.out)):
        require_regular_file(path)
    if options.figure and options.figure.suffix.removeprefix(".") not in FIGURE_FORMATS:
        raise errors.UsageError(f"--figure {options.figure}: name a .png, .pdf or .svg file")
    settings = configuration(options).settings
    with make_console().status("") as status:
        found = instants.judged(
            settings, options.loads, lambda done, of: status.update(f"{done} of {of} sets of instants")
        )
    sys.stdout.write(instants.table(found, options.loads))
    if options.figure is not None:
        with writing(options.figure, "choose another --figure"):
            save_figure(instants.drawn(found, options.loads), options.figure)
        sys.stdout.write(f"figure in {options.figure}\n")
    if options.out is not None:
        with writing(options.out):
            whole_text(options.out, instants.configuration(found))
        sys.stdout.write(f"written to {options.out}\n")
    return 0


COMMANDS: Final = {
    "study": Command(_declare_study, execute_study),
    "reproduce": Command(_add_scale_options, execute_reproduce),
    "design": Command(_declare_design, execute_design),
}
