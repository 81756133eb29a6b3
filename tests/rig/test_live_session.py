"""Load and time base of a session that goes on, as clients of the three services change them."""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from itertools import cycle
from pathlib import Path

import pytest

from coldloop.errors import RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.operating.observer import JournalReader
from coldloop.registers.common import AlarmKind, Event, EventKind, Identity, SessionPace, WatchdogStatus
from coldloop.registers.control_plc import ControlSession, LadderStatus, Mode, PlantLinkState, PlantLinkStatus
from coldloop.registers.optimizer_plc import OptimizerSession
from coldloop.registers.plant import LiveLoad, LoadAhead, LoadStatus, LoadStep, PlantSession
from coldloop_rig.cosim.networked_run import LocalServices
from coldloop_rig.settings import Settings
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP, sealed

pytestmark = pytest.mark.usefixtures("processes", "realtime")

FACTOR = 5.0
PATIENCE_S = 90.0
PAUSE_S = 3.2
"""Real time; plant time would go on by more than the time-outs of optimiser (15 s) and rack (10 s)."""
OF_THE_RACK = {
    AlarmKind.PLANT_LOST, AlarmKind.PLANT_OTHER_MASTER, AlarmKind.PLANT_FROZEN, AlarmKind.OUTPUTS_REJECTED,
}  # fmt: skip


