"""Commands about what is on the bus: journals, links, certificates, registers."""

import argparse
import asyncio
import contextlib
import csv
import re
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO

from coldloop.errors import ResultsError, UsageError
from coldloop_rig.cli.commands import options as common
from coldloop_rig.interruption import run_until_interrupted

if TYPE_CHECKING:
    from coldloop.modbus.settings import Endpoint
    from coldloop.process.declaration import Process
    from coldloop.registers.common import Event


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
        raise UsageError(f"{options.csv} exists: name another file with --csv, or overwrite it with --force")
    interrupted = run_until_interrupted(lambda: _show_journal(options))
    return 130 if interrupted and not options.follow else 0  # that is how --follow ends


async def _show_journal(options: argparse.Namespace) -> None:
    from coldloop.modbus.client import RegisterClient
    from coldloop.operating.observer import JournalReader
    from coldloop.registers import maps_of

    settings = common.operator_settings(options)
    process = settings.process
    if options.endpoint is not None and (options.rig or options.port_base):
        raise UsageError("HOST:PORT, --rig and --port-base: give one of them")
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
            raise ResultsError(f"{self._path}: {error.strerror}; choose another --csv") from None
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
            raise UsageError(
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
