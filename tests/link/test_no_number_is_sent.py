"""A rack that reads back what is no number gets no outputs."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from coldloop.modbus.server import DeviceIdentity, ModbusServer, ServerSettings
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.common import AlarmKind, Identity
from coldloop.registers.control_plc import ControlSession, Grant, LinkCause, PlantLinkState
from coldloop.registers.declaration import Block
from coldloop.registers.plant import Actuators, Measurement, OutputVerdict
from tests.harness.records import PLANT_MAP, sealed
from tests.harness.waiting import until

if TYPE_CHECKING:
    from tests.harness.processes import Processes
    from tests.link.conftest import Control

HEADER = read_header(DEFAULT_MODEL_FILE)
START_S = 90.0


class FakeRack:
    """A rack in lock-step that shows what a test says."""

    def __init__(self) -> None:
        self.bank = RegisterBank(PLANT_MAP)
        self.bank.put(Identity(map_digest=PLANT_MAP.digest, map_version=PLANT_MAP.version, session=1))
        self.bank.keep_fresh(Measurement, self._measurement)
        self.taken: list[Actuators] = []
        self.reads = 0
        self.tick = 0
        self.shows: Callable[[Measurement], Measurement] = lambda measured: measured
        self.server = ModbusServer(
            self.bank,
            settings=ServerSettings(port=0),
            on_write=self._on_write,
            identity=DeviceIdentity(product="fake rack", revision="0"),
        )

    def _measurement(self) -> Measurement:
        self.reads += 1
        u, holder = (self.taken[-1].u, self.taken[-1].holder) if self.taken else (HEADER.u0, 0)
        verdict = OutputVerdict.ACCEPTED if self.taken else OutputVerdict.NONE
        truth = Measurement(self.tick, HEADER.w0, HEADER.y0, HEADER.x0, 1, u, holder, 1, verdict)
        return sealed(self.shows(truth))

    def _on_write(self, _block: Block, _caller: Caller) -> None:
        self.taken.append(self.bank.get(Actuators))
        asyncio.get_running_loop().call_soon(self._advance)

    def _advance(self) -> None:
        self.tick += 1


@contextlib.asynccontextmanager
async def faked(
    processes: "Processes", control_at: "Callable[..., Control]"
) -> AsyncIterator[tuple[FakeRack, "Control"]]:
    """A control PLC that drives a fake rack."""
    rack = FakeRack()
    await rack.server.start()
    settings = (f"control_plc.plant.port={rack.server.port}", "control_plc.ladder.optimizer_patience_s=0.05")
    control = control_at(processes.service("control_plc", *settings))
    try:
        await control.client.connect(START_S)
        await control.client.write(ControlSession(1, 0, 1.0))
        await control.client.write(Grant(1_000_000))
        yield rack, control
    finally:
        processes.end()
        control.client.close()
        await rack.server.close()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
async def test_while_a_read_back_is_no_number_nothing_is_sent_and_afterwards_it_goes_on_from_what_is_applied(
    value: float, processes: "Processes", control_at: "Callable[..., Control]"
) -> None:
    async with faked(processes, control_at) as (rack, control):

        async def sent(number: int) -> bool:
            return len(rack.taken) >= number

        async def not_finite() -> bool:
            link = await control.link()
            return (link.state, link.cause) == (PlantLinkState.JOINING, LinkCause.IMPLAUSIBLE)

        async def looked(reads: int) -> bool:
            return rack.reads >= reads

        await control.drive(46.0, 100.0, 36.5)
        await until(lambda: sent(50))
        rack.shows = lambda measured: measured._replace(u=(measured.u[0], value, measured.u[2]))
        await until(not_finite)
        before = len(rack.taken)
        enough = rack.reads + 10
        await until(lambda: looked(enough))
        assert len(rack.taken) == before
        assert (await control.alarm(AlarmKind.PLANT_LOST)).active
        rack.shows = lambda measured: measured
        await until(lambda: sent(before + 100))
        assert all(math.isfinite(number) for outputs in rack.taken for number in outputs.u)
        for first, second in pairwise(rack.taken):
            steps = zip(first.u, second.u, InputLimits().rate, strict=True)
            assert all(abs(new - old) <= rate for old, new, rate in steps)
