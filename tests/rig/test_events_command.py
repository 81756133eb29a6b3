"""`coldloop events`: the journal of a service that runs, whole or in part, as lines or as CSV."""

import asyncio
import csv
import signal
import socket
import subprocess
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer, ServerSettings
from coldloop.modbus.settings import AccessSettings, TlsSettings
from coldloop.operating.observer import JournalReader
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.common import AlarmKind, Event, EventKind, Identity, JournalQuery
from coldloop.registers.control_plc import Mode
from coldloop.registers.declaration import Block, RegisterMap
from coldloop.service.journal import KEPT, Journal, JournalPublication
from coldloop_rig.cli.commands.rig import COLUMNS
from tests.harness.processes import Processes
from tests.harness.records import CONTROL_MAP, PLANT_MAP

if TYPE_CHECKING:
    from tests.conftest import Coldloop

USAGE, FAILURE = 2, 1
NO_OPERATORS = AccessSettings(operator=())
START = 1_700_000_000.0
"""2023-11-14T22:13:20Z; each event is a second later."""


class Service:
    """A server with a journal, in this event loop."""

    def __init__(self, register_map: RegisterMap = CONTROL_MAP, **settings: Any) -> None:  # noqa: ANN401 ServerSettings
        self.bank = RegisterBank(register_map)
        self.bank.put(Identity(map_digest=register_map.digest, map_version=register_map.version))
        self.journal = Journal(now=lambda: START + self.journal.count)
        self.publication = JournalPublication(self.journal, self.bank)
        self.queries = 0
        self.server = ModbusServer(
            self.bank, settings=ServerSettings(**{"port": 0, **settings}), on_write=self.on_write,
            identity=DeviceIdentity(product="test", revision="0"),
        )  # fmt: skip

    def on_write(self, block: Block, _: Caller) -> Awaitable[None] | None:
        if block.record is JournalQuery:
            self.queries += 1
            self.publication.answer(self.bank.get(JournalQuery))
        return None

    def fill(self, events: int) -> None:
        """Note events: each third is an alarm."""
        for _ in range(events):
            number = self.journal.count + 1
            if number % 3:
                self.journal.note(4 * number, EventKind.MODE, Mode.CLASSICAL, 5)
            else:
                self.journal.note(4 * number, EventKind.ALARM_RAISED, AlarmKind.SENSOR_BAD, 6, who="10.0.0.5:1 =op")
        self.publication.show()


Serve = Callable[..., AbstractContextManager[Service]]


@pytest.fixture
def serve() -> Serve:
    """Serve a journal in a thread, as the command has an event loop of its own."""

    @contextmanager
    def serving(events: int, register_map: RegisterMap = CONTROL_MAP, **settings: Any) -> Iterator[Service]:  # noqa: ANN401
        service = Service(register_map, **settings)
        service.fill(events)
        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_forever)
        thread.start()
        try:
            asyncio.run_coroutine_threadsafe(service.server.start(), loop).result(60)
            yield service
        finally:
            asyncio.run_coroutine_threadsafe(service.server.close(), loop).result(60)
            loop.call_soon_threadsafe(loop.stop)
            thread.join(60)
            loop.close()

    return serving


def at(service: Service) -> str:
    return f"127.0.0.1:{service.server.port}"


def numbers(out: str) -> list[int]:
    return [int(line.split()[0]) for line in out.splitlines()]


# -- lines -------------------------------------------------------------------------------------------------------------


def test_each_event_is_a_line_in_plain_words(coldloop: "Coldloop", serve: Serve) -> None:
    with serve(4) as service:
        outcome = coldloop("events", at(service))
    assert (outcome.code, outcome.complaints) == (0, [])
    assert outcome.out.splitlines()[1:3] == [
        "      2  2023-11-14T22:13:22.000Z  boot 1  tick 8 (2.00 s)  mode: classical (hold expired)",
        "      3  2023-11-14T22:13:23.000Z  boot 1  tick 12 (3.00 s)  alarm raised: sensor bad (T5), by 10.0.0.5:1 =op",
    ]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], range(1, 21)),
        (["--since", "15"], range(15, 21)),
        (["--since", "2023-11-14T22:13:35"], range(15, 21)),
        (["--since", "2023-11-15T00:13:34.500+02:00"], range(15, 21)),
        (["--since", "21"], []),
        (["--kind", "alarm-raised"], range(3, 21, 3)),
        (["--kind", "alarm raised, LEASE"], range(3, 21, 3)),
        (["--kind", "alarm_raised,mode", "--since", "19"], [19, 20]),
        (["--kind", "lease"], []),
    ],
)
def test_kind_and_since_select(
    coldloop: "Coldloop", serve: Serve, options: list[str], expected: list[int] | range
) -> None:
    with serve(20) as service:
        outcome = coldloop("events", at(service), *options)
    assert (outcome.code, outcome.complaints) == (0, [])
    assert numbers(outcome.out) == list(expected)


