"""Rigs that lie, or are hostile: commands say so in one line, and do nothing that they are told to do."""

import asyncio
import hashlib
import os
import random
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import coldloop_control_plc.settings
import coldloop_optimizer_plc.settings
import coldloop_plant.settings
from coldloop.config import selected
from coldloop.modbus.server import DeviceIdentity, ModbusServer, ServerSettings
from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import to_words
from coldloop.registers.common import (
    LINE_CHARACTERS,
    LINE_WORDS,
    MAGIC,
    ConfigurationDigest,
    ConfigurationLine,
    Identity,
    JournalAnswer,
    JournalPage,
    SessionPace,
    publish_configuration,
)
from coldloop.registers.control_plc import LadderStatus, Operator
from coldloop.registers.plant import LoadStatus
from coldloop_plant.kinds import own_header
from coldloop_rig.cosim.wiring import SERVICES
from coldloop_rig.settings import Settings
from coldloop_rig.testing import BackgroundLoop
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP

if TYPE_CHECKING:
    from tests.conftest import Coldloop, Outcome

MAPS = dict(zip(SERVICES, (PLANT_MAP, CONTROL_MAP, OPTIMIZER_MAP), strict=True))
SHOWN = {
    "plant": coldloop_plant.settings.SHOWN,
    "control_plc": coldloop_control_plc.settings.SHOWN,
    "optimizer_plc": coldloop_optimizer_plc.settings.SHOWN,
}
NUMBERS = {"u16": 0xFFFF, "u32": 0xFFFFFFFF}