class Rig:
    """Clients of three services in a session in real time."""

    def __init__(self, services: LocalServices) -> None:
        plant, control, optimizer = services.endpoints
        self.plant = RegisterClient.at(PLANT_MAP, plant)
        self.control = RegisterClient.at(CONTROL_MAP, control)
        self.optimizer = RegisterClient.at(OPTIMIZER_MAP, optimizer)
        self.clients = (self.plant, self.control, self.optimizer)

    async def begin(self) -> None:
        for client in self.clients:
            await client.connect(PATIENCE_S)
        await self.optimizer.write(OptimizerSession(1, 1, FACTOR, 0))
        await self.plant.write_rows([LoadStep(0, 385.0), LoadStep(100_000, 300.0)])
        await self.plant.write(PlantSession(1, 1, FACTOR, 1, 2))
        await self.control.write(ControlSession(1, 1, FACTOR))
        await self.until(self.in_mpc)

    async def tick(self) -> int:
        return (await self.plant.read(Identity)).tick

    async def in_mpc(self) -> bool:
        return (await self.control.read(LadderStatus)).mode == Mode.MPC

    async def synchronised(self) -> bool:
        return (await self.control.read(PlantLinkStatus)).state == PlantLinkState.SYNCHRONISED

    async def pace(self, factor: float, *, paused: bool = False) -> None:
        for client in self.clients:
            await client.write(SessionPace(0, 1, factor, int(paused)))

    async def until(self, condition: Callable[[], Awaitable[bool]]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not await condition():  # noqa: ASYNC110 it is another process that changes
                await asyncio.sleep(0.01)

    async def moved_by(self, ticks: int) -> None:
        first = await self.tick()

        async def there() -> bool:
            return await self.tick() >= first + ticks

        await self.until(there)

    async def events(self, client: RegisterClient, *kinds: EventKind) -> list[Event]:
        return await JournalReader(client, kinds=kinds).read_on()

    async def alarms(self) -> list[Event]:
        """Those of the link to the rack since the session began."""
        raised = await self.events(self.control, EventKind.ALARM_RAISED)
        return [event for event in raised if event.tick and event.subject in OF_THE_RACK]


@asynccontextmanager
async def running(folder: Path) -> AsyncIterator[Rig]:
    async with LocalServices(Settings(), folder) as services:
        rig = Rig(services)
        try:
            await rig.begin()
            yield rig
        finally:
            for client in rig.clients:
                client.close()


def test_a_load_written_during_a_session_takes_effect_from_the_tick_it_names(tmp_path: Path) -> None:
    async def check() -> None:
        async with running(tmp_path) as rig:
            await rig.pace(FACTOR, paused=True)
            named = await rig.tick() + 40
            await rig.plant.write(sealed(LiveLoad(named, 420.0)))
            status = await rig.plant.read(LoadStatus)
            assert (status.watts, status.next_tick, status.next_watts) == (385.0, named, 420.0)
            assert status.upcoming == 1, "what was known of later ticks is dropped"
            await rig.pace(FACTOR)
            await rig.moved_by(named + 2 - await rig.tick())
            assert (await rig.plant.read(LoadStatus)).watts == 420.0
            await rig.plant.write(LiveLoad(0, 385.0))
            await rig.moved_by(2)
            assert (await rig.plant.read(LoadStatus)).watts == 385.0
            with pytest.raises(RequestRefusedError):
                await rig.plant.write(LiveLoad(named, 300.0))
            noted = await rig.events(rig.plant, EventKind.LIVE_LOAD)
            assert [event.value for event in noted] == [420.0, 385.0]

    asyncio.run(check())


@pytest.mark.night  # test_load_schedule.py has the rack's part
def test_steps_written_ahead_are_held_one_after_the_other(tmp_path: Path) -> None:
    async def check() -> None:
        async with running(tmp_path) as rig:
            await rig.pace(FACTOR, paused=True)
            first = await rig.tick() + 60
            watts, ticks = (390.0, 395.0, *[0.0] * 22), (10, *[0] * 23)
            await rig.plant.write(sealed(LoadAhead(1, first, 2, watts, ticks)))
            status = await rig.plant.read(LoadStatus)
            assert (status.next_tick, status.next_watts, status.last_tick) == (first, 390.0, first + 10)
            for wrong in (LoadAhead(9, first + 99, 1), LoadAhead(1, 1, 1), LoadAhead(1, first, 3, watts, ticks)):
                with pytest.raises(RequestRefusedError):
                    await rig.plant.write(sealed(wrong))

    asyncio.run(check())


def test_a_rig_that_is_paused_stands_and_goes_on_without_alarm(tmp_path: Path) -> None:
    async def check() -> None:
        async with running(tmp_path) as rig:
            deadline, rounds, alarms = time.monotonic() + PATIENCE_S, 0, -1
            while len(await rig.alarms()) > alarms:  # a busy machine may lose the plant without a pause: once more
                assert time.monotonic() < deadline
                rounds, alarms = rounds + 1, len(await rig.alarms())
                await rig.pace(FACTOR, paused=True)
                stood = await rig.tick()
                begun = time.monotonic()
                while time.monotonic() - begun < PAUSE_S:
                    assert await rig.tick() == stood
                    await asyncio.sleep(0.1)
                await rig.pace(FACTOR)
                await rig.moved_by(20)
                await rig.until(rig.synchronised)
                await rig.until(rig.in_mpc)
            assert [event.subject for event in await rig.events(rig.control, EventKind.PACE)] == [2, 1] * rounds

    asyncio.run(check())


@pytest.mark.night  # test_rig_that_stays_up.py has the command
def test_the_factor_changes_in_the_middle_of_a_session(tmp_path: Path) -> None:
    async def check() -> None:
        async with running(tmp_path) as rig:
            await rig.pace(1.0)
            await rig.moved_by(2)  # those that were late
            begun = time.monotonic()
            await rig.moved_by(8)
            assert time.monotonic() - begun > 1.0, "eight ticks take two seconds, and took 0.4 s before"
            assert (await rig.plant.read(SessionPace))[1:] == (1, 1.0, 0)
            await rig.until(rig.in_mpc)
            assert not await rig.alarms()

    asyncio.run(check())


@pytest.mark.night
def test_a_pace_that_is_not_for_the_session_is_refused(tmp_path: Path) -> None:
    async def check() -> None:
        async with running(tmp_path) as rig:
            for client in rig.clients:
                for wrong in (SessionPace(9, 1, 1.0, 0), SessionPace(0, 0, 1.0, 1)):
                    with pytest.raises(RequestRefusedError):
                        await client.write(wrong)

    asyncio.run(check())


@pytest.mark.parametrize("factors", [(FACTOR, FACTOR), (FACTOR, 2 * FACTOR)], ids=["the same", "another each time"])
def test_the_pace_written_fifty_times_a_second_starves_no_watchdog(
    factors: tuple[float, float], tmp_path: Path
) -> None:
    async def check() -> None:
        async with running(tmp_path) as rig:
            await rig.until(rig.in_mpc)
            paces = cycle(factors)
            for _ in range(150):
                await asyncio.gather(rig.pace(next(paces)), asyncio.sleep(0.02))
            status = await rig.plant.read(WatchdogStatus)
            assert (status.trips, status.lowest > status.time / 2) == (0, True), status
            await rig.until(rig.in_mpc)

    asyncio.run(check())
