"""The control PLC as a whole, in this process, with a rack that is not there, or one of a few registers."""

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from coldloop.modbus.server import DeviceIdentity, ModbusServer, ServerSettings
from coldloop.process.cold_box import L1, T1, T5
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop.registers.bank import ANYBODY, Caller, RegisterBank
from coldloop.registers.common import (
    EVENT_ROWS,
    Alarm,
    AlarmAction,
    AlarmCommand,
    AlarmKind,
    AlarmState,
    Event,
    Identity,
)
from coldloop.registers.control_plc import (
    Cause,
    ControlSession,
    CoolDownStep,
    LadderStatus,
    Mode,
    Operator,
    OperatorMode,
    PlantLinkState,
    PlantLinkStatus,
)
from coldloop.registers.declaration import Block
from coldloop.registers.plant import Actuators, Measurement, OutputVerdict
from coldloop.safety.retained import RetainedFile
from coldloop_control_plc.program import ControlProgram
from coldloop_control_plc.runtime import EXPIRES_SOON, UNREADABLE, ControlPlc
from coldloop_control_plc.sessions import ADOPT_AFTER_S, OWNER
from coldloop_control_plc.settings import ControlSettings
from coldloop_rig.cli.certificates import Authority
from coldloop_rig.cosim.wiring import ReservedPorts
from tests.harness.records import CONTROL_MAP, PLANT_MAP, sealed

WITHIN_S = 60.0
HEADER = read_header(DEFAULT_MODEL_FILE)


class SmallRack:
    """A rack in a session, which takes all outputs and whose clock is the test's."""

    def __init__(self, session: int) -> None:
        self.bank = RegisterBank(PLANT_MAP)
        self.bank.put(Identity(map_digest=PLANT_MAP.digest, map_version=PLANT_MAP.version))
        self.written: list[Actuators] = []
        self.generation = 0
        self.y = list(HEADER.y0)
        self.begin(session)

    def begin(self, session: int) -> None:
        """Begin a session."""
        self.generation += 1
        self.session = session
        self._show(0, (43.0, 75.0, 36.0), OutputVerdict.NONE)

    def _show(self, holder: int, u: tuple[float, ...], verdict: OutputVerdict) -> None:
        self.bank.put(
            sealed(
                Measurement(
                    0, HEADER.w0, tuple(self.y), tuple(HEADER.x0), self.session, u, holder, self.generation, verdict
                )
            )
        )

    def on_write(self, block: Block, _caller: Caller) -> None:
        """Take outputs."""
        if block.record is Actuators:
            asked = self.bank.get(Actuators)
            if asked.session == self.session:
                self.written.append(asked)
                self._show(asked.holder, asked.u, OutputVerdict.ACCEPTED)
            else:
                self._show(0, (43.0, 75.0, 36.0), OutputVerdict.WRONG_SESSION)


@contextlib.asynccontextmanager
async def running(rack: SmallRack | None = None, **sections: Any) -> AsyncIterator[ControlPlc]:  # noqa: ANN401 - settings
    """Run a control PLC without a server; where no rack is given, nobody listens where it looks for it."""
    nobody = ReservedPorts(1)
    port, server = nobody.numbers[0], None
    if rack is not None:
        identity = DeviceIdentity(product="test", revision="0")
        server = ModbusServer(rack.bank, settings=ServerSettings(port=0), on_write=rack.on_write, identity=identity)
        await server.start()
        port = server.port
    section = {**sections.pop("control_plc", {}), "plant": {"port": port, "timeout_s": WITHIN_S}}
    plc = ControlPlc(ControlSettings.model_validate({"control_plc": section, **sections}))
    task = asyncio.create_task(plc.run())
    try:
        yield plc
    finally:
        task.cancel()
        await asyncio.wait({task})
        plc.close()
        if server is not None:
            await server.close()
        nobody.release()


def ask(plc: ControlPlc, record: tuple[Any, ...]) -> None:
    """Write a record as an operator does."""
    plc.bank.put(record)
    plc.clients.on_write(CONTROL_MAP.block_of(type(record)), ANYBODY)


async def until(condition: Callable[[], object]) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.01)


def alarm(plc: ControlPlc, kind: AlarmKind) -> AlarmState:
    return AlarmState(plc.bank.get(Alarm, kind).state)


