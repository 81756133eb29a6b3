"""Services as processes, a link between them that does what a test says, and the rack as its own history shows it."""

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from itertools import pairwise
from typing import Any, Final, NamedTuple

import pytest

from coldloop.errors import LinkError
from coldloop.modbus.client import RegisterClient
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits
from coldloop.registers.codec import WordOrder, codec_of
from coldloop.registers.common import (
    EVENT_ROWS,
    Alarm,
    AlarmKind,
    Event,
    EventKind,
    Identity,
    LeaseState,
    LeaseStatus,
    WatchdogTime,
)
from coldloop.registers.control_plc import ControlSession, Operator, OperatorMode, PlantLinkState, PlantLinkStatus
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.plant import HISTORY_ROWS, LoadStep, Measurement, PlantSample, PlantSession
from tests.harness.processes import Process, Processes
from tests.harness.records import CONTROL_MAP, PLANT_MAP
from tests.harness.treated_link import TreatedLink

HOST: Final = "127.0.0.1"
HEADER: Final = read_header(DEFAULT_MODEL_FILE)
LIMITS: Final = InputLimits()
SAFE_STATE: Final = (30.0, 50.0, 40.0)
WATCHDOG_TICKS: Final = 60
FACTOR: Final = 10.0
"""A tick is 25 ms: a process that has to wait for 200 ms is in time for its peer (8 ticks) and for its watchdog."""
PATIENCE_S: Final = 100.0
"""A condition that is waited for has failed after this real time."""
START_S: Final = 90.0
"""The first start on a machine compiles the kernels."""
POLL_S: Final = 0.02
ROUNDING: Final = 1e-4
"""Of single precision, in % and W."""

# -- processes ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def shared_rack(shared_processes: Processes) -> Process:
    """One rack for all tests, each of which has a session of its own; its watchdog leads to `SAFE_STATE`.

    It does not limit what it applies: so it shows what control PLCs do.
    """
    watchdog = ("plant.watchdog.action=safe", f"plant.watchdog.safe_state={list(SAFE_STATE)}")
    return shared_processes.service("plant", *watchdog, "plant.rate_limited=false")


# -- raw bytes ---------------------------------------------------------------------------------------------------------


class Wire:
    """A client that knows no seals and no records: a simple one."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    async def ask(self, pdu: bytes) -> bytes:
        self.writer.write(struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu)
        _, _, length, _ = struct.unpack(">HHHB", await self.reader.readexactly(7))
        return await self.reader.readexactly(length - 1)

    async def set_register(self, address: int, value: int) -> int:
        """Write one register with function 6; return the exception code, 0 is none."""
        answer = await self.ask(struct.pack(">BHH", 6, address, value))
        return answer[1] if answer[0] & 0x80 else 0

    async def write(self, register_map: RegisterMap, record: tuple[Any, ...]) -> int:
        """Write a record as it stands, seal included; return the exception code, 0 is none."""
        block = register_map.block_of(type(record))
        data = codec_of(block, WordOrder.HIGH_FIRST).encode(record)
        answer = await self.ask(struct.pack(">BHHB", 16, block.address, len(data) // 2, len(data)) + data)
        return answer[1] if answer[0] & 0x80 else 0


@contextlib.asynccontextmanager
async def wire_to(port: int, source: str = HOST) -> AsyncIterator[Wire]:
    reader, writer = await asyncio.open_connection(HOST, port, local_addr=(source, 0))
    try:
        yield Wire(reader, writer)
    finally:
        writer.close()


WireTo = Callable[..., AbstractAsyncContextManager[Wire]]


@pytest.fixture(scope="session")
def wire() -> WireTo:
    return wire_to


# -- what is there to be seen ------------------------------------------------------------------------------------------


class Step(NamedTuple):
    """A change of the outputs from one tick to the next."""

    tick: int
    before: tuple[float, ...]
    after: tuple[float, ...]


class Rack:
    """The plant as one sees it who is connected to it directly: what it applied at each tick of its session."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.client = RegisterClient(PLANT_MAP, host=HOST, port=port, timeout_s=PATIENCE_S)
        self.applied: dict[int, tuple[float, ...]] = {}
        self.session = 0
        self.tick = 0

    async def begin(self, *, realtime: bool = True, factor: float = FACTOR) -> None:
        """Start a session, when nobody holds the lease of the outputs any more."""
        await self.client.connect(START_S)
        await self.until(self._is_free)
        self.session = (await self.client.read(Identity)).session + 1
        await self.client.write(WatchdogTime(WATCHDOG_TICKS))
        await self.client.write(LoadStep(0, HEADER.w0))
        await self.client.write(PlantSession(self.session, int(realtime), factor, 1, 1))
        self.applied, self.tick = {}, 0

    async def _is_free(self) -> bool:
        return (await self.client.read(LeaseStatus)).state == LeaseState.FREE

    async def look(self) -> None:
        """Read the history on; what a busy machine lets be overwritten before it is read is left out."""
        identity = await self.client.read(Identity)
        if identity.session != self.session:
            return
        self.tick = max(self.tick, identity.tick - HISTORY_ROWS)
        while self.tick < identity.tick:
            row = self.tick % HISTORY_ROWS
            for sample in await self.client.read_rows(
                PlantSample, row, min(identity.tick - self.tick, HISTORY_ROWS - row)
            ):
                if sample.tick == self.tick:
                    self.applied[self.tick] = sample.u
                self.tick += 1

    async def until(self, condition: Callable[[], Awaitable[bool]], within_s: float = PATIENCE_S) -> None:
        """Wait for a condition, and read the history meanwhile."""
        async with asyncio.timeout(within_s):
            while True:
                await self.look()
                if await condition():
                    return
                await asyncio.sleep(POLL_S)

    async def passes(self, ticks: int) -> None:
        """Wait until so many ticks have passed."""
        end = self.tick + ticks

        async def passed() -> bool:
            return self.tick >= end

        await self.until(passed)

    async def measurement(self) -> Measurement:
        return await self.client.read(Measurement)

    @property
    def last(self) -> tuple[float, ...]:
        """What it applied last."""
        return self.applied[max(self.applied)]

    def since(self, tick: int) -> list[tuple[float, ...]]:
        """Return what it applied from a tick on."""
        return [u for at, u in self.applied.items() if at >= tick]

    def violations(self, since: int = 0) -> list[Step]:
        """Return what nobody may do: values out of bounds, and steps beyond the rate except to the safe state."""
        found: list[Step] = []
        history = [(tick, u) for tick, u in self.applied.items() if tick >= since]
        for (earlier, before), (tick, after) in pairwise(history):
            if after == SAFE_STATE or tick > earlier + 1:
                continue
            inside = all(
                low - ROUNDING <= value <= high + ROUNDING
                for low, value, high in zip(LIMITS.low, after, LIMITS.high, strict=True)
            )
            if not inside or any(
                abs(new - old) > rate + ROUNDING for old, new, rate in zip(before, after, LIMITS.rate, strict=True)
            ):
                found.append(Step(tick, before, after))
        return found


