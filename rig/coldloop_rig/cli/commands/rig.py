"""Commands about a rig that stays up."""

import argparse
import asyncio
import signal
import sys
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from coldloop.errors import UsageError
from coldloop.process.updating_periods import LONGEST_TICKS
from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands import options as common
from coldloop_rig.interruption import run_until_interrupted
from coldloop_rig.text_tables import coloured, cut, fitted, width

if TYPE_CHECKING:
    from coldloop.process.declaration import Process
    from coldloop.process.settings import InputLimits
    from coldloop_rig.live.status import Work
    from coldloop_rig.settings import Settings


def _declare_up(parser: argparse.ArgumentParser) -> None:
    add_configuration_options(parser)
    parser.add_argument("--factor", type=float, help="seconds of plant time per second (default: 1)")
    common.add_loop_options(parser, "or, its end held, ")
    parser.add_argument("--tls", type="folder", metavar="FOLDER",
                        help="Modbus/TCP Security with what `coldloop certificates --out FOLDER` made")  # fmt: skip
    parser.add_argument("--port-base", type=common.port_base, metavar="PORT",
                        help="first of three consecutive ports (default: 5020)")  # fmt: skip
    parser.add_argument("--page", action="store_true", help="serve the operator's page, too")
    parser.add_argument("--page-port", type=int, metavar="PORT", help="its port (default: 8020); implies --page")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--without", choices=common.WITHOUT, metavar="|".join(common.WITHOUT),
                       help="leave its place to a client of your own (`coldloop docs your-optimiser`)")  # fmt: skip
    other.add_argument("--optimizer", type="export", metavar="export:FOLDER",
                       help="the exported optimiser in the place of ours (`coldloop docs plc-export`)")  # fmt: skip
    parser.add_argument("--cuttable", action="store_true",
                        help="put a proxy into each link, for `coldloop fault cut`")  # fmt: skip
    parser.add_argument("--detach", action="store_true", help="return when it is up; `coldloop down` ends it")
    parser.add_argument("--quiet", action="store_true", help="do not print addresses and commands")
    parser.add_argument("--locked", type=int, help=argparse.SUPPRESS)  # the lock file that --detach holds
    parser.set_defaults(mode="realtime")


def execute_up(options: argparse.Namespace) -> int:
    """The rig on fixed ports, in real time, until Ctrl-C."""
    common.check_load(options.load)
    from coldloop_rig.live.started_rigs import RigLock, check_ports, detached, ports_from
    from coldloop_rig.runs.running import check_certificates, remarks

    effective = common.configuration(options)
    common.refuse_ineffective(
        effective, {**dict.fromkeys(common.PLACES, "give --port-base"), "session.autostart": "it begins a session"}
    )
    check_certificates(effective.settings)
    told = [] if options.without else remarks(effective)
    optimizer = common.exported(options.optimizer, effective.settings)
    ports = ports_from(options.port_base)
    lock = RigLock(ports[0], options.locked)
    check_ports(ports)
    page = options.page or options.page_port is not None
    if page:
        from coldloop_rig.live.up import check_page

        check_page(effective.settings.hmi)
    if options.detach and options.locked is None:
        return detached(ports, lock)
    from coldloop_rig.cosim.wiring import REQUIRED, SERVICES
    from coldloop_rig.live.up import UpRig

    for line in told:
        common.tell(line)
    services = REQUIRED if options.without else SERVICES
    rig = UpRig(effective.settings, ports, options.tls, page=page, cuttable=options.cuttable, services=services,
                optimizer=optimizer)  # fmt: skip
    run_until_interrupted(lambda: rig.run(announce=not options.quiet))
    return 0


def execute_down(options: argparse.Namespace) -> int:
    """Ends a rig that `coldloop up` has started here."""
    from coldloop_rig.live.started_rigs import take_down

    pid = take_down(common.first_port_here(options), patience_s=15.0)
    sys.stdout.write(f"the rig is down (process {pid})\n")
    return 0


def _declare_status(parser: argparse.ArgumentParser) -> None:
    common.add_rig_options(parser)
    parser.add_argument("--follow", action="store_true", help="a line a second until Ctrl-C")


def execute_status(options: argparse.Namespace) -> int:
    """What a rig that is up is doing."""
    interrupted = run_until_interrupted(lambda: _show_status(options))
    return 130 if interrupted and not options.follow else 0


