"""Commands about a rig that stays up, and about what is on the bus: journals, links, certificates, registers."""

import argparse
import asyncio
import contextlib
import csv
import re
import signal
import sys
from collections.abc import Coroutine, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TextIO

from coldloop import errors
from coldloop.process.updating_periods import LONGEST_TICKS
from coldloop.service import add_configuration_options
from coldloop_rig.cli.commands import options as common
from coldloop_rig.interruption import run_until_interrupted
from coldloop_rig.text_tables import coloured, cut, fitted, width

if TYPE_CHECKING:
    from coldloop.modbus.settings import Endpoint
    from coldloop.process.declaration import Process
    from coldloop.registers.common import Event
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
    from coldloop_rig.live import started_rigs, up
    from coldloop_rig.runs.running import check_certificates, remarks

    effective = common.configuration(options)
    common.refuse_ineffective(effective, "give --port-base")
    check_certificates(effective.settings)
    told = [] if options.without else remarks(effective)
    optimizer = common.exported(options.optimizer, effective.settings)
    ports = started_rigs.ports_from(options.port_base)
    lock = started_rigs.lock_rig(ports[0], options.locked)
    started_rigs.check_ports(ports)
    page = options.page or options.page_port is not None
    if page:
        from coldloop_rig.live.up import check_page

        check_page(effective.settings.hmi)
    if options.detach and options.locked is None:
        return started_rigs.detached(ports, lock)
    from coldloop_rig.cosim.wiring import REQUIRED, SERVICES

    for line in told:
        common.tell(line)
    services = REQUIRED if options.without else SERVICES
    rig = up.UpRig(effective.settings, ports, options.tls, page=page, cuttable=options.cuttable, services=services,
                optimizer=optimizer)  # fmt: skip
    run_until_interrupted(lambda: rig.run(announce=not options.quiet))
    return 0


_declare_down = common.add_rig_options


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
    load.add_argument("--at", type=_tick_at, default=0, metavar="SECONDS",
                      help="plant time at which it begins (default: now)")  # fmt: skip
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
    for word in ("pause", "resume"):
        document = {"kind": "pause", "paused": word == "pause"}
        what.add_parser(word, help=f"{word} plant time").set_defaults(document=lambda _, given=document: given)
    acknowledge = what.add_parser("acknowledge", help="an alarm, or all")
    acknowledge.add_argument("alarm", nargs="?", metavar="ALARM", help="such as mode (default: all)")
    acknowledge.set_defaults(document=_acknowledgement)
    for each in what.choices.values():  # these options are accepted before and after a subcommand
        common.add_rig_options(each, again=True)


def _unit(process: "Process") -> str:
    return {"W": "watts"}.get(process.load.unit, process.load.unit)


def _tick_at(text: str) -> int:
    from coldloop.process.settings import settings_process

    tick_s = settings_process().tick_s
    ticks = common.ticks_of(text, tick_s)
    if not 0 <= ticks < LONGEST_TICKS:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of seconds in multiples of {tick_s:g}")
    return ticks


def execute_set(options: argparse.Namespace) -> int:
    """An operator's commands to a rig that is up.

    Each is a Modbus request that any client with the operator's role can make; the answer is read back and shown.
    """
    return 130 if run_until_interrupted(lambda: _send(options)) else 0


async def _send(options: argparse.Namespace) -> None:
    from coldloop.operating import commands, execution
    from coldloop.process.load_profile import read_load_file
    from coldloop_rig.live.status import ask

    settings = common.operator_settings(options)
    process, limits, document = settings.process, settings.limits, options.document(options)
    services: tuple[str, ...] = ("plant",)
    if document is None:  # a load file, which is written without a time limit
        load = read_load_file(Path(options.new_load), process)
        work: Work = partial(execution.stream_load, load=load, tick=options.at, say=common.tell)
    else:
        command = commands.read_command(document, process)
        if isinstance(command, commands.SetSetpoint):
            execution.check_bounds(command, limits.low[command.place], limits.high[command.place])
        (services, execute), work = execution.WORK[type(command)], lambda clients: execute(clients, command)
    there = common.rig_services(options)
    concerned = [service for service in services if service in there]
    endpoints = common.rig_endpoints(options, settings)
    text = await ask(endpoints, process, concerned, work, limited=document is not None)
    sys.stdout.write(f"{text}\n")