class Control:
    """A control PLC, and what its registers show."""

    def __init__(self, service: Process) -> None:
        self.service = service
        self.client = RegisterClient(CONTROL_MAP, host=HOST, port=service.port, timeout_s=PATIENCE_S)

    async def link(self) -> PlantLinkStatus:
        return await self.client.read(PlantLinkStatus)

    async def synchronised(self) -> bool:
        return (await self.link()).state == PlantLinkState.SYNCHRONISED

    async def alarm(self, kind: AlarmKind) -> Alarm:
        return (await self.client.read_rows(Alarm, kind, 1))[0]

    async def events(self, kind: EventKind) -> list[Event]:
        """Return those events of the last ones that are of a kind, oldest first."""
        events = await self.client.read_rows(Event, 0, EVENT_ROWS)
        return sorted(event for event in events if event.number and event.kind == kind)

    async def begin(self, session: int, *, realtime: bool = True, factor: float = FACTOR) -> None:
        await self.client.connect(START_S)
        await self.client.write(ControlSession(session, int(realtime), factor))

    async def drive(self, cv155: float, ncr22: float, cv156: float) -> None:
        """Let an operator drive."""
        await self.client.write(Operator(OperatorMode.MANUAL, (cv155, ncr22, cv156)))

    async def answers(self) -> bool:
        """Tell whether it is there."""
        try:
            await self.client.connect(0.0)
        except LinkError:
            return False
        return True


@pytest.fixture(scope="session")
def control_at() -> Callable[[Process], Control]:
    return Control


# -- put together ------------------------------------------------------------------------------------------------------


class Field:
    """A rack, a link to it that can be disturbed, and control PLCs behind the link."""

    def __init__(self, processes: Processes, port: int, link: TreatedLink) -> None:
        self.processes = processes
        self.rack = Rack(port)
        self.link = link
        self._clients: list[RegisterClient] = [self.rack.client]

    def control(self, *assignments: str, port: int | None = None, stderr: int | None = None) -> Control:
        """Start a control PLC that is pointed at the link."""
        service = self.processes.service(
            "control_plc", f"control_plc.plant.port={self.link.port}", *assignments, port=port, stderr=stderr
        )
        made = Control(service)
        self._clients.append(made.client)
        return made

    async def joined(self, *assignments: str, factor: float = FACTOR, stderr: int | None = None) -> Control:
        """Start a control PLC and a session; return it in step."""
        await self.rack.begin(factor=factor)
        control = self.control(*assignments, stderr=stderr)
        await control.begin(self.rack.session, factor=factor)
        await self.rack.until(control.synchronised)
        await self.rack.passes(4)
        return control

    async def follows(self, control: Control) -> None:
        """Wait until a control PLC writes the outputs, in step with the rack."""
        await self.rack.until(control.answers)

        async def does() -> bool:
            measured, link = await self.rack.measurement(), await control.link()
            shown = await control.client.read(Identity)
            return (
                link.state == PlantLinkState.SYNCHRONISED
                and measured.holder == link.holder
                and shown.session == self.rack.session
                and abs(shown.tick - measured.tick) <= 2
            )

        await self.rack.until(does)

    def close(self) -> None:
        for client in self._clients:
            client.close()


FieldAt = Callable[..., AbstractAsyncContextManager[Field]]


@pytest.fixture
def field(processes: Processes, shared_rack: Process, realtime: None) -> FieldAt:  # noqa: ARG001 a mark
    """The rack of all tests, or another one, with a link in front of it."""

    @contextlib.asynccontextmanager
    async def made(at: Process = shared_rack) -> AsyncIterator[Field]:
        async with TreatedLink(at.port) as link:
            field = Field(processes, at.port, link)
            try:
                yield field
            finally:
                processes.end()
                field.close()

    return made