def test_a_client_without_the_role_reads_the_last_256_events_and_says_so(coldloop: "Coldloop", serve: Serve) -> None:
    with serve(300, access=NO_OPERATORS) as service:
        where = at(service)
        outcome = coldloop("events", where)
        some = coldloop("events", where, "--since", "299")
    assert numbers(outcome.out) == list(range(45, 301))
    assert outcome.complaints == [
        f"coldloop: no operator role at control_plc at {where}: only its last 256 events can be read"
    ]
    assert numbers(some.out) == [299, 300]


def test_the_journal_of_another_service_is_read_by_its_own_map(coldloop: "Coldloop", serve: Serve) -> None:
    with serve(2, PLANT_MAP) as service:
        assert numbers(coldloop("events", at(service), "--service", "plant").out) == [1, 2]
        outcome = coldloop("events", at(service))
    assert outcome.code == FAILURE
    (complaint,) = outcome.complaints
    assert "has another register map" in complaint


def test_over_tls_the_certificate_decides(coldloop: "Coldloop", serve: Serve, tmp_path: Path) -> None:
    site = tmp_path / "site"
    assert coldloop("certificates", "--out", site).code == 0
    tls = TlsSettings(certificate=site / "control_plc.crt", key=site / "control_plc.key", ca=site / "ca.crt")
    reader = [f'--set=rig.tls.{name}="{site / file}"' for name, file in
              (("certificate", "reader.crt"), ("key", "reader.key"), ("ca", "ca.crt"))]  # fmt: skip
    with serve(5, tls=tls) as service:
        operator = coldloop("events", at(service), "--config", site / "tls.toml")
        other = coldloop("events", at(service), *reader)
        plain = coldloop("events", at(service))
    assert (numbers(operator.out), operator.complaints) == ([1, 2, 3, 4, 5], [])
    assert numbers(other.out) == [1, 2, 3, 4, 5]
    assert len(other.complaints) == 1
    assert (plain.code, len(plain.complaints)) == (FAILURE, 1)


def test_follow_goes_on_with_new_events_until_it_is_interrupted(serve: Serve, processes: Processes) -> None:
    with serve(2) as service:
        pipe = subprocess.PIPE
        process = processes.coldloop("events", at(service), "--follow", stdout=pipe, stderr=pipe)
        assert process.popen.stdout is not None
        seen = [process.popen.stdout.readline(), process.popen.stdout.readline()]
        service.fill(1)
        seen.append(process.popen.stdout.readline())
        process.popen.send_signal(signal.SIGINT)
        assert process.ended() == (0, "", "")
    assert numbers("".join(seen)) == [1, 2, 3]


# -- CSV ---------------------------------------------------------------------------------------------------------------


def test_the_csv_file_has_a_header_and_a_row_for_each_event(coldloop: "Coldloop", serve: Serve, tmp_path: Path) -> None:
    file = tmp_path / "events.csv"
    with serve(3) as service:
        service.journal.note(20, EventKind.ALARM_SHELVED, AlarmKind.SECOND_BAND, 1, value=900.0)
        outcome = coldloop("events", at(service), "--csv", file)
    assert (outcome.code, outcome.out) == (0, f"4 events in {file}\n")
    with file.open(newline="", encoding="utf-8") as text:
        rows = list(csv.reader(text))
    assert tuple(rows[0]) == COLUMNS
    assert rows[3] == ["3", "1", "2023-11-14T22:13:23.000Z", "12", "3.00", "alarm raised", "sensor bad", "T5", "",
                       "10.0.0.5:1 =op"]  # fmt: skip
    assert rows[4] == ["4", "1", "2023-11-14T22:13:24.000Z", "20", "5.00", "alarm shelved", "t5 band", "", "900", ""]


