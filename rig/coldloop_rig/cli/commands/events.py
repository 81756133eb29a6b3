"""`coldloop events`: the journal of a running service: what happened, when, and who did it."""

import argparse
import asyncio
import contextlib
import csv
import sys
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TextIO

from coldloop.errors import ResultsError, UsageError
from coldloop_rig.cli.commands.choices import SERVICES
from coldloop_rig.cli.commands.options import add_rig_options, endpoint, operator_settings, rig_endpoints

if TYPE_CHECKING:
    from coldloop.modbus.endpoints import Endpoint
    from coldloop.operating.observer import JournalReader
    from coldloop.process.declaration import Process
    from coldloop.registers.audit import Event

COLUMNS: Final = ("number", "boot", "utc", "tick", "plant_time_s", "kind", "subject", "cause", "value", "who")
INTERRUPTED: Final = 130
LOOK_AGAIN_S: Final = 1.0
"""With --follow: time between two looks at the journal."""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_rig_options(parser)
    parser.add_argument("endpoint", nargs="?", type=endpoint, metavar="HOST:PORT",
                        help="where the service is, of a rig that is not up here")  # fmt: skip
    parser.add_argument("--service", choices=SERVICES, default="control_plc", help="default: control_plc")
    parser.add_argument("--kind", type=_kinds, default=(), metavar="KIND,...",
                        help="only events of these kinds, such as alarm-raised,mode")  # fmt: skip
    parser.add_argument("--since", type=_since, default=Since(1, 0.0), metavar="NUMBER|TIME",
                        help="from this event on, or from this time (UTC, such as 2026-11-22T01:30)")  # fmt: skip
    parser.add_argument("--follow", action="store_true", help="print new events until interrupted")
    parser.add_argument("--csv", type="write", metavar="FILE", help="write a CSV file instead of lines")
    parser.add_argument("--force", action="store_true", help="overwrite that file")


class Since(NamedTuple):
    """From where on the journal is read."""

    number: int
    utc: float
    """Seconds since 1970."""


def _kinds(text: str) -> tuple[int, ...]:
    from coldloop.registers.audit import EventKind

    known = {kind.name.lower().replace("_", "-"): kind for kind in EventKind if kind}
    try:
        return tuple(known[name.strip().lower().replace("_", "-").replace(" ", "-")] for name in text.split(","))
    except KeyError as error:
        raise argparse.ArgumentTypeError(f"unknown kind {error}; choose from {', '.join(known)}") from None


def _since(text: str) -> Since:
    if text.isdecimal() and 0 < int(text) < 2**32:
        return Since(int(text), 0.0)
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"'{text}' is neither the number of an event nor a time such as 2026-11-22T01:30"
        ) from None
    return Since(1, (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp())


def execute(options: argparse.Namespace) -> int:
    """Show the journal, or write it into a file."""
    if options.csv is not None and options.csv.is_file() and not options.force:
        raise UsageError(f"{options.csv} exists: name another file with --csv, or overwrite it with --force")
    from coldloop_rig.until_interrupted import run_until_interrupted

    interrupted = run_until_interrupted(lambda: _show(options))
    return INTERRUPTED if interrupted and not options.follow else 0  # that is how --follow ends


async def _show(options: argparse.Namespace) -> None:
    from coldloop.modbus.client import RegisterClient
    from coldloop.operating.observer import JournalReader
    from coldloop.registers.maps import maps_of

    process, place = _place(options)
    client = RegisterClient.at(maps_of(process).by_service[options.service], place)
    reader = JournalReader(client, options.since.number, options.kind)
    output = _CsvFile(options.csv, process) if options.csv else _Lines(process)
    try:
        await client.connect(0)
        await _copy(reader, options, output, client.peer)
    finally:
        client.close()
        output.close()


def _place(options: argparse.Namespace) -> "tuple[Process, Endpoint]":
    """Return the process, and the endpoint of the service whose journal is read."""
    settings = operator_settings(options)
    if options.endpoint is not None and (options.rig or options.port_base):
        raise UsageError("HOST:PORT, --rig and --port-base: give one of them")
    if options.endpoint is not None:
        options.rig = [options.endpoint] * len(SERVICES)
    place: Endpoint = getattr(rig_endpoints(options, settings), options.service)
    return settings.process, place


async def _copy(reader: "JournalReader", options: argparse.Namespace, output: "_Lines | _CsvFile", peer: str) -> None:
    """Read once, or again and again, and say what cannot be read."""
    warned: set[str] = set()
    while True:
        events = await reader.read_on()
        for warning in _warnings(reader, peer):
            if warning not in warned:
                warned.add(warning)
                sys.stderr.write(f"coldloop: {warning}\n")
        output.write([event for event in events if event.utc + event.milliseconds / 1000 >= options.since.utc])
        if not options.follow:
            return
        await asyncio.sleep(LOOK_AGAIN_S)


def _warnings(reader: "JournalReader", peer: str) -> Iterator[str]:
    if reader.limited:
        yield f"no operator role at {peer}: only its last 256 events can be read"
    if reader.missed:
        yield f"{reader.missed} events are no longer kept"
    if reader.restarted:
        yield f"{peer} was restarted, and numbers its events from 1 again: it retains no state"


class _Lines:
    """Writes one line an event to standard output."""

    def __init__(self, process: "Process") -> None:
        self._process = process

    def write(self, events: "Sequence[Event]") -> None:
        from coldloop.service.event_text import describe, utc_text

        for event in events:
            sys.stdout.write(
                f"{event.number:>7}  {utc_text(event)}  boot {event.boot}  tick {event.tick} "
                f"({event.tick * self._process.tick_s:.2f} s)  {describe(event, self._process).sentence}\n"
            )
        sys.stdout.flush()

    def close(self) -> None:
        pass


class _CsvFile:
    """Writes a CSV file, which appears with the first events."""

    def __init__(self, path: Path, process: "Process") -> None:
        self._path, self._process = path, process
        self._file: TextIO | None = None
        self._events = 0

    def write(self, events: "Sequence[Event]") -> None:
        """Append events."""
        present = self._path.exists()
        try:
            if self._file is None:
                self._file = self._path.open("w", encoding="utf-8", newline="")
                csv.writer(self._file, lineterminator="\n").writerow(COLUMNS)
            csv.writer(self._file, lineterminator="\n").writerows(_cells(event, self._process) for event in events)
            self._file.flush()
        except OSError as error:
            self._give_up(remove=not present)
            raise ResultsError(f"{self._path}: {error.strerror}; choose another --csv") from None
        self._events += len(events)

    def _give_up(self, *, remove: bool) -> None:
        """Close the file without what could not be written."""
        with contextlib.suppress(OSError):
            if self._file is not None:
                self._file.close()
        self._file = None
        if remove:
            self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file, and say what is in it."""
        if self._file is not None:
            self._file.close()
            sys.stdout.write(f"{self._events} events in {self._path}\n")


def _cells(event: "Event", process: "Process") -> list[str]:
    from coldloop.service.event_text import describe, utc_text

    text = describe(event, process)
    time = f"{event.tick * process.tick_s:.2f}"
    return [
        str(event.number), str(event.boot), utc_text(event), str(event.tick), time, text.kind, text.subject, text.cause,
        text.value, text.who,
    ]  # fmt: skip