async def _show_status(options: argparse.Namespace) -> None:
    from coldloop.operating.execution import clients_of
    from coldloop_rig.live.status import colour, line, page, read_status

    settings = common.operator_settings(options)
    endpoints = common.rig_endpoints(options, settings)
    clients = clients_of({each: getattr(endpoints, each) for each in common.rig_services(options)}, settings.process)
    try:
        status = await read_status(clients)
        if not options.follow:
            sys.stdout.write(fitted(page(status), width()))
        while options.follow:
            common.say(coloured(cut(line(status), width()), colour(status)))
            await asyncio.sleep(1.0)
            status = await read_status(clients)
    finally:
        for client in clients.values():
            client.close()


def _declare_set(parser: argparse.ArgumentParser) -> None:
    from coldloop.process.settings import settings_process

    common.add_rig_options(parser)
    process = settings_process()
    number = f"{_unit(process)}, or a CSV file time_s,{process.load.column}"
    what = parser.add_subparsers(title="what", metavar="WHAT", required=True)
    load = what.add_parser("load", help=number)
    load.add_argument("new_load", type="name", metavar="LOAD|FILE", help=f"{number} that begins now")
    load.add_argument("--at", type=_plant_time, metavar="SECONDS", help="plant time at which it begins (default: now)")
    load.set_defaults(document=_load)
    mode = what.add_parser("mode", help="who drives")
    mode.add_argument("mode", choices=("auto", "classical", "manual"), metavar="auto|classical|manual")
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
    common.add_to_subcommands(what)


def _unit(process: "Process") -> str:
    return {"W": "watts"}.get(process.load.unit, process.load.unit)


def _plant_time(text: str) -> float:
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


def execute_set(options: argparse.Namespace) -> int:
    """An operator's commands to a rig that is up.

    Each is a Modbus request that any client with the operator's role can make; the answer is read back and shown.
    """
    return 130 if run_until_interrupted(lambda: _send(options)) else 0


async def _send(options: argparse.Namespace) -> None:
    from coldloop_rig.live.status import ask

    settings = common.operator_settings(options)
    services, work = _stream(options, settings.process) if _is_stream(options) else _command(options, settings.limits)
    there = common.rig_services(options)
    concerned = [service for service in services if service in there]
    text = await ask(
        common.rig_endpoints(options, settings), settings.process, concerned, work, limited=not _is_stream(options)
    )
    sys.stdout.write(f"{text}\n")


def _command(options: argparse.Namespace, limits: "InputLimits") -> tuple[tuple[str, ...], "Work"]:
    """Return the services that a command concerns, and what is done with them."""
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
    return ("plant",), lambda clients: stream_load(clients, load, _tick(options), common.tell)


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
    from coldloop.service.journal import alarm_word

    process = settings_process()
    kinds = {alarm_word(alarm, process).replace(" ", "-"): alarm for alarm in alarms_of(process)}
    if options.alarm is not None and options.alarm not in kinds:
        raise UsageError(f"unknown alarm '{options.alarm}'; choose from {', '.join(kinds)}")
    alarm = ALL_ALARMS if options.alarm is None else kinds[options.alarm]
    return {"kind": "alarm", "alarm": alarm, "action": int(AlarmAction.ACKNOWLEDGE)}


SERVICES: Final = ("plant", "control_plc", "optimizer_plc")
LINKS: Final = ("plant", "optimizer")
SENSOR_FAULTS: Final = {"none": 0, "dead": 1, "stuck": 2}


def _declare_fault(parser: argparse.ArgumentParser) -> None:
    common.add_rig_options(parser)
    what = parser.add_subparsers(title="what", metavar="WHAT", required=True)
    kill = what.add_parser("kill", help="kill a service (SIGKILL); `coldloop up` restarts it")
    kill.add_argument("service", choices=SERVICES, metavar="|".join(SERVICES))
    kill.set_defaults(fault=_kill)
    pause = what.add_parser("pause", help="suspend a service for a while")
    pause.add_argument("service", choices=SERVICES, metavar="|".join(SERVICES))
    pause.add_argument("seconds", type=_real_time, help="duration in real time")
    pause.set_defaults(fault=_pause)
    cut = what.add_parser("cut", help="cut a link for a while; needs a rig started with `up --cuttable`")
    cut.add_argument("link", choices=LINKS, metavar="|".join(LINKS), help="control PLC to plant, or optimiser to it")
    cut.add_argument("seconds", type=_real_time, help="duration in real time")
    cut.set_defaults(fault=_cut)
    sensor = what.add_parser("sensor", help="make a sensor fail: not a number, frozen, or a given value")
    sensor.add_argument("output", metavar="OUTPUT", help="its name")
    sensor.add_argument("shows", metavar="dead|stuck|VALUE|none", help="none ends the fault")
    sensor.set_defaults(fault=_sensor)
    common.add_to_subcommands(what)


