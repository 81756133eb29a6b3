"""`coldloop set`: an operator's commands to a rig that is up.

Each is a Modbus request that any client with the operator's role can make; the answer is read back and shown.
"""

import argparse
import sys
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Final

from coldloop.errors import UsageError
from coldloop.process.signals import TICK_S
from coldloop.service.command_line import add_configuration_options
from rig.cli.commands.options import add_rig_options, operator_settings, rig_endpoints
from rig.durations import LONGEST_TICKS

if TYPE_CHECKING:
    from rig.cosim.operator_client import OperatorClient

MODES: Final = ("auto", "classical", "manual")
INPUTS: Final = ("cv155", "ncr22", "cv156")
Done = Awaitable[str]


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    add_rig_options(parser)
    what = parser.add_subparsers(title="what", metavar="WHAT", required=True)
    load = what.add_parser("load", help="watts, or a CSV file time_s,load_w")
    load.add_argument("new_load", metavar="WATTS|FILE", help="watts, or a CSV file time_s,load_w that begins now")
    load.add_argument("--at", type=_seconds, metavar="SECONDS", help="plant time at which it begins (default: now)")
    load.set_defaults(command=_load)
    mode = what.add_parser("mode", help="who drives")
    mode.add_argument("new_mode", choices=MODES, metavar="auto|classical|manual")
    mode.set_defaults(command=lambda client, options: client.set_mode(options.new_mode))
    setpoint = what.add_parser("setpoint", help="an input in manual mode")
    setpoint.add_argument("input", choices=INPUTS, metavar="cv155|ncr22|cv156")
    setpoint.add_argument("value", type=float)
    setpoint.set_defaults(command=lambda client, options: client.set_setpoint(options.input, options.value))
    factor = what.add_parser("factor", help="seconds of plant time in a second; also changes over to real time")
    factor.add_argument("new_factor", type=float, metavar="FACTOR")
    factor.set_defaults(command=lambda client, options: client.set_factor(options.new_factor))
    pause = what.add_parser("pause", help="pause plant time")
    pause.set_defaults(command=lambda client, _: client.set_paused(paused=True))
    resume = what.add_parser("resume", help="resume plant time")
    resume.set_defaults(command=lambda client, _: client.set_paused(paused=False))
    acknowledge = what.add_parser("acknowledge", help="an alarm, or all")
    acknowledge.add_argument("alarm", nargs="?", metavar="ALARM", help="such as t5-band (default: all)")
    acknowledge.set_defaults(command=lambda client, options: client.acknowledge(options.alarm))
    for subcommand in what.choices.values():  # options are taken before and behind what is to be done
        add_configuration_options(subcommand, again=True)
        add_rig_options(subcommand, again=True)
    parser.set_defaults(execute=execute)


def _seconds(text: str) -> float:
    try:
        ticks = float(text) / TICK_S
    except ValueError:
        ticks = -1.0
    if not (0 <= ticks < LONGEST_TICKS and ticks.is_integer()):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of seconds in multiples of 0.25")
    return ticks * TICK_S


def execute(options: argparse.Namespace) -> int:
    """Do it, and say what came back."""
    from rig.until_interrupted import run_until_interrupted

    return 130 if run_until_interrupted(lambda: _do(options)) else 0


async def _do(options: argparse.Namespace) -> None:
    from rig.cosim.answer_time import answered_in_time
    from rig.cosim.operator_client import OperatorClient

    settings = operator_settings(options)
    command: Callable[[OperatorClient, argparse.Namespace], Done] = options.command
    client = OperatorClient(rig_endpoints(options, settings), settings.limits)
    async with AsyncExitStack() as stack:
        async with answered_in_time("to connect"):
            await stack.enter_async_context(client)
        async with nullcontext() if options.command is _load else answered_in_time("the command"):
            text = await command(client, options)
    sys.stdout.write(f"{text}\n")


def _load(client: "OperatorClient", options: argparse.Namespace) -> Done:
    try:
        watts = float(options.new_load)
    except ValueError:
        if not Path(options.new_load).is_file():
            raise UsageError(f"load '{options.new_load}': neither watts nor a file") from None
        from plant.load import read_load_file

        return client.stream_load(read_load_file(Path(options.new_load)), options.at, _say)
    return client.set_load(watts, options.at)


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
