"""`coldloop fault`: a fault on purpose in a rig that is up, to see what ladder, alarms and page make of it.

A service that is killed is started again by `coldloop up`. More can happen to links by `coldloop proxy` and `chaos`.
"""

import argparse
import signal
import sys
from typing import Final

from coldloop.errors import UsageError
from coldloop_rig.cli.commands.options import (
    add_rig_options,
    add_to_subcommands,
    first_port_here,
    operator_settings,
    rig_endpoints,
    tell,
)

SERVICES: Final = ("plant", "control_plc", "optimizer_plc")
LINKS: Final = ("plant", "optimizer")
LONGEST_S: Final = 3600.0
SENSOR_FAULTS: Final = {"none": 0, "dead": 1, "stuck": 2}


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_rig_options(parser)
    what = parser.add_subparsers(title="what", metavar="WHAT", required=True)
    kill = what.add_parser("kill", help="kill a service (SIGKILL); `coldloop up` restarts it")
    kill.add_argument("service", choices=SERVICES, metavar="|".join(SERVICES))
    kill.set_defaults(fault=_kill)
    pause = what.add_parser("pause", help="suspend a service for a while")
    pause.add_argument("service", choices=SERVICES, metavar="|".join(SERVICES))
    pause.add_argument("seconds", type=_seconds, help="duration in real time")
    pause.set_defaults(fault=_pause)
    cut = what.add_parser("cut", help="cut a link for a while; needs a rig started with `up --cuttable`")
    cut.add_argument("link", choices=LINKS, metavar="|".join(LINKS), help="control PLC to plant, or optimiser to it")
    cut.add_argument("seconds", type=_seconds, help="duration in real time")
    cut.set_defaults(fault=_cut)
    sensor = what.add_parser("sensor", help="make a sensor fail: not a number, frozen, or a given value")
    sensor.add_argument("output", metavar="OUTPUT", help="its name")
    sensor.add_argument("shows", metavar="dead|stuck|VALUE|none", help="none ends the fault")
    sensor.set_defaults(fault=_sensor)
    add_to_subcommands(what)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of seconds up to {LONGEST_S:g}")
    return seconds


def execute(options: argparse.Namespace) -> int:
    """Do it, and say what was done."""
    from coldloop_rig.until_interrupted import run_until_interrupted

    operator_settings(options)  # report an unreadable configuration even if the fault does not need it
    return 130 if run_until_interrupted(lambda: options.fault(options)) else 0


async def _kill(options: argparse.Namespace) -> None:
    from coldloop_rig.live.started_rigs import process_of

    process_of(first_port_here(options), options.service).send(signal.SIGKILL)
    sys.stdout.write(f"killed the {options.service} service; `coldloop up` restarts it\n")


async def _pause(options: argparse.Namespace) -> None:
    from coldloop_rig.live.started_rigs import pause, process_of

    process = process_of(first_port_here(options), options.service)
    tell(f"the {options.service} service is suspended for {options.seconds:g} s (Ctrl-C resumes it)")
    runs = await pause(process, options.seconds)
    sys.stdout.write(f"the {options.service} service {'runs again' if runs else 'has ended meanwhile'}\n")


async def _cut(options: argparse.Namespace) -> None:
    from coldloop_rig.chaos.faults import Link
    from coldloop_rig.live.up import cut

    await cut(first_port_here(options), Link(options.link), options.seconds)
    sys.stdout.write(f"the {options.link} link is cut for {options.seconds:g} s\n")


async def _sensor(options: argparse.Namespace) -> None:
    from coldloop.operating.commands import read_command
    from coldloop.operating.execution import WORK
    from coldloop_rig.live.status import ask

    settings = operator_settings(options)
    process = settings.process
    if options.output not in process.output_names:
        raise UsageError(f"unknown output '{options.output}'; choose from {', '.join(process.output_names)}")
    command = read_command({"kind": "sensor_fault", "output": options.output, **_shown(options.shows)}, process)
    services, work = WORK[type(command)]
    text = await ask(rig_endpoints(options, settings), process, services, lambda clients: work(clients, command))
    sys.stdout.write(f"{text}\n")


def _shown(text: str) -> dict[str, float]:
    if text in SENSOR_FAULTS:
        return {"fault": SENSOR_FAULTS[text]}
    try:
        return {"fault": 3, "value": float(text)}
    except ValueError:
        raise UsageError(f"'{text}': a sensor shows {', '.join(SENSOR_FAULTS)}, or a value") from None