def test_a_file_that_exists_is_overwritten_only_by_force(coldloop: "Coldloop", serve: Serve, tmp_path: Path) -> None:
    file = tmp_path / "events.csv"
    file.write_text("precious")
    with serve(3) as service:
        outcome = coldloop("events", at(service), "--csv", file)
        assert (outcome.code, len(outcome.complaints)) == (USAGE, 1)
        assert file.read_text() == "precious"
        assert service.queries == 0
        assert coldloop("events", at(service), "--csv", file, "--force").code == 0
    assert len(file.read_text().splitlines()) == 4


@pytest.mark.parametrize("target", ["/dev/full", "{}", "{}/absent/events.csv"])
def test_a_file_that_cannot_be_written_is_told_in_one_line(
    coldloop: "Coldloop", serve: Serve, tmp_path: Path, target: str
) -> None:
    with serve(3) as service:
        outcome = coldloop("events", at(service), "--csv", target.format(tmp_path))
    assert (outcome.code, outcome.out) == (FAILURE, "")
    (complaint,) = outcome.complaints
    assert "choose another --csv" in complaint


# -- errors ------------------------------------------------------------------------------------------------------------


def test_nobody_there_is_told_in_one_line_and_no_file_is_made(coldloop: "Coldloop", tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as held:
        port = held.getsockname()[1]
    outcome = coldloop("events", f"127.0.0.1:{port}", "--csv", tmp_path / "events.csv")
    assert outcome.code == FAILURE
    (complaint,) = outcome.complaints
    assert "nothing listens" in complaint
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["127.0.0.1:1", "--port-base", "5020"], "give one of them"),
        (["localhost"], "'localhost' is not HOST:PORT"),
        (["127.0.0.1:1", "--kind", "alarms"], "unknown kind 'alarms'; choose from mode, alarm-raised, "),
        (["127.0.0.1:1", "--since", "yesterday"], "'yesterday' is neither the number of an event nor a time"),
        (["127.0.0.1:1", "--since", "0"], "'0' is neither"),
        (["127.0.0.1:1", "--service", "broker"], "invalid choice: 'broker'"),
    ],
)
def test_what_is_asked_for_wrongly_is_told_in_one_line(
    coldloop: "Coldloop", arguments: list[str], message: str
) -> None:
    outcome = coldloop("events", *arguments)
    assert outcome.code == USAGE
    (complaint,) = outcome.complaints
    assert message in complaint


# -- the reader --------------------------------------------------------------------------------------------------------


def reader_of(service: Service, first: int = 1) -> JournalReader:
    return JournalReader(RegisterClient(CONTROL_MAP, host="127.0.0.1", port=service.server.port, timeout_s=60.0), first)


@pytest.mark.parametrize("access", [AccessSettings(), NO_OPERATORS], ids=["operator", "reader"])
async def test_events_are_read_once_however_they_come(access: AccessSettings) -> None:
    service = Service(access=access)
    await service.server.start()
    reader = reader_of(service)
    read: list[Event] = []
    for burst in (0, 1, 5, 0, 250, 100, 256):
        service.fill(burst)
        read += await reader.read_on()
    assert [event.number for event in read] == list(range(1, 613))
    assert read == service.journal.since(0)
    assert not reader.missed
    assert reader.limited is (access is NO_OPERATORS)
    await service.server.close()


@pytest.mark.parametrize(
    ("access", "kept"), [(AccessSettings(), KEPT), (NO_OPERATORS, 256)], ids=["operator", "reader"]
)
async def test_events_that_were_dropped_before_they_could_be_read_are_counted(
    access: AccessSettings, kept: int
) -> None:
    service = Service(access=access)
    await service.server.start()
    service.fill(10)
    reader = reader_of(service, first=9)
    assert [event.number for event in await reader.read_on()] == [9, 10]
    service.fill(kept + 7)
    events = await reader.read_on()
    assert (events[0].number, len(events), reader.missed) == (18, kept, 7)
    await service.server.close()


async def test_a_service_that_begins_to_number_anew_is_read_from_its_first_event() -> None:
    service = Service()
    await service.server.start()
    service.fill(10)
    reader = reader_of(service)
    await reader.read_on()
    service.journal = Journal(boot=2)
    service.publication = JournalPublication(service.journal, service.bank)
    service.fill(3)
    events = await reader.read_on()
    assert [(event.number, event.boot) for event in events] == [(1, 2), (2, 2), (3, 2)]
    assert reader.restarted
    await service.server.close()