def _load(options: argparse.Namespace) -> dict[str, object] | None:
    """Return the command; None for a load file."""
    from coldloop.process.settings import settings_process

    try:
        return {"kind": "load", "watts": float(options.new_load), "tick": options.at}
    except ValueError:
        if not Path(options.new_load).is_file():
            unit = _unit(settings_process())
            raise errors.UsageError(f"load '{options.new_load}': neither {unit} nor a file") from None
        return None


def _acknowledgement(options: argparse.Namespace) -> dict[str, object]:
    from coldloop.process.settings import settings_process
    from coldloop.registers.common import ALL_ALARMS, AlarmAction, alarms_of
    from coldloop.service.journal import alarm_word

    process = settings_process()
    kinds = {alarm_word(alarm, process).replace(" ", "-"): alarm for alarm in alarms_of(process)}
    if options.alarm is not None and options.alarm not in kinds:
        raise errors.UsageError(f"unknown alarm '{options.alarm}'; choose from {', '.join(kinds)}")
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
    real_time = partial(common.positive_number, 3600.0, "a number of seconds up to 3600")
    pause = what.add_parser("pause", help="suspend a service for a while")
    pause.add_argument("service", choices=SERVICES, metavar="|".join(SERVICES))
    pause.add_argument("seconds", type=real_time, help="duration in real time")
    pause.set_defaults(fault=_pause)
    cut = what.add_parser("cut", help="cut a link for a while; needs a rig started with `up --cuttable`")
    cut.add_argument("link", choices=LINKS, metavar="|".join(LINKS), help="control PLC to plant, or optimiser to it")
    cut.add_argument("seconds", type=real_time, help="duration in real time")
    cut.set_defaults(fault=_cut)
    sensor = what.add_parser("sensor", help="make a sensor fail: not a number, frozen, or a given value")
    sensor.add_argument("output", metavar="OUTPUT", help="its name")
    sensor.add_argument("shows", metavar="dead|stuck|VALUE|none", help="none ends the fault")
    sensor.set_defaults(fault=_send, document=_sensor_fault)
    for each in what.choices.values():
        common.add_rig_options(each, again=True)


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


def _sensor_fault(options: argparse.Namespace) -> dict[str, object]:
    from coldloop.process.settings import settings_process

    names, shows = settings_process().output_names, options.shows
    if options.output not in names:
        raise errors.UsageError(f"unknown output '{options.output}'; choose from {', '.join(names)}")
    try:
        shown = {"fault": SENSOR_FAULTS[shows]} if shows in SENSOR_FAULTS else {"fault": 3, "value": float(shows)}
    except ValueError:
        raise errors.UsageError(f"'{shows}': a sensor shows {', '.join(SENSOR_FAULTS)}, or a value") from None
    return {"kind": "sensor_fault", "output": options.output, **shown}


def _declare_page(parser: argparse.ArgumentParser) -> None:
    common.add_rig_options(parser)
    parser.add_argument("runs", nargs="*", type="folder", metavar="RUN",
                        help="folder of a recorded run; two: side by side; none: a rig that is up")  # fmt: skip
    parser.add_argument("--page-port", type=int, metavar="PORT", help="port of the page (default: 8020)")


def execute_page(options: argparse.Namespace) -> int:
    """The operator's page of a rig that is up, or of recorded runs."""
    if len(options.runs) > 2:
        raise errors.UsageError(f"{len(options.runs)} runs: one is replayed, or two side by side")
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
    if login:
        common.say(login.strip())
    await serve(HmiSettings(model=settings.model, hmi=section))


COLUMNS: Final = ("number", "boot", "utc", "tick", "plant_time_s", "kind", "subject", "cause", "value", "who")