def _real_time(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds <= 3600:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of seconds up to 3600")
    return seconds


def execute_fault(options: argparse.Namespace) -> int:
    """A fault on purpose in a rig that is up, to see what ladder, alarms and page make of it.

    A service that is killed is started again by `coldloop up`. More can happen to links by `coldloop proxy` and
    `chaos`.
    """
    common.operator_settings(options)  # report an unreadable configuration even if the fault does not need it
    return 130 if run_until_interrupted(lambda: options.fault(options)) else 0


async def _kill(options: argparse.Namespace) -> None:
    from coldloop_rig.live.started_rigs import process_of

    process_of(common.first_port_here(options), options.service).send(signal.SIGKILL)
    sys.stdout.write(f"killed the {options.service} service; `coldloop up` restarts it\n")


async def _pause(options: argparse.Namespace) -> None:
    from coldloop_rig.live.started_rigs import pause, process_of

    process = process_of(common.first_port_here(options), options.service)
    common.tell(f"the {options.service} service is suspended for {options.seconds:g} s (Ctrl-C resumes it)")
    runs = await pause(process, options.seconds)
    sys.stdout.write(f"the {options.service} service {'runs again' if runs else 'has ended meanwhile'}\n")


async def _cut(options: argparse.Namespace) -> None:
    from coldloop_rig.live.up import cut

    await cut(common.first_port_here(options), options.link, options.seconds)
    sys.stdout.write(f"the {options.link} link is cut for {options.seconds:g} s\n")


async def _sensor(options: argparse.Namespace) -> None:
    from coldloop.operating.commands import read_command
    from coldloop.operating.execution import WORK
    from coldloop_rig.live.status import ask

    settings, shows = common.operator_settings(options), options.shows
    process = settings.process
    if options.output not in process.output_names:
        raise UsageError(f"unknown output '{options.output}'; choose from {', '.join(process.output_names)}")
    shown: dict[str, float] = {"fault": 3}
    try:
        shown |= {"fault": SENSOR_FAULTS[shows]} if shows in SENSOR_FAULTS else {"value": float(shows)}
    except ValueError:
        raise UsageError(f"'{shows}': a sensor shows {', '.join(SENSOR_FAULTS)}, or a value") from None
    command = read_command({"kind": "sensor_fault", "output": options.output, **shown}, process)
    services, work = WORK[type(command)]
    text = await ask(common.rig_endpoints(options, settings), process, services, lambda clients: work(clients, command))
    sys.stdout.write(f"{text}\n")


def _declare_page(parser: argparse.ArgumentParser) -> None:
    common.add_rig_options(parser)
    parser.add_argument("runs", nargs="*", type="folder", metavar="RUN",
                        help="folder of a recorded run; two: side by side; none: a rig that is up")  # fmt: skip
    parser.add_argument("--page-port", type=int, metavar="PORT", help="port of the page (default: 8020)")


def execute_page(options: argparse.Namespace) -> int:
    """The operator's page of a rig that is up, or of recorded runs."""
    if len(options.runs) > 2:
        raise UsageError(f"{len(options.runs)} runs: one is replayed, or two side by side")
    from coldloop_rig.live.up import check_page

    effective = common.configuration(options).settings
    check_page(effective.hmi)
    if not options.runs:
        return 130 if run_until_interrupted(lambda: _watch(options, effective)) else 0
    from coldloop_hmi.runtime import serve_replays
    from coldloop_rig.live.recorded_page import RecordedPage
    from coldloop_rig.results.run_folder import RunFolder

    def replayed() -> Coroutine[Any, Any, None]:
        return serve_replays([RecordedPage(RunFolder(run)) for run in options.runs], effective.hmi, common.say)

    return 130 if run_until_interrupted(replayed) else 0


async def _watch(options: argparse.Namespace, settings: "Settings") -> None:
    from coldloop_hmi.runtime import serve
    from coldloop_hmi.settings import HmiSettings
    from coldloop_rig.live.started_rigs import make_own_folder
    from coldloop_rig.live.up import pointed_at, with_own_files

    pointed = pointed_at(settings.hmi, common.rig_endpoints(options, settings))
    section, login = with_own_files(pointed, make_own_folder(f"page-{pointed.port}"))
    common.say(f"http{'s' if section.https else ''}://{section.host}:{section.port}/")
    if login is not None:
        common.say(login.line.strip())
    await serve(HmiSettings(model=settings.model, hmi=section))


COMMANDS: Final = {
    "up": common.Command(_declare_up, execute_up),
    "down": common.Command(common.add_rig_options, execute_down),
    "status": common.Command(_declare_status, execute_status),
    "set": common.Command(_declare_set, execute_set),
    "fault": common.Command(_declare_fault, execute_fault),
    "page": common.Command(_declare_page, execute_page),
}
