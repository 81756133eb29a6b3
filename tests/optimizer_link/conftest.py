"""An optimiser PLC, a control PLC that a test plays, and the wire between them, which damages what a test wants."""

import asyncio
import contextlib
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any

import pytest

from coldloop.modbus.server import DeviceIdentity, ModbusServer, ServerSettings
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import (
    Acknowledgement,
    AwaitUpdate,
    Heartbeat,
    LatchedUpdate,
    Plan,
    SequenceHeader,
    SequenceRow,
    Update,
    Verdict,
)
from coldloop.registers.declaration import Block, RegisterMap
from coldloop.registers.optimizer_plc import ControlLinkState, ControlLinkStatus
from coldloop.safety.writers import InputSequence, WriterLease, checksum
from coldloop_chaos.faults import Direction
from coldloop_chaos.proxy import reset
from coldloop_optimizer_plc.runtime import OptimizerPlc
from coldloop_optimizer_plc.settings import OptimizerSettings
from tests.harness.records import CONTROL_MAP, PLANT_MAP, sealed
from tests.harness.treated_link import TreatedLink

WITHIN_S = 60.0
LONGEST_WAIT_S = 0.1
"""The control PLC played here lets a request for an update wait for so long, s."""


async def wait_until(condition: Callable[[], object]) -> None:
    """Let the event loop run until a condition holds."""
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.002)


# -- the control PLC ---------------------------------------------------------------------------------------------------


class PlayedControlPlc:
    """Latches update after update, judges sequences by their CRC, and remembers what it is sent."""

    def __init__(self, model: LtiModel, register_map: RegisterMap = CONTROL_MAP) -> None:
        self._model = model
        self.bank = RegisterBank(register_map)
        self.bank.put(Identity(map_digest=register_map.digest, map_version=register_map.version))
        self.lease = WriterLease("the optimiser", lambda: 0.0)
        self.session, self.updates = 1, 0
        self.latches_on = True
        """An update follows on each sequence that is accepted."""
        self.awaited: list[AwaitUpdate] = []
        self.beats: list[Heartbeat] = []
        self.plans: list[Plan] = []
        self.headers: list[SequenceHeader] = []
        self.poison: Callable[[Update], Update] | None = None
        """What the next update that is latched is changed into."""
        self.verdicts: list[Verdict] = []
        """Those to come, instead of a judgement."""
        self._latched = asyncio.Event()
        if register_map is CONTROL_MAP:
            self.runs(model.short_digest)
            for record in (AwaitUpdate, Plan, Heartbeat, SequenceHeader, SequenceRow):
                self.bank.judged_by(self._check_lease, record)
            for empty in (self._update(0), LatchedUpdate(), Acknowledgement(0, Verdict.NONE)):
                self.bank.put(sealed(empty))

    def runs(self, model_digest: int) -> None:
        """Be of a model."""
        self.bank.put(self.bank.get(Identity)._replace(model_digest=model_digest))

    def _check_lease(self, record: tuple[Any, ...], _row: int, caller: Caller) -> None:
        self.lease.check(caller, record.holder if isinstance(record, Heartbeat) else None)

    def _update(self, session: int, tick: int = 0) -> Update:
        model = self._model
        u, y, x = (tuple(values.tolist()) for values in (model.u0, model.y0, model.x0))
        playing = self.headers[-1].number if self.headers else 0
        return Update(session, self.updates, tick, playing, model.w0, u, u, y, x)

    def latch(self, tick: int = 0) -> None:
        """Latch the next update."""
        update, poison, self.poison = self._update(self.session, tick), self.poison, None
        update = update if poison is None else poison(update)
        self.bank.put(sealed(update))
        self.bank.put(sealed(LatchedUpdate(update.session, update.update, tick)))
        self.updates += 1
        self._latched.set()
        self._latched = asyncio.Event()

    def on_write(self, block: Block, caller: Caller) -> Awaitable[None] | None:
        """Take what the optimiser has written."""
        self.lease.take(caller, self.bank.get(Heartbeat).holder if block.record is Heartbeat else None)
        if block.record is Heartbeat:
            self.beats.append(self.bank.get(Heartbeat))
        elif block.record is Plan:
            self.plans.append(self.bank.get(Plan))
        elif block.record is SequenceHeader:
            self._judge(self.bank.get(SequenceHeader))
        elif block.record is AwaitUpdate:
            self.awaited.append(self.bank.get(AwaitUpdate))
            if self.updates <= self.awaited[-1].update:
                return self._wait()
        return None

    async def _wait(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LONGEST_WAIT_S):
                await self._latched.wait()

    def _judge(self, header: SequenceHeader) -> None:
        rows = [self.bank.get(SequenceRow, row).u for row in range(header.length)]
        intact = checksum(*InputSequence(header, rows)) == header.crc
        verdict = Verdict.ACCEPTED if intact else Verdict.BAD_CRC
        if header.update not in {plan.update for plan in self.plans}:
            verdict = Verdict.WRONG_UPDATE
        if self.verdicts:
            verdict = self.verdicts.pop(0)
        self.headers.append(header)
        self.bank.put(sealed(Acknowledgement(header.number, verdict)))
        if self.latches_on and verdict is Verdict.ACCEPTED:
            self.latch(header.first_tick)


# -- the wire ----------------------------------------------------------------------------------------------------------