async def test_an_alarm_with_a_delay_is_raised_also_while_no_scans_are_made() -> None:
    rules = {"rules": {"plant_lost": {"on_delay_s": 1.0}}}
    async with running(control_plc={"alarms": rules, "power_up_s": 0.0}) as plc:
        ask(plc, ControlSession(3, 1, 10.0))
        await until(lambda: plc.bank.get(PlantLinkStatus).state == PlantLinkState.SEARCHING)
        await until(lambda: alarm(plc, AlarmKind.PLANT_LOST) is AlarmState.UNACKNOWLEDGED)


@pytest.mark.usefixtures("realtime")
async def test_scans_that_are_not_made_are_alarmed_from_outside_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = asyncio.Event()
    async with running(SmallRack(1)) as plc:
        monkeypatch.setattr(plc, "_scan", ended.wait)
        monkeypatch.setattr("coldloop_control_plc.rack.SEARCH_S", WITHIN_S)
        watch = asyncio.create_task(plc.watch_scans())
        ask(plc, ControlSession(1, 1, 10.0))
        await until(lambda: plc.bank.get(PlantLinkStatus).state == PlantLinkState.SYNCHRONISED)
        await until(lambda: alarm(plc, AlarmKind.SCANS_STOPPED) is AlarmState.UNACKNOWLEDGED)
        ask(plc, ControlSession(2, 0, 1.0))  # in lock-step nobody expects scans
        ended.set()
        await until(lambda: alarm(plc, AlarmKind.SCANS_STOPPED) is AlarmState.RETURNED)
        watch.cancel()


@pytest.mark.usefixtures("realtime")
async def test_a_new_session_does_not_wait_for_a_tick_that_lasts_long() -> None:
    """At a factor of 0.01 a tick lasts 25 s."""
    rack = SmallRack(1)
    async with running(rack, session={"autostart": True, "mode": "realtime", "factor": 0.01}) as plc:
        await until(lambda: rack.written)
        rack.begin(2)
        ask(plc, ControlSession(2, 1, 0.01))
        await until(lambda: rack.written[-1].session == 2)
        assert [outputs.session for outputs in rack.written] == [1, 2], "a scan each"


async def test_a_new_session_of_an_operator_is_no_loss_of_the_plant() -> None:
    rack = SmallRack(1)
    async with running(rack) as plc:
        for session in (1, 2):
            rack.begin(session)
            ask(plc, ControlSession(session, 0, 1.0))
            plc.clients.granted = 1
            plc.clients.changed.set()
            await until(lambda: rack.written and rack.written[-1].session == session)  # noqa: B023 - awaited here
        assert alarm(plc, AlarmKind.PLANT_LOST) is AlarmState.NORMAL