def _declare_events(parser: argparse.ArgumentParser) -> None:
    common.add_rig_options(parser)
    parser.add_argument("endpoint", nargs="?", type=common.endpoint, metavar="HOST:PORT",
                        help="where the service is, of a rig that is not up here")  # fmt: skip
    parser.add_argument("--service", choices=common.SERVICES, default="control_plc", help="default: control_plc")
    parser.add_argument("--kind", type=_kinds, default=(), metavar="KIND,...",
                        help="only events of these kinds, such as alarm-raised,mode")  # fmt: skip
    parser.add_argument("--since", type=_since, default=(1, 0.0), metavar="NUMBER|TIME",
                        help="from this event on, or from this time (UTC, such as 2026-11-22T01:30)")  # fmt: skip
    parser.add_argument("--follow", action="store_true", help="print new events until interrupted")
    parser.add_argument("--csv", type="write", metavar="FILE", help="write a CSV file instead of lines")
    parser.add_argument("--force", action="store_true", help="overwrite that file")


def _kinds(text: str) -> tuple[int, ...]:
    from coldloop.registers.common import EventKind

    known = {kind.name.lower().replace("_", "-"): kind for kind in EventKind if kind}
    try:
        return tuple(known[name.strip().lower().replace("_", "-").replace(" ", "-")] for name in text.split(","))
    except KeyError as error:
        raise argparse.ArgumentTypeError(f"unknown kind {error}; choose from {', '.join(known)}") from None


def _since(text: str) -> tuple[int, float]:
    """Return the number of an event and a time (s since 1970) from which on the journal is read."""
    if text.isdecimal() and 0 < int(text) < 2**32:
        return int(text), 0.0
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"'{text}' is neither the number of an event nor a time such as 2026-11-22T01:30"
        ) from None
    return 1, (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def execute_events(options: argparse.Namespace) -> int:
    """The journal of a running service: what happened, when, and who did it."""
    if options.csv is not None and options.csv.is_file() and not options.force:
        raise errors.UsageError(f"{options.csv} exists: name another file with --csv, or overwrite it with --force")
    interrupted = run_until_interrupted(lambda: _show_journal(options))
    return 130 if interrupted and not options.follow else 0  # that is how --follow ends


async def _show_journal(options: argparse.Namespace) -> None:
    from coldloop.modbus.client import RegisterClient
    from coldloop.operating.observer import JournalReader
    from coldloop.registers import maps_of

    settings = common.operator_settings(options)
    process = settings.process
    if options.endpoint is not None and (options.rig or options.port_base):
        raise errors.UsageError("HOST:PORT, --rig and --port-base: give one of them")
    if options.endpoint is not None:
        options.rig = [options.endpoint] * len(common.SERVICES)
    place: Endpoint = getattr(common.rig_endpoints(options, settings), options.service)
    client = RegisterClient.at(maps_of(process).by_service[options.service], place)
    peer = client.peer
    first, since = options.since
    reader = JournalReader(client, first, options.kind)
    file = _CsvFile(options.csv, process) if options.csv else None
    write = partial(_print_events, process) if file is None else file.write
    warned: set[str] = set()
    try:
        await client.connect(0)
        while True:
            events = await reader.read_on()
            for happened, warning in (
                (reader.limited, f"no operator role at {peer}: only its last 256 events can be read"),
                (reader.missed, f"{reader.missed} events are no longer kept"),
                (reader.restarted, f"{peer} was restarted, and numbers its events from 1 again: it retains no state"),
            ):
                if happened and warning not in warned:
                    warned.add(warning)
                    sys.stderr.write(f"coldloop: {warning}\n")
            write([event for event in events if event.utc + event.milliseconds / 1000 >= since])
            if not options.follow:
                return
            await asyncio.sleep(1.0)
    finally:
        client.close()
        if file is not None:
            file.close()


def _print_events(process: "Process", events: "Sequence[Event]") -> None:
    from coldloop.service.journal import describe, utc_text

    for event in events:
        sys.stdout.write(
            f"{event.number:>7}  {utc_text(event)}  boot {event.boot}  tick {event.tick} "
            f"({event.tick * process.tick_s:.2f} s)  {describe(event, process).sentence}\n"
        )
    sys.stdout.flush()


class _CsvFile:
    """Writes a CSV file, which appears with the first events."""

    def __init__(self, path: Path, process: "Process") -> None:
        self._path, self._process = path, process
        self._file: TextIO | None = None
        self._events = 0

    def write(self, events: "Sequence[Event]") -> None:
        from coldloop.service.journal import describe, utc_text

        present = self._path.exists()
        texts = [describe(event, self._process) for event in events]
        rows = [
            (event.number, event.boot, utc_text(event), event.tick, f"{event.tick * self._process.tick_s:.2f}",
             text.kind, text.subject, text.cause, text.value, text.who)
            for event, text in zip(events, texts, strict=True)
        ]  # fmt: skip
        try:
            if self._file is None:
                self._file = self._path.open("w", encoding="utf-8", newline="")
                csv.writer(self._file, lineterminator="\n").writerow(COLUMNS)
            csv.writer(self._file, lineterminator="\n").writerows(rows)
            self._file.flush()
        except OSError as error:
            with contextlib.suppress(OSError):  # without what could not be written
                if self._file is not None:
                    self._file.close()
            self._file = None
            if not present:
                self._path.unlink(missing_ok=True)
            raise errors.ResultsError(f"{self._path}: {error.strerror}; choose another --csv") from None
        self._events += len(events)

    def close(self) -> None:
        """Close the file, and say what is in it."""
        if self._file is not None:
            self._file.close()
            sys.stdout.write(f"{self._events} events in {self._path}\n")


def _declare_certificates(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type="into", required=True, metavar="DIR", help="folder for the files")
    parser.add_argument("--host", dest="hosts", action="append", default=[], type=_host, metavar="NAME",
                        help="another name or address of the servers, besides localhost; may be repeated")  # fmt: skip
    days = partial(common.number_within, least=1, most=3650, what="a number of days from 1 to 3650")
    parser.add_argument("--days", type=days, default=365, help="days until they expire (default: 365)")
    parser.add_argument("--revoke", action="append", default=[], metavar="NAME",
                        help="revoke a certificate in the folder, such as operator; may be repeated")  # fmt: skip
    parser.add_argument("--renew-list", action="store_true", help="renew the list of revoked certificates")


def _host(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.:_-]{0,251}[A-Za-z0-9])?|::1?", text):
        raise argparse.ArgumentTypeError(f"'{text}' is not a host name or an address")
    return text