class Wire(TreatedLink):
    """Passes requests and answers on; damages or loses those that concern a block as often as it is told."""

    def __init__(self, target: int) -> None:
        super().__init__(target, self._treated)
        self.is_cut = False
        """Connections are closed at once."""
        self.damaged_requests: dict[str, int] = {}
        self.damaged_answers: dict[str, int] = {}
        self.lost_requests: dict[str, int] = {}
        self.lost_answers: dict[str, int] = {}
        self.accepted = 0
        """Connections so far."""
        self._asked: dict[bytes, set[str]] = {}
        """Blocks that requests under way concern, by their transaction."""
        self._seen = asyncio.Event()

    async def moves(self) -> None:
        """Wait for the next connection or the next answer that is sent back."""
        await self._seen.wait()

    def cut(self) -> None:
        """Close all connections."""
        for end in tuple(self._open):
            reset(end)

    def _move(self) -> None:
        self._seen.set()
        self._seen = asyncio.Event()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.accepted += 1
        self._move()
        if self.is_cut:
            writer.close()
        else:
            await super()._serve(reader, writer)

    def _treated(self, way: Direction, frame: bytes) -> bytes | None:
        head, pdu = frame[:7], frame[7:]
        if self.is_cut:
            return None
        if way is Direction.REQUESTS:
            names = self._asked[head[:2]] = _names(pdu)
            lost, damaged, place = self.lost_requests, self.damaged_requests, 13 if pdu[0] == 23 else 9
        else:
            names = self._asked.pop(head[:2])
            lost, damaged, place = self.lost_answers, self.damaged_answers, 5
        if _due(lost, names):
            return None
        if way is Direction.ANSWERS:
            self._move()
        return head + (_flipped(pdu, place) if _due(damaged, names) else pdu)


def _names(pdu: bytes) -> set[str]:
    """Return the blocks that a request reads from or writes to."""
    addresses = {struct.unpack(">H", pdu[1:3])[0]}
    if pdu[0] == 23:
        addresses.add(struct.unpack(">H", pdu[5:7])[0])
    return {block.name for block in CONTROL_MAP.blocks for address in addresses if block.address <= address < block.end}


def _due(times: dict[str, int], names: set[str]) -> bool:
    for name in names & times.keys():
        times[name] -= 1
        if not times[name]:
            del times[name]
        return True
    return False


def _flipped(pdu: bytes, place: int) -> bytes:
    return pdu[:place] + bytes((pdu[place] ^ 0x10,)) + pdu[place + 1 :]


# -- all together ------------------------------------------------------------------------------------------------------


@dataclass
class Link:
    """Both ends, and what is between them."""

    optimizer: OptimizerPlc
    running: "asyncio.Task[None]"
    control: PlayedControlPlc
    wire: Wire
    port: int
    """Of the optimiser's own server."""

    @property
    def status(self) -> ControlLinkStatus:
        """What the optimiser's registers show."""
        return self.optimizer.publication.bank.get(ControlLinkStatus)

    async def reaches(self, state: ControlLinkState) -> None:
        """Wait until the link is in a state."""
        await wait_until(lambda: self.status.state == state)

    async def answers(self, count: int) -> None:
        """Wait until the optimiser has sent so many sequences, and has understood what became of them."""
        done = self.optimizer.publication.bank
        await wait_until(lambda: len(self.control.headers) >= count and done.get(Identity).heartbeat >= count)


Connect = Callable[..., AbstractAsyncContextManager[Link]]
Listen = Callable[..., AbstractAsyncContextManager[ModbusServer]]
Until = Callable[[Callable[[], object]], Awaitable[None]]


@contextlib.asynccontextmanager
async def listening(
    bank: RegisterBank, on_write: Callable[[Block, Caller], Awaitable[None] | None], **settings: object
) -> AsyncIterator[ModbusServer]:
    """Serve a bank on a free port."""
    server = ModbusServer(
        bank, settings=ServerSettings(**{"port": 0, **settings}), on_write=on_write,  # type: ignore[arg-type]
        identity=DeviceIdentity(product="test", revision="0"),
    )  # fmt: skip
    await server.start()
    try:
        yield server
    finally:
        await server.close()


@contextlib.asynccontextmanager
async def connected(control: PlayedControlPlc, **program: object) -> AsyncIterator[Link]:
    """Run an optimiser PLC that finds a control PLC at the other end of a wire."""
    async with listening(control.bank, control.on_write) as server, Wire(server.port) as wire:
        here = {"host": "127.0.0.1", "port": wire.port, "timeout_s": 60.0}
        section = {"control_plc": here, "program": program}
        optimizer = OptimizerPlc(OptimizerSettings.model_validate({"optimizer_plc": section}))
        shown = optimizer.publication
        async with listening(shown.bank, shown.on_write) as own:
            running = asyncio.create_task(optimizer.run())
            try:
                yield Link(optimizer, running, control, wire, own.port)
            finally:
                running.cancel()
                await asyncio.wait({running})
                optimizer.close()


@pytest.fixture(scope="session")
def model() -> LtiModel:
    return load(DEFAULT_MODEL_FILE)


@pytest.fixture
def until() -> Until:
    return wait_until


@pytest.fixture
def listen() -> Listen:
    return listening


@pytest.fixture(scope="session")
def connect() -> Connect:
    return connected


@pytest.fixture
def something_else(model: LtiModel) -> PlayedControlPlc:
    """A server of another register map."""
    return PlayedControlPlc(model, PLANT_MAP)


@pytest.fixture(scope="session")
def make_control(model: LtiModel) -> Callable[[], PlayedControlPlc]:
    return lambda: PlayedControlPlc(model)


@pytest.fixture
def control(make_control: Callable[[], PlayedControlPlc]) -> PlayedControlPlc:
    return make_control()