class StandingClock:
    """A clock that the test moves on, and that counts who looks at it."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.looks = 0

    def monotonic(self) -> float:
        self.looks += 1
        return self.now


@pytest.mark.usefixtures("realtime")
async def test_autostart_leaves_a_session_to_the_operator_who_is_about_to_ask_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """He writes to the rack first, and then to the control PLC."""
    rack, clock = SmallRack(1), StandingClock()
    monkeypatch.setattr("coldloop_control_plc.sessions.time", clock)
    async with running(rack, session={"autostart": True, "mode": "realtime", "factor": 50.0}) as plc:
        await until(lambda: rack.written)
        rack.begin(2)
        await until(lambda: clock.looks >= 4)  # four times the rack is found in the other session
        assert rack.written[-1].session == 1
        clock.now += ADOPT_AFTER_S
        await until(lambda: rack.written[-1].session == 2)  # nobody has asked
        assert plc.sessions.running


@pytest.mark.usefixtures("realtime")
async def test_no_number_of_a_start_or_of_an_event_is_given_out_twice(tmp_path: Path) -> None:
    """Whether scans are made or not: here there is no rack."""
    given: list[tuple[int, int]] = []
    for start in (1, 2, 3):
        async with running(control_plc={"retain": {"file": tmp_path / "state"}}) as plc:
            await until(lambda: plc.bank.get(PlantLinkStatus).state == PlantLinkState.SEARCHING)
            ask(plc, Operator(OperatorMode.CLASSICAL, (43.0, 75.0, 36.0)))
            events = [plc.bank.get(Event, row) for row in range(EVENT_ROWS)]
            assert {event.boot for event in events if event.number > len(given)} == {start}
            given += sorted((event.number, event.boot) for event in events if event.number > len(given))
    assert [number for number, _ in given] == list(range(1, len(given) + 1))
    assert {boot for _, boot in given} == {1, 2, 3}


async def test_what_an_operator_says_before_the_rack_is_found_holds(tmp_path: Path) -> None:
    settings = {"retain": {"file": tmp_path / "state"}}
    async with running(SmallRack(4), control_plc=settings) as plc:
        ask(plc, ControlSession(4, 0, 1.0))
        await until(lambda: plc.sessions.running)
        ask(plc, AlarmCommand(AlarmKind.CLOCK_SKEW, AlarmAction.SHELVE, 600))
    for asked in (Operator(OperatorMode.MANUAL, (43.0, 75.0, 36.0)), None):
        async with running(SmallRack(4), control_plc=settings) as plc:
            if asked is not None:
                ask(plc, asked)
                ask(plc, AlarmCommand(AlarmKind.SECOND_BAND, AlarmAction.SHELVE, 600))
            await until(lambda: plc.sessions.running)
            assert plc.bank.get(Identity).session == 4
            assert plc.bank.get(Operator).mode == OperatorMode.MANUAL
            assert alarm(plc, AlarmKind.SECOND_BAND) is AlarmState.SHELVED
            assert alarm(plc, AlarmKind.CLOCK_SKEW) is AlarmState.SHELVED


async def test_a_requested_session_is_on_the_disk_before_the_answer(tmp_path: Path) -> None:
    file = tmp_path / "state"
    async with running(SmallRack(4), control_plc={"retain": {"file": file}}) as plc:
        ask(plc, ControlSession(3, 0, 1.0))
        await until(lambda: plc.sessions.running)
        ask(plc, Operator(OperatorMode.MANUAL, (43.0, 75.0, 36.0)))
        ask(plc, ControlSession(4, 1, 2.0))
        content = RetainedFile(file, OWNER, HEADER.short_digest).load()  # as a start finds it after a kill
        assert plc.bank.get(Identity).session == 3, "it has not begun"
    assert content is not None
    assert (content["session"], content["tick"], content["updates"], content["playing"]) == (4, 0, 0, None)
    assert content["pace"][:2] == [True, 2.0]
    assert content["operator"][0] == OperatorMode.AUTO, "what an operator had said of the session before is over"
    killed = tmp_path / "killed"
    RetainedFile(killed, OWNER, HEADER.short_digest).save(content)
    async with running(SmallRack(4), control_plc={"retain": {"file": killed}}) as plc:
        await until(lambda: plc.sessions.running)
        assert plc.bank.get(Identity).session == 4


async def test_a_session_is_gone_on_with_after_several_starts_without_the_rack(tmp_path: Path) -> None:
    settings = {"retain": {"file": tmp_path / "state"}}
    async with running(SmallRack(4), control_plc=settings) as plc:
        ask(plc, ControlSession(4, 0, 1.0))
        await until(lambda: plc.sessions.running)
    for _ in range(2):
        async with running(control_plc=settings) as plc:
            ask(plc, Operator(OperatorMode.CLASSICAL, (43.0, 75.0, 36.0)))
    async with running(SmallRack(4), control_plc=settings) as plc:
        await until(lambda: plc.sessions.running)
        assert plc.bank.get(Operator).mode == OperatorMode.CLASSICAL
    async with running(SmallRack(5), control_plc=settings) as plc:
        await until(lambda: plc.bank.get(PlantLinkStatus).state == PlantLinkState.IDLE)
        for _ in range(100):
            await asyncio.sleep(0)
        assert not plc.sessions.running
        assert plc.bank.get(Operator).mode == OperatorMode.AUTO


async def test_a_cool_down_is_gone_on_with_after_a_restart_though_there_is_liquid(tmp_path: Path) -> None:
    settings = {"retain": {"file": tmp_path / "state"}}
    for level, temperature, session in ((0.0, 290.0, 4), (30.0, 4.44, None)):
        rack = SmallRack(4)
        rack.y[L1], rack.y[T1], rack.y[T5] = level, temperature, temperature
        rack.begin(4)
        async with running(rack, control_plc=settings) as plc:
            if session is not None:
                ask(plc, ControlSession(session, 0, 1.0))
            await until(lambda: plc.sessions.running)
            plc.clients.granted = 1
            plc.clients.changed.set()
            await until(lambda: rack.written)  # noqa: B023 - awaited here
            plc.clients.granted = 2
            plc.clients.changed.set()
            await until(lambda: plc.bank.get(LadderStatus).cause == Cause.COOL_DOWN)
            assert plc.bank.get(LadderStatus).mode == Mode.CLASSICAL


async def test_certificates_that_cannot_be_read_for_a_while_end_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are looked at again and again, and may be about to be renewed."""
    certificate = tmp_path / "certificate"
    authority = Authority.new("site", 20)
    for file, pair in ((tmp_path / "ca", authority.pair), (certificate, authority.issue_client("a", "control"))):
        file.write_bytes(pair.certificate_pem)
    monkeypatch.setattr("coldloop_control_plc.runtime.CERTIFICATES_S", 0.01)
    tls = {"certificate": certificate, "key": tmp_path / "key", "ca": tmp_path / "ca"}
    async with running(control_plc={"server": {"tls": tls}}) as plc:
        watching = asyncio.create_task(plc.watch_certificates())
        await until(lambda: plc.bank.get(Alarm, AlarmKind.CERTIFICATE).cause == EXPIRES_SOON)
        content = certificate.read_bytes()
        certificate.unlink()
        await until(lambda: plc.bank.get(Alarm, AlarmKind.CERTIFICATE).cause == UNREADABLE)
        certificate.write_bytes(content)
        await until(lambda: plc.bank.get(Alarm, AlarmKind.CERTIFICATE).cause == EXPIRES_SOON)
        assert not watching.done()
        watching.cancel()


