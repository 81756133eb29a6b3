"""The commands `chaos` and `proxy`."""

import argparse
import math
import sys
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Final

from coldloop import errors, service
from coldloop.process.updating_periods import duration
from coldloop_rig.cli.commands import options as common
from coldloop_rig.interruption import run_until_interrupted

SAID: Final = {
    "chaos": "a run with injected faults, and its evaluation",
    "proxy": "delays, loses, damages, cuts or refuses Modbus/TCP traffic",
}
GROUP: Final = {"chaos": "a run", "proxy": "a rig that stays up"}
"""Groups in which `coldloop --help` lists the commands."""


def plans() -> list[str]:
    """Return the names of the chaos plans that are shipped."""
    folder = files("coldloop_chaos") / "plans"
    return sorted(file.name.removesuffix(".toml") for file in folder.iterdir() if file.name.endswith(".toml"))


def _declare_chaos(parser: argparse.ArgumentParser) -> None:
    service.add_configuration_options(parser)
    plan = parser.add_argument("plan", type="name", nargs="?", metavar="PLAN", help="a shipped plan, or a TOML file")
    plan.completer = lambda **_: plans()  # type: ignore[attr-defined]  # argcomplete looks for it
    parser.add_argument("--list", action="store_true", help="list the shipped plans")
    parser.add_argument("--out", type="into", help="folder for the results (default: chaos/<plan>-<time>)")
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    seed = partial(common.number_within, least=0, most=math.inf, what="a whole number of at least 0")
    parser.add_argument("--seed", type=seed, dest="plan_seed", help="instead of the plan's")
    parser.add_argument("--duration", type=duration, help="plant time, such as 2h or 90s, instead of the plan's")
    parser.add_argument(
        "--load", type="name", dest="plan_load", help="a named load or a CSV file, instead of the plan's"
    )
    parser.add_argument("--mode", choices=common.MODES, dest="plan_mode", help="instead of the plan's")
    parser.add_argument("--factor", type=float, dest="plan_factor", help="instead of the plan's")
    parser.add_argument("--figures", nargs="+", choices=common.FIGURE_FORMATS, default=["png"], metavar="FORMAT",
                        help="of the run's picture: png, pdf, svg (default: png)")  # fmt: skip


def execute_chaos(options: argparse.Namespace) -> int:
    """A run with faults on purpose, and what the fail-safe side made of them."""
    if options.list:
        from coldloop_chaos.faults import shipped_plans

        sys.stdout.write("".join(f"{plan.name:20} {plan.description}\n" for plan in shipped_plans()))
        return 0
    common.check_load(options.plan_load)
    if options.plan is None:
        raise errors.UsageError("name a plan; `coldloop chaos --list` lists the shipped ones")
    from coldloop.process.settings import settings_of
    from coldloop_chaos import faults, report

    effective = common.configuration(options)
    given = {name: getattr(options, f"plan_{name}") for name in ("seed", "load", "mode", "factor")}
    given["duration_s"] = options.duration and options.duration.seconds
    with settings_of(effective.settings.process):
        plan = faults.find_plan(options.plan, {name: value for name, value in given.items() if value is not None})
    retained = "the states are retained in the folder of the results"
    ineffective = {
        **{key: f"the plan has its own value; change it with {option}" for key, option in faults.OF_PLAN.items()},
        **dict.fromkeys(("plant.retain.file", "control_plc.retain.file"), retained),
    }
    common.refuse_ineffective(effective, common.OWN_PORTS, ineffective)
    from coldloop_rig.results.run_folder import claim_folder, claim_folder_of_now, writing
    from coldloop_rig.runs.running import plain_arguments

    out = options.out or claim_folder_of_now(Path("chaos"), plan.name)
    claim_folder(out, force=options.force)
    with report.ChaosProgress(plan) as progress:
        arguments = plain_arguments(options)
        experiment = report.perform(plan, effective, out, progress, arguments=arguments, formats=options.figures)
    with writing(out, "no report was written, choose another --out"):
        report.write_report(out, experiment)
        report.plot_chaos(out / "chaos.png", experiment)
    sys.stdout.write(report.table(experiment.evaluation.rows, plan.process))
    lines = (*report.summary_lines(experiment.trace, experiment.evaluation), f"results in {out}")
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    if experiment.failure is not None:
        raise errors.LinkError(experiment.failure)
    return 0


def _declare_proxy(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plan", type="read", metavar="PLAN", help="TOML file with the faults (`coldloop docs chaos`)")

    def listener(text: str) -> common.HostPort:
        return common.endpoint(text if ":" in text else f"127.0.0.1:{text}")

    parser.add_argument("--listen", type=listener, required=True, metavar="[HOST:]PORT",
                        help="where clients connect; at 127.0.0.1 unless an address is named")  # fmt: skip
    parser.add_argument("--to", type=common.endpoint, required=True, metavar="HOST:PORT", help="the server behind it")
    parser.add_argument("--seed", type=int, help="decides which frames are hit, instead of the plan's")


def execute_proxy(options: argparse.Namespace) -> int:
    """A link to any Modbus/TCP server, disturbed by plan: late, lost, doubled, damaged, cut, refused."""
    from coldloop.modbus.settings import Endpoint
    from coldloop_chaos.faults import find_link_plan
    from coldloop_chaos.proxy import disturb

    plan = find_link_plan(options.plan, {} if options.seed is None else {"seed": options.seed})
    if options.listen == options.to:
        raise errors.UsageError(
            f"--listen {options.to.host}:{options.to.port} is the server itself; listen at another port"
        )
    target = Endpoint(host=options.to.host, port=options.to.port)
    return 130 if run_until_interrupted(lambda: disturb(plan, options.listen, target, common.say)) else 0


COMMANDS: Final = {
    "chaos": common.Command(_declare_chaos, execute_chaos),
    "proxy": common.Command(_declare_proxy, execute_proxy),
}
