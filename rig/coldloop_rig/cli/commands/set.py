"""`coldloop set`: an operator's commands to a rig that is up.

Each is a Modbus request that any client with the operator's role can make; the answer is read back and shown.
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from coldloop.errors import UsageError
from coldloop_rig.cli.commands.options import (
    add_rig_options,
    add_to_subcommands,
    operator_settings,
    rig_endpoints,
    rig_services,
    tell,
)
from coldloop_rig.durations import LONGEST_TICKS

if TYPE_CHECKING:
    from coldloop.process.declaration import Process
    from coldloop.process.limits import InputLimits
    from coldloop_rig.live.status import Work

MODES: Final = ("auto", "classical", "manual")


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from coldloop.process.settings import settings_process

    add_rig_options(parser)
    process = settings_process()
    number = f"{_unit(process)}, or a CSV file time_s,{process.load.column}"
    what = parser.add_subparsers(title="what", metavar="WHAT", required=True)
    load = what.add_parser("load", help=number)
    load.add_argument("new_load", type="name", metavar="LOAD|FILE", help=f"{number} that begins now")
    load.add_argument("--at", type=_seconds, metavar="SECONDS", help="plant time at which it begins (default: now)")
    load.set_defaults(document=_load)
    mode = what.add_parser("mode", help="who drives")
    mode.add_argument("mode", choices=MODES, metavar="auto|classical|manual")
    mode.set_defaults(document=lambda options: {"kind": "mode", "mode": options.mode})
    setpoint = what.add_parser("setpoint", help="an input in manual mode")
    inputs = {one.tag: one.name for one in process.inputs}
    setpoint.add_argument("input", choices=inputs, metavar="|".join(inputs))
    setpoint.add_argument("value", type=float)
    setpoint.set_defaults(
        document=lambda options: {"kind": "setpoint", "input": inputs[options.input], "value": options.value}
    )
    factor = what.add_parser("factor", help="seconds of plant time per second; also switches to real time")
    factor.add_argument("factor", type=float)
    factor.set_defaults(document=lambda options: {"kind": "factor", "factor": options.factor})
    pause = what.add_parser("pause", help="pause plant time")
    pause.set_defaults(document=lambda _: {"kind": "pause", "paused": True})
    resume = what.add_parser("resume", help="resume plant time")
    resume.set_defaults(document=lambda _: {"kind": "pause", "paused": False})
    acknowledge = what.add_parser("acknowledge", help="an alarm, or all")
    acknowledge.add_argument("alarm", nargs="?", metavar="ALARM", help="such as mode (default: all)")
    acknowledge.set_defaults(document=_acknowledgement)
    add_to_subcommands(what)


def _unit(process: "Process") -> str:
    return {"W": "watts"}.get(process.load.unit, process.load.unit)


def _seconds(text: str) -> float:
    from coldloop.process.settings import settings_process
    from coldloop.process.updating_periods import whole_ticks

    tick_s = settings_process().tick_s
    try:
        ticks = whole_ticks(float(text), tick_s)
    except ValueError:
        ticks = None
    if ticks is None or not 0 <= ticks < LONGEST_TICKS:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of seconds in multiples of {tick_s:g}")
    return ticks * tick_s


def execute(options: argparse.Namespace) -> int:
    """Send the command, and print the result."""
    from coldloop_rig.until_interrupted import run_until_interrupted

    return 130 if run_until_interrupted(lambda: _do(options)) else 0


async def _do(options: argparse.Namespace) -> None:
    from coldloop_rig.live.status import ask

    settings = operator_settings(options)
    services, work = _stream(options, settings.process) if _is_stream(options) else _command(options, settings.limits)
    there = rig_services(options)
    concerned = [service for service in services if service in there]
    text = await ask(
        rig_endpoints(options, settings), settings.process, concerned, work, limited=not _is_stream(options)
    )
    sys.stdout.write(f"{text}\n")


def _command(options: argparse.Namespace, limits: "InputLimits") -> tuple[tuple[str, ...], "Work"]:
    """Return the services that a command concerns, and what is done with them.

    Raises:
        UsageError: There is no such command.
    """
    from coldloop.operating.commands import SetSetpoint, read_command
    from coldloop.operating.execution import WORK, check_bounds

    command = read_command(options.document(options), limits.process)
    if isinstance(command, SetSetpoint):
        check_bounds(command, limits.low[command.place], limits.high[command.place])
    services, work = WORK[type(command)]
    return services, lambda clients: work(clients, command)


def _stream(options: argparse.Namespace, process: "Process") -> tuple[tuple[str, ...], "Work"]:
    from coldloop.operating.execution import stream_load
    from coldloop.process.load_profile import read_load_file

    if not Path(options.new_load).is_file():
        raise UsageError(f"load '{options.new_load}': neither {_unit(process)} nor a file")
    load = read_load_file(Path(options.new_load), process)
    return ("plant",), lambda clients: stream_load(clients, load, _tick(options), tell)


def _is_stream(options: argparse.Namespace) -> bool:
    """Return whether a load file is written: that has no time limit."""
    if options.document is not _load:
        return False
    try:
        float(options.new_load)
    except ValueError:
        return True
    return False


def _load(options: argparse.Namespace) -> dict[str, object]:
    return {"kind": "load", "watts": float(options.new_load), "tick": _tick(options)}


def _tick(options: argparse.Namespace) -> int:
    from coldloop.process.settings import settings_process

    return 0 if options.at is None else round(options.at / settings_process().tick_s)


def _acknowledgement(options: argparse.Namespace) -> dict[str, object]:
    from coldloop.process.settings import settings_process
    from coldloop.registers.safety import ALL_ALARMS, AlarmAction, alarms_of
    from coldloop.service.event_text import alarm_word

    process = settings_process()
    kinds = {alarm_word(alarm, process).replace(" ", "-"): alarm for alarm in alarms_of(process)}
    if options.alarm is not None and options.alarm not in kinds:
        raise UsageError(f"unknown alarm '{options.alarm}'; choose from {', '.join(kinds)}")
    alarm = ALL_ALARMS if options.alarm is None else kinds[options.alarm]
    return {"kind": "alarm", "alarm": alarm, "action": int(AlarmAction.ACKNOWLEDGE)}
