"""`coldloop budget`: what a PLC can do in an updating period, and whether its memory holds the problem."""

import argparse
import math
import sys
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Final

from coldloop.errors import UsageError
from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands.options import check_load, configuration, fixed_updating_period, positive_count
from coldloop_rig.text_tables import fitted, width

if TYPE_CHECKING:
    from coldloop_optimizer_plc.qp.problem import PredictiveProblem
    from coldloop_optimizer_plc.settings import ProgramSettings
    from coldloop_rig.settings import Settings

USUAL_SCENARIOS: Final = 100


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    speed = parser.add_mutually_exclusive_group()
    speed.add_argument(
        "--power", type=_power, metavar="P", help="one power relative to the paper's PLC (default: as configured)"
    )
    speed.add_argument("--plc", type="name", metavar="PLC",
                       help="a PLC instead: a profile (TOML) or one that is shipped, and a sentence that says whether "
                       "the controller runs there; --list names them")  # fmt: skip
    parser.add_argument("--export", type="folder", metavar="FOLDER",
                        help="what an export for a PLC costs: operations of its calls and bytes; with --plc also times"
                        " there, and what does not fit")  # fmt: skip
    parser.add_argument("--took", type=_power, metavar="US",
                        help="with --export: a PLC took so many microseconds for the iterations of the solver's"
                        " self-test; prints its profile")  # fmt: skip
    parser.add_argument("--list", action="store_true", help="list the shipped PLCs")
    parser.add_argument("--keys", action="store_true", help="list the keys of a PLC's profile, as Markdown")
    parser.add_argument("--load", type="name", dest="loads", nargs="+", metavar="LOAD", default=[],
                        help="with --plc: whether an adaptive updating period pays there under these loads, against "
                        "--updating-period or the best fixed one")  # fmt: skip
    parser.add_argument("--updating-period", dest="period", type=fixed_updating_period, metavar="SECONDS",
                        help="one updating period (default: a fifth, a half and all of a sampling period)")  # fmt: skip
    parser.add_argument("--certify", type=positive_count, nargs="?", const=USUAL_SCENARIOS, metavar="N",
                        help="how many iterations are enough, by N sampled scenarios, with its confidence "
                        f"(default: {USUAL_SCENARIOS})")  # fmt: skip
    parser.add_argument("--tolerance", type=_percent, default=5.0, metavar="PERCENT",
                        help="with --certify: enough is within this of the optimum (default: 5)")  # fmt: skip
    parser.add_argument("--confidence", type=_percent, default=99.9, metavar="PERCENT",
                        help="with --certify: of the bounds (default: 99.9)")  # fmt: skip


def _percent(text: str) -> float:
    value = _number(text)
    if not 0 < value < 100:
        raise argparse.ArgumentTypeError(f"'{text}' is not a percentage above 0 and below 100")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _power(text: str) -> float:
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def execute(options: argparse.Namespace) -> int:
    """Print the tables."""
    if options.loads and options.plc is None:
        raise UsageError("--load: says whether an adaptive period pays on a PLC; name one with --plc")
    if options.took and not options.export:
        raise UsageError("--took: is of an export's self-test; name its folder with --export")
    sys.stdout.write(fitted(_shown(options), width()))
    return 0


def _shown(options: argparse.Namespace) -> str:
    from coldloop_rig.plc_sizing.plc import PlcProfile, find_profile, shipped_profiles

    if options.list:
        from coldloop_rig.text_tables import aligned

        return aligned([(name, find_profile(name).name) for name in shipped_profiles()])
    if options.keys:
        from coldloop_rig.cli.listings import key_listing

        return key_listing(PlcProfile)
    if options.export:
        from coldloop_rig.plc_sizing.exported import cost_text, profile_of, read_cost

        cost = read_cost(options.export)
        if options.took:
            return profile_of(cost, options.took)
        return cost_text(cost, find_profile(options.plc) if options.plc else None)
    if options.certify:
        from coldloop_rig.plc_sizing.certification import certification_table

        if any(value is not None for value in (options.power, options.plc, options.period)):
            raise UsageError("--certify: uses the configured PLC; leave out --power, --plc and --updating-period")
        settings = configuration(options).settings
        return certification_table(settings, options.certify, options.tolerance, options.confidence)
    return _tables(options)


def _tables(options: argparse.Namespace) -> str:
    from coldloop_rig.plc_sizing.budget import budget_tables, plc_tables, with_power
    from coldloop_rig.plc_sizing.plc import find_profile
    from coldloop_rig.runs.remarks import certificate

    if len(set(options.loads)) < len(options.loads):
        raise UsageError("--load: a load is named twice; two of the same are no evidence")
    for name in options.loads:
        check_load(name)
    profile = None if options.plc is None else find_profile(options.plc)
    settings = configuration(options).settings
    if profile is not None:
        return plc_tables(settings, options.period, profile,
                          lambda there: f"{certificate(there)}\n{_costs(there, options)}".strip())  # fmt: skip
    if options.power is not None:
        settings = with_power(settings, options.power)
    program = settings.optimizer_plc.program
    held, tables = certificate(settings), budget_tables(settings, options.period, lambda one: _executed(one, program))
    return f"{held}\n\n{tables}" if held else tables


def _executed(problem: "PredictiveProblem", program: "ProgramSettings") -> str:
    counters = entry_points(group="coldloop.counters", name="ode")
    if not counters:
        return ""
    counter = counters["ode"].load()(problem, program)
    return (
        f"ode as exported, an iteration a call, executed: {counter.unconstrained():,} operations with no row active, "
        f"{counter.worst():,} in the worst case (every row active, a bound cuts the step)\n"
    )


def _costs(settings: "Settings", options: argparse.Namespace) -> str:
    if not options.loads:
        return ""
    from coldloop_rig.plc_sizing.adaptive_gain import adaptive_gain
    from coldloop_rig.progress import make_console

    with make_console().status("") as status:
        return adaptive_gain(
            settings, options.loads, options.period, lambda done, of: status.update(f"{done} of {of} runs")
        )
