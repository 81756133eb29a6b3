"""The rack's clock: how fast it is, and what becomes of a rack whose plant cannot move."""

import asyncio
from functools import partial

import pytest

from coldloop.errors import ColdloopError
from coldloop.registers.bank import ANYBODY
from coldloop.registers.plant import Actuators, PlantSession
from coldloop_plant.runtime import Pacer, PlantRuntime, RackRegisters
from coldloop_plant.settings import PlantSettings
from tests.harness.records import PLANT_MAP

OUTPUTS = Actuators(0, (43.0, 75.0, 36.0), session=1)


def runtime(mode: str, **plant: object) -> PlantRuntime:
    session = {"autostart": True, "mode": mode, "factor": 200.0}
    return PlantRuntime(PlantSettings.model_validate({"session": session, "plant": {"load": "a", **plant}}))


def send(plant: PlantRuntime) -> None:
    plant.registers.bank.put(OUTPUTS)
    plant.on_write(PLANT_MAP.block_of(Actuators), ANYBODY)


class SleepersClock:
    """A clock that moves only when somebody sleeps."""

    def __init__(self) -> None:
        self.now = 1000.0
        self._yield = asyncio.sleep

    def monotonic(self) -> float:
        return self.now

    async def sleep(self, delay: float) -> None:
        self.now += delay
        await self._yield(0)


@pytest.mark.parametrize("clock_error_ppm", [-50_000.0, 0.0, 50_000.0])
async def test_the_clock_is_as_fast_as_is_configured(clock_error_ppm: float, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SleepersClock()
    monkeypatch.setattr("coldloop_plant.runtime.time", clock)
    monkeypatch.setattr("coldloop_plant.runtime.Pacer", partial(Pacer, now=clock.monotonic))
    monkeypatch.setattr("asyncio.sleep", clock.sleep)
    plant = runtime("realtime", clock_error_ppm=clock_error_ppm)

    def position() -> tuple[float, float]:
        return clock.now, plant.registers.rack.tick + plant._age()  # noqa: SLF001 - unrounded

    running = asyncio.create_task(plant.run())
    send(plant)
    (begun, first) = position()
    while plant.registers.rack.tick < 400:  # noqa: ASYNC110 - the rack has no event for that
        await asyncio.sleep(0)
    (ended, last) = position()
    running.cancel()
    await asyncio.wait({running})
    assert first == pytest.approx(0.5), "the first tick begins in its middle"
    assert (last - first) / (ended - begun) == pytest.approx(800.0 * (1.0 + clock_error_ppm * 1e-6))


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
async def test_a_plant_that_cannot_move_ends_the_service_with_one_line(
    monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    def fails(_registers: RackRegisters) -> None:
        raise FloatingPointError("no such state")

    monkeypatch.setattr(RackRegisters, "advance", fails)
    plant = runtime(mode)
    running = asyncio.create_task(plant.run())
    await asyncio.sleep(0)
    send(plant)
    with pytest.raises(
        ColdloopError, match=r"^the plant has stopped at tick 0: FloatingPointError\('no such state'\)$"
    ):
        await running


@pytest.mark.usefixtures("realtime")
async def test_a_session_in_lock_step_stops_the_clock_of_the_one_before() -> None:
    plant = runtime("realtime")
    running = asyncio.create_task(plant.run())
    send(plant)
    while plant.registers.rack.tick < 3:  # noqa: ASYNC110 - the rack has no event for that
        await asyncio.sleep(0)
    plant.registers.bank.put(PlantSession(1, 0, 1.0, 1, 1))
    plant.on_write(PLANT_MAP.block_of(PlantSession), ANYBODY)
    for _ in range(100):
        await asyncio.sleep(0)
    assert plant.registers.rack.tick == 0
    send(plant)
    await asyncio.sleep(0)
    assert plant.registers.rack.tick == 1, "one tick for each exchange"
    running.cancel()
    await asyncio.wait({running})