class FakeRig:
    """Three servers that answer whatever a test puts into their registers."""

    def __init__(self) -> None:
        self._loop = BackgroundLoop()
        self.banks = {service: RegisterBank(MAPS[service]) for service in SERVICES}
        self._servers: list[ModbusServer] = []
        self.ends: list[str] = []
        for service in SERVICES:
            self.begin(service, {})
            self._loop.call(self._serve(service))

    def begin(self, service: str, changes: dict[str, object]) -> None:
        """Show the identity and the configuration that an honest service has, with changes to the latter."""
        bank, settings = self.banks[service], Settings()
        header = own_header(settings.model.file)
        bank.put(Identity(MAGIC, bank.map.digest, bank.map.version, 1, header.short_digest, 1, 400, 7))
        publish_configuration(bank, selected(settings, SHOWN[service]) | changes)
        bank.put(SessionPace(1, 1, 1.0, 0))

    def show(self, service: str, text: str) -> None:
        """Show a text as the configuration, with its digest."""
        bank = self.banks[service]
        bank.put(ConfigurationDigest(len(text), to_words(hashlib.sha256(text.encode()).hexdigest(), 32)))
        for row in range(-(-len(text) // LINE_CHARACTERS)):
            line = text[row * LINE_CHARACTERS : (row + 1) * LINE_CHARACTERS]
            bank.put(ConfigurationLine(to_words(line, LINE_WORDS)), row)

    def fill(self, service: str, word: Callable[[], int]) -> None:
        """Fill all registers but identity and configuration."""
        bank = self.banks[service]
        for block in bank.map.blocks:
            if block.record in (Identity, ConfigurationDigest, ConfigurationLine):
                continue
            size = 2 * block.row_words
            for row in range(min(block.rows, 300)):
                raw = struct.pack(f">{size // 2}H", *(word() for _ in range(size // 2)))
                record = bank._places[block.record][1].decode(raw)  # noqa: SLF001
                (bank.put_sealed if block.sealed else bank.put)(record, *(() if block.sealed else (row,)))

    async def _serve(self, service: str) -> None:
        server = ModbusServer(
            self.banks[service],
            settings=ServerSettings(port=0),
            on_write=lambda *_: None,
            identity=DeviceIdentity(product="liar", revision="1"),
        )
        await server.start()
        self._servers.append(server)
        self.ends.append(f"127.0.0.1:{server.port}")

    def close(self) -> None:
        for server in self._servers:
            self._loop.call(server.close())
        self._loop.close()


@pytest.fixture
def fake() -> Iterator[FakeRig]:
    rig = FakeRig()
    yield rig
    rig.close()


@pytest.fixture
def ask(
    coldloop: "Coldloop", fake: FakeRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> "Callable[..., Outcome]":
    """A command to the fake rig, which does not move in a run."""
    monkeypatch.setattr("coldloop_rig.cosim.session.QUIET_S", 0.5)

    def asked(*words: object) -> "Outcome":
        if words[0] == "run":
            end = ("--load", "e", "--duration", "30s", "--figures", "svg", "--out", tmp_path / "run", "--force")
            return coldloop("run", "--attach", *fake.ends, *words[1:], *end)
        return coldloop(words[0], "--rig", *fake.ends, *words[1:])

    return asked


def assert_one_line(outcome: "Outcome", *parts: str) -> None:
    assert outcome.code in (1, 2), (outcome.out, outcome.complaints)
    assert len(outcome.complaints) == 1, outcome.complaints
    assert len(outcome.complaints[0]) < 1000
    assert outcome.complaints[0].isprintable()
    for part in parts:
        assert part in outcome.complaints[0]


# -- the configuration -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("service", "key"),
    [
        ("plant", "model.file"), ("plant", "plant.retain.file"), ("control_plc", "control_plc.retain.file"),
        ("plant", "rig.tls.key"), ("optimizer_plc", "model.file"), ("plant", "plant.refrigerator.file"),
        ("control_plc", "plant.refrigerator.file"), ("plant", "telemetry.password_file"), ("plant", "plant.load"),
        ("plant", "hmi.login.users"), ("plant", "model"), ("plant", "plant"), ("plant", ""),
    ],
)  # fmt: skip
def test_a_file_that_a_rig_tells_is_never_opened(
    service: str, key: str, fake: FakeRig, ask: "Callable[..., Outcome]", tmp_path: Path
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)  # whoever opened it would wait
    fake.begin(service, {key: {"file": str(pipe)} if key in ("model", "plant") else str(pipe)})
    assert_one_line(ask("run"))
    assert not (tmp_path / "run").exists()


def test_a_file_of_a_rig_is_named_and_the_client_may_have_the_same(
    fake: FakeRig, ask: "Callable[..., Outcome]", tmp_path: Path
) -> None:
    fake.begin("plant", {"plant.refrigerator.file": str(tmp_path / "station.json")})
    assert_one_line(ask("run"), "plant.refrigerator.file", "--set plant.refrigerator.file=FILE")
    outcome = ask("run", "--set", f"plant.refrigerator.file={tmp_path / 'station.json'}")
    assert "plant.refrigerator.file" not in outcome.complaints[0]


TEXTS: list[Any] = [
    "", "{", "[]", "null", "5", '"text"', "[[1, 2]]", "[" * 9000, '{"limits":' + '{"a":' * 2000 + "1" + "}" * 2001,
    '{"limits.low": ' + "9" * 4200 + "}", '{"limits.low": ' + "9" * 9000 + "}", '{"limits.low": NaN}',
    '{"limits.low": [NaN, 0, 20]}', '{"limits.low": [1e999, 0, 20]}', '{"limits.low": "\\u001b[2J\\n\\n"}',
    '{"limits.\\u001b[2J\\nx": 1}', '{"limits": 5}', '{"limits": {}}', '{"limits": null}', '{"limits.low.0": 1}',
    '{"limits.low": [0, 0, 0], "limits": 5}', '{"limits": 5, "limits.low": 5}', '{"limits.low": {"": {}}}',
    '{"limits.low": "' + "x" * 15000 + '"}', "{}" + " " * 16000,
]  # fmt: skip


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text[:30].encode("unicode_escape").decode())
@pytest.mark.parametrize("words", [(), ("--set", "limits.low=[20,0,20]")], ids=["plain", "set"])
def test_any_text_as_a_configuration_is_one_line(
    text: str, words: tuple[str, ...], fake: FakeRig, ask: "Callable[..., Outcome]"
) -> None:
    fake.show("control_plc", text)
    assert_one_line(ask("run", *words))


# -- registers ---------------------------------------------------------------------------------------------------------

COMMANDS = (
    ("status",), ("set", "load", "400"), ("set", "load", "400", "--at", "3600"), ("set", "mode", "manual"),
    ("set", "setpoint", "cv155", "45"), ("set", "factor", "2"), ("set", "pause"), ("set", "acknowledge"),
    ("events",), ("events", "--service", "plant"), ("fault", "sensor", "T5", "stuck"),
)  # fmt: skip


def check(outcome: "Outcome", command: tuple[str, ...]) -> None:
    """It did something, or says in one line why not."""
    assert outcome.code in (0, 1, 2), (command, outcome)
    assert len(outcome.complaints) <= 1 + (command[0] == "events"), (command, outcome)
    assert bool(outcome.complaints) or outcome.code == 0, (command, outcome)
    text = outcome.out + "".join(outcome.complaints)
    assert all(character.isprintable() or character == "\n" for character in text), (command, outcome)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("seed", range(4))
def test_any_registers_are_one_line_at_most(
    seed: int, command: tuple[str, ...], fake: FakeRig, ask: "Callable[..., Outcome]"
) -> None:
    words = random.Random(seed)  # noqa: S311
    choices: dict[int, Callable[[], int]] = {
        0: lambda: words.randrange(0x10000),
        1: lambda: 0xFFFF,
        2: lambda: words.choice((0, 1, 2, 0x7FC0, 0x7F80, 0xFFFF)),
        3: lambda: words.choice((0x7F80, 0)),
    }
    for service in SERVICES:
        fake.fill(service, choices[seed])
    check(ask(*command), command)


@pytest.mark.parametrize("seed", range(3))
def test_any_registers_do_not_break_an_attached_run(seed: int, fake: FakeRig, ask: "Callable[..., Outcome]") -> None:
    words = random.Random(seed)  # noqa: S311
    choices = (lambda: words.randrange(0x10000), lambda: 0xFFFF, lambda: words.choice((0, 1, 0x7FC0, 0xFFFF)))
    for service in SERVICES:
        fake.fill(service, choices[seed])
    assert_one_line(ask("run"))


@pytest.mark.parametrize("field", ["session", "tick", "heartbeat"])
def test_counters_at_their_end_are_one_line_at_most(field: str, fake: FakeRig, ask: "Callable[..., Outcome]") -> None:
    for service in SERVICES:
        identity = fake.banks[service].get(Identity)
        fake.banks[service].put(identity._replace(**{field: NUMBERS["u16" if field == "heartbeat" else "u32"]}))
    for command in COMMANDS:
        check(ask(*command), command)
    if field == "session":
        assert_one_line(ask("run"))


def test_a_mode_that_there_is_not_is_one_line(fake: FakeRig, ask: "Callable[..., Outcome]") -> None:
    control = fake.banks["control_plc"]
    control.put(control.get(LadderStatus)._replace(mode=77, cause=78))
    assert_one_line(ask("status"), "block 'ladder'", "mode = 77")


@pytest.mark.parametrize("absent", ["plant", "control_plc", "optimizer_plc"])
def test_status_shows_what_answers_and_names_what_does_not(absent: str, fake: FakeRig, coldloop: "Coldloop") -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # not listening: whoever asks is refused
        place = f"127.0.0.1:{nobody.getsockname()[1]}"
        ends = [place if service == absent else end for service, end in zip(fake.banks, fake.ends, strict=True)]
        code, out, complaints = coldloop("status", "--rig", *ends)
    rows = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert code == 0, complaints
    assert place in rows["absent"]
    assert ("load" in rows, "mode" in rows) == (absent != "plant", absent != "control_plc")


def test_what_a_command_would_write_back_is_within_its_range(fake: FakeRig, ask: "Callable[..., Outcome]") -> None:
    fake.banks["control_plc"].put(Operator(2, (float("nan"), 0.0, 0.0)))
    assert_one_line(ask("set", "setpoint", "ncr22", "45"), "cv155 is not a finite number")
    fake.banks["plant"].put(SessionPace(1, 1, float("inf"), 0))
    assert_one_line(ask("set", "pause"), "factor is not a finite number")
    fake.banks["plant"].put(LoadStatus(float("nan")))
    assert_one_line(ask("set", "load", "400"), "watts is not a finite number")


# -- journals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "page",
    [
        JournalPage(1, 2**32 - 1, 0, 2), JournalPage(2**32 - 1, 1, 3, 1), JournalPage(1, 100, 0xFFFF, 2**32 - 1),
        JournalPage(1, 100, 0, 101), JournalPage(0, 2**32 - 1, 3, 0),
    ],
    ids=str,
)  # fmt: skip
def test_a_journal_that_has_no_end_is_given_up(page: JournalPage, fake: FakeRig, ask: "Callable[..., Outcome]") -> None:
    fake.banks["control_plc"].put(page)
    assert_one_line(ask("events"), "contradicts itself")


def test_a_journal_whose_answer_never_advances_is_given_up(fake: FakeRig, ask: "Callable[..., Outcome]") -> None:
    bank = fake.banks["control_plc"]
    bank.put(JournalPage(1, 100, 3, 1))
    bank.put(JournalAnswer(1))
    outcome = ask("events")
    assert outcome.code == 0  # the number after the first is asked for next, which is 1 again: the end
    assert len(outcome.out.splitlines()) <= 3


# -- time --------------------------------------------------------------------------------------------------------------


def test_a_rig_that_answers_slowly_is_given_up(ask: "Callable[..., Outcome]", monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coldloop_rig.cosim.wiring.ANSWER_S", 0.3)

    async def late(*_: object) -> list[bytes]:
        await asyncio.sleep(30)
        return []

    monkeypatch.setattr("coldloop.modbus.client.Transport.transact", late)
    for command in (*COMMANDS[:8], ("run",)):
        assert_one_line(ask(*command), "takes longer than")


def test_a_host_name_that_is_none_is_one_line(coldloop: "Coldloop") -> None:
    for host in ("a" * 70, "a..b", "\u00e9" * 80):
        assert_one_line(coldloop("status", "--rig", *[f"{host}:1"] * 3))