@pytest.mark.parametrize(
    "odd",
    [
        {"pace": (1, 0.0)},
        {"pace": (1, math.nan)},
        {"pace": (1, 1e300)},
        {"operator": (77, 1, 1, 1)},
        {"operator": (2, math.nan, 1, 1)},
        {"operator": (2, 1e300, 1, 1)},
        {"tick": -5},
        {"tick": 2**32 - 1},
        {"updates": 2**32 - 1},
        {"alarms": [(9, 0, 0, 0, 0, 0, 1, 0)] * len(AlarmKind)},
        {"alarms": [(0, 0, 0, -1, 0, 0, 1, 2**40)] * len(AlarmKind)},
        {"playing": ((2**32 - 1, 0, 0, 0, 0, 0, 0), "")},
        {"cool_down": max(CoolDownStep) + 1},
    ],
    ids=str,
)
async def test_a_retained_state_that_cannot_be_keeps_nobody_from_starting(tmp_path: Path, odd: dict[str, Any]) -> None:
    file = tmp_path / "state"
    async with running(SmallRack(4), control_plc={"retain": {"file": file}}) as plc:
        ask(plc, ControlSession(4, 0, 1.0))
        await until(lambda: plc.sessions.running)
    kept = RetainedFile(file, OWNER, HEADER.short_digest)
    state = kept.load()
    assert state is not None
    kept.save({**state, **odd})
    async with running(SmallRack(4), control_plc={"retain": {"file": file}}) as plc:
        await until(lambda: plc.bank.get(PlantLinkStatus).state == PlantLinkState.IDLE)
        assert alarm(plc, AlarmKind.STATE_NOT_RETAINED) is AlarmState.UNACKNOWLEDGED
        assert file.with_name("state.refused").exists(), "it is set aside"


@pytest.mark.parametrize("answered", [True, False])
async def test_an_answer_that_came_while_the_control_plc_stood_still_is_in_time(
    *, answered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost: list[ControlPlc] = []
    monkeypatch.setattr(ControlProgram, "optimizer_lost", lambda _: lost.append(plc))
    section = {"ladder": {"optimizer_patience_s": 0.01}}
    plc = ControlPlc(ControlSettings.model_validate({"control_plc": section}))
    waiting = asyncio.create_task(plc._until_answered())  # noqa: SLF001 - the moment is not to be had from outside
    await asyncio.sleep(0)
    if answered:
        asyncio.get_running_loop().call_later(0.005, plc.clients.changed.set)
    time.sleep(0.05)  # noqa: ASYNC251 - this process, so that answer and limit are found together
    await waiting
    assert bool(lost) is not answered