def execute_certificates(options: argparse.Namespace) -> int:
    """Certificates for Modbus/TCP Security on a test site, and configuration for them.

    It also revokes certificates that it has made, by the list of revocations that the configuration names.
    """
    from coldloop_rig.cli.certificates import revoke, write_site

    if options.revoke or options.renew_list:
        if options.hosts:
            raise errors.UsageError(
                f"--host {options.hosts[0]}: has no effect on a list of revoked certificates; for another host make "
                "certificates in another folder"
            )
        count, file = revoke(options.out, options.revoke, options.days)
        sys.stdout.write(f"{count} revoked in {file}; restart the services that use it\n")
        return 0
    count, file = write_site(options.out, options.hosts, options.days)
    sys.stdout.write(f"{count} certificates and their keys in {options.out}; use them with --config {file}\n")
    return 0


def _declare_registers(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--format", choices=(*common.REGISTER_FORMATS, *common.TAG_FORMATS), default="table",
                        help="fuxa, grafana, ignition, node-red, telegraf: files for these programs")  # fmt: skip
    parser.add_argument("--service", choices=common.SERVICES, help="default: all")
    parser.add_argument("--host", default="127.0.0.1", help="where these programs find the rig (default: 127.0.0.1)")
    parser.add_argument("--port-base", type=common.port_base, metavar="PORT", help="first of three consecutive ports")


def execute_registers(options: argparse.Namespace) -> int:
    """The register maps, as a table, Markdown, CSV or JSON, or as files of other programs."""
    from coldloop.process.settings import settings_process
    from coldloop.registers import maps_of
    from coldloop_rig.cli.registers import EXPORTS, FORMATS

    every = maps_of(settings_process()).by_service
    maps = [every[options.service]] if options.service else list(every.values())
    if options.format in FORMATS:
        sys.stdout.write(FORMATS[options.format](maps))
        return 0
    from coldloop_rig.cosim.wiring import SERVICES as IN_ORDER
    from coldloop_rig.live.started_rigs import ports_from

    ports = ports_from(options.port_base)
    places = {service: common.HostPort(options.host, port) for service, port in zip(IN_ORDER, ports, strict=True)}
    sys.stdout.write(EXPORTS[options.format](maps, places))
    return 0
