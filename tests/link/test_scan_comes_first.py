"""Nothing that clients, readers of logs or the scheduler do keeps a scan from its time, or a timer from plant time."""

import asyncio
import contextlib
import os
import struct
import time
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING

import pytest

from coldloop.modbus.settings import ServerSettings
from coldloop.process.cold_box import L1
from coldloop.registers.common import EventKind, Identity, WatchdogStatus
from coldloop.registers.control_plc import Cause, Mode, Operator, OperatorMode, Status
from coldloop.registers.plant import SensorFault, SensorFaultKind

if TYPE_CHECKING:
    from tests.link.conftest import Control, FieldAt, Wire, WireTo

WITH_ROLES, WITHOUT = "127.0.0.1", "127.0.0.2"
ROLES = ("control", "optimizer", "operator")
FLOOD = 500 * struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 500, 120)
"""Requests for a good part of the sequence, in one go."""
ANSWER_BYTES = 9 + 2 * 120
RATE, BURST = ServerSettings.model_fields["reader_request_rate"].default, ServerSettings(port=0).request_burst
FLOOD_TICKS = 60
CV156 = 2


@contextlib.asynccontextmanager
async def flooded_by(wire: "Wire") -> AsyncIterator[list[int]]:
    """Let a client ask without waiting for answers; what it has got so far is the sum of the list, in bytes."""
    taken: list[int] = []

    async def ask() -> None:
        while True:
            wire.writer.write(FLOOD)
            await wire.writer.drain()

    async def take() -> None:
        while data := await wire.reader.read(1 << 16):
            taken.append(len(data))

    tasks = [asyncio.create_task(ask()), asyncio.create_task(take())]
    try:
        yield taken
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize("source", [WITHOUT, WITH_ROLES])
async def test_a_reader_that_pipelines_requests_keeps_no_scan_from_the_rack_and_gets_its_rate_without_a_role(
    source: str, field: "FieldAt", wire: "WireTo"
) -> None:
    access = [f'control_plc.server.access.{role}=["{WITH_ROLES}/32"]' for role in ROLES]
    async with field() as site:
        control, rack = await site.joined(*access, factor=5.0), site.rack
        trips = (await rack.client.read(WatchdogStatus)).trips
        begun = time.monotonic()
        async with wire(control.service.port, source) as reader, flooded_by(reader) as taken:
            await rack.passes(FLOOD_TICKS)
            answers = sum(taken) // ANSWER_BYTES
        longest_s = time.monotonic() - begun
        if source == WITHOUT:
            assert BURST <= answers <= BURST + RATE * longest_s
        else:
            assert answers > BURST
        assert (await rack.client.read(WatchdogStatus)).trips == trips
        await site.follows(control)
        assert rack.violations() == []


@pytest.fixture
def full_pipe() -> Iterator[int]:
    """The end to write to of a pipe that is full and that nobody reads."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, b" " * 4096)
    os.set_blocking(writer, True)
    yield writer
    os.close(reader)
    os.close(writer)


async def test_a_control_plc_whose_logs_nobody_reads_scans_and_answers_after_many_commands(
    field: "FieldAt", full_pipe: int
) -> None:
    async with field() as site:
        control, rack = await site.joined(stderr=full_pipe), site.rack
        for number in range(60):
            mode = (OperatorMode.MANUAL, OperatorMode.CLASSICAL)[number % 2]
            await control.client.write(Operator(mode, (43.0 + 0.01 * number, 75.0, 36.0)))
            await rack.passes(1)
        await site.follows(control)
        assert len(await control.events(EventKind.OPERATOR_MODE)) == 60
        assert rack.violations() == []
        assert await control.service.terminated() == 0


@contextlib.asynccontextmanager
async def mostly_stopped(control: "Control", tick_s: float) -> AsyncIterator[None]:
    """Let a control PLC run during a third of the time: it scans about once in four ticks."""

    async def stop_and_go() -> None:
        while True:
            control.service.pause()
            await asyncio.sleep(2.6 * tick_s)
            control.service.resume()
            await asyncio.sleep(1.4 * tick_s)

    task = asyncio.create_task(stop_and_go())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        control.service.resume()


async def test_with_one_scan_in_four_ticks_a_bad_level_is_bridged_for_its_time_and_the_loops_are_executed(
    field: "FieldAt",
) -> None:
    factor = 8.0
    settings = ("control_plc.ladder.hold_s=10000", "control_plc.classical.temperature.setpoint_offset=-0.5")
    async with field() as site:
        control, rack = await site.joined(*settings, factor=factor), site.rack
        scans = (await control.client.read(Status)).overruns
        async with mostly_stopped(control, 0.25 / factor):
            await rack.passes(8)
            fails_after = (await rack.client.read(Identity)).tick
            await rack.client.write_rows([SensorFault(SensorFaultKind.NOT_A_NUMBER, 0.0)], start=L1)
            failed_by = (await rack.client.read(Identity)).tick

            async def loops() -> bool:
                status = await control.client.read(Status)
                return status.mode == Mode.CLASSICAL

            await rack.until(loops)
            before = rack.last[CV156]
            await rack.passes(100)

            async def often_late() -> bool:
                return (await control.client.read(Status)).overruns - scans > 20

            await rack.until(often_late)
        await site.follows(control)
        (fallen,) = [event for event in await control.events(EventKind.MODE) if event.cause == Cause.SENSOR_BAD]
        assert fallen.tick - fails_after >= 36, "10 s are 40 ticks"
        assert fallen.tick - failed_by < 160, "40 scans are 160 ticks or more"
        assert abs(rack.last[CV156] - before) > 0.05
        assert rack.violations() == []
