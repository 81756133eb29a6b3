"""`coldloop chaos`: a run with faults on purpose, and what the fail-safe side made of them."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coldloop.errors import LinkError, UsageError
from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands.choices import FIGURE_FORMATS, MODES, plans
from coldloop_rig.cli.commands.options import OWN_PORTS, PLACES, check_load, configuration, refuse_ineffective
from coldloop_rig.durations import duration

if TYPE_CHECKING:
    from coldloop.config import Configuration
    from coldloop_rig.chaos.experiment import Experiment
    from coldloop_rig.chaos.plan import ChaosPlan
    from coldloop_rig.settings import Settings


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    plan = parser.add_argument("plan", type="name", nargs="?", metavar="PLAN", help="a shipped plan, or a TOML file")
    plan.completer = lambda **_: plans()  # type: ignore[attr-defined]  # argcomplete looks for it
    parser.add_argument("--list", action="store_true", help="list the shipped plans")
    parser.add_argument("--out", type="into", help="folder for the results (default: chaos/<plan>-<time>)")
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    parser.add_argument("--seed", type=_seed, dest="plan_seed", help="instead of the plan's")
    parser.add_argument("--duration", type=duration, help="plant time, such as 2h or 90s, instead of the plan's")
    parser.add_argument("--load", type="name", dest="plan_load",
                        help="a named load or a CSV file, instead of the plan's")  # fmt: skip
    parser.add_argument("--mode", choices=MODES, dest="plan_mode",
                        help="instead of the plan's")  # fmt: skip
    parser.add_argument("--factor", type=float, dest="plan_factor", help="instead of the plan's")
    parser.add_argument("--figures", nargs="+", choices=FIGURE_FORMATS, default=["png"], metavar="FORMAT",
                        help="of the run's picture: png, pdf, svg (default: png)")  # fmt: skip


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of at least 0")
    return int(text)


def execute(options: argparse.Namespace) -> int:
    """List the plans, or run one."""
    if options.list:
        _list_plans()
        return 0
    check_load(options.plan_load)
    if options.plan is None:
        raise UsageError("name a plan; `coldloop chaos --list` lists the shipped ones")
    from coldloop.process.settings import settings_of
    from coldloop_rig.chaos.experiment import perform
    from coldloop_rig.chaos.plan import find_plan
    from coldloop_rig.chaos.progress import ChaosProgress
    from coldloop_rig.results.folders import claim_folder, claim_folder_of_now
    from coldloop_rig.runs.manifest import plain_arguments

    effective, changes = configuration(options), _changes(options)
    with settings_of(effective.settings.process):
        plan = find_plan(options.plan, changes)
    _refuse_what_has_no_effect(effective)
    out = options.out or claim_folder_of_now(Path("chaos"), plan.name)
    claim_folder(out, force=options.force)
    with ChaosProgress(plan) as progress:
        experiment = perform(
            plan, effective, out, progress, arguments=plain_arguments(options), formats=options.figures
        )
    _report(out, plan, experiment)
    if experiment.failure is not None:
        raise LinkError(experiment.failure)
    return 0


def _list_plans() -> None:
    from coldloop_rig.chaos.plan import shipped_plans

    for plan in shipped_plans():
        sys.stdout.write(f"{plan.name:20} {plan.description}\n")


def _refuse_what_has_no_effect(effective: "Configuration[Settings]") -> None:
    """Refuse a value from the command line that the plan's own, or that of the command, would replace."""
    from coldloop_rig.chaos.plan import OF_PLAN

    refuse_ineffective(
        effective,
        {
            **{key: f"the plan has its own value; change it with {option}" for key, option in OF_PLAN.items()},
            **dict.fromkeys(PLACES, OWN_PORTS),
            "session.autostart": "it begins a session",
            "plant.retain.file": "the states are retained in the folder of the results",
            "control_plc.retain.file": "the states are retained in the folder of the results",
        },
    )


def _report(out: Path, plan: "ChaosPlan", experiment: "Experiment") -> None:
    from coldloop_rig.chaos.report import summary_lines, table
    from coldloop_rig.results.folders import writing

    with writing(out, "no report was written, choose another --out"):
        _write(out, plan, experiment)
    sys.stdout.write(table(experiment.evaluation.rows, plan.process))
    for line in [*summary_lines(experiment.trace, experiment.evaluation), f"results in {out}"]:
        sys.stdout.write(f"{line}\n")


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    given = {
        "seed": options.plan_seed,
        "duration_s": options.duration and options.duration.seconds,
        "load": options.plan_load,
        "mode": options.plan_mode,
        "factor": options.plan_factor,
    }
    return {name: value for name, value in given.items() if value is not None}


def _write(out: Path, plan: "ChaosPlan", experiment: "Experiment") -> None:
    from coldloop_rig.chaos.figure import plot_chaos
    from coldloop_rig.chaos.report import write_report

    trace, undisturbed = experiment.trace, experiment.undisturbed
    hashes = {
        "trace_sha256": trace.recording().trace_sha256,
        "undisturbed_trace_sha256": undisturbed.trace_sha256,
    }
    write_report(out, plan, trace, experiment.evaluation, hashes, experiment.failure)
    plot_chaos(out / "chaos.png", trace, undisturbed, experiment.design, f"{plan.name}: {plan.description}")
