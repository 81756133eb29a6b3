"""Real time: everyone paces on the clock, what is late is counted, and the plant is held meanwhile."""

import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import pytest

import coldloop_rig.cosim.session
from coldloop.modbus.client import RegisterClient
from coldloop.operating.observer import SampleReader
from coldloop.process.load_profile import LoadProfile
from coldloop.process.settings import InputLimits
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import ControlSession, Mode, Plan, ProcessNow, Status, Verdict
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.optimizer_plc import OptimizerSession
from coldloop.registers.plant import LoadStep, PlantSession
from coldloop_control_plc.settings import ControlSection, LadderSettings
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.wiring import QUIET_S
from coldloop_rig.settings import Settings
from tests.harness import processes as harness
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP
from tests.harness.waiting import until

if TYPE_CHECKING:
    from coldloop_rig.results.recording import Recording
    from tests.rig.conftest import Bus, OnTheBus, Simulate

pytestmark = pytest.mark.usefixtures("realtime")

T = TypeVar("T")

LIMITS = InputLimits()
ENDLESS_HOLD = Settings(control_plc=ControlSection(ladder=LadderSettings(hold_s=10_000, optimizer_timeout_s=0)))
"""The classical loops take over only after longer than anybody needs to look at the hold."""
PATIENCE_S = 90.0
"""A machine that is busy with something else takes longer."""


@asynccontextmanager
async def client(register_map: RegisterMap, port: int) -> AsyncIterator[RegisterClient]:
    one = RegisterClient(register_map, host="127.0.0.1", port=port, timeout_s=PATIENCE_S)
    await one.connect(PATIENCE_S)
    try:
        yield one
    finally:
        one.close()


def in_bounds(u: tuple[float, ...]) -> bool:
    return all(low <= value <= high for low, value, high in zip(LIMITS.low, u, LIMITS.high, strict=True))


def assert_consistent(recording: "Recording", lock_step: "Recording") -> None:
    """What was late is counted, and the plant was kept in its bounds; if nothing was, all is as in lock-step."""
    verdicts = Counter(Verdict(row.verdict) for row in recording.updates)
    in_vain = {Verdict.NONE, Verdict.LATE, Verdict.WRONG_UPDATE}  # NONE: given up, as another update had been latched
    held = verdicts.pop(Verdict.PLANT_LOST, 0)  # after missed scans, until the rack has been read back
    assert set(verdicts) <= {Verdict.ACCEPTED, *in_vain}
    assert recording.link.overruns or not held
    rejected = verdicts.total() - verdicts[Verdict.ACCEPTED]
    assert recording.link.deadline_misses >= rejected - 1  # the last one may be counted after the run
    assert 0 < recording.link.lateness_p99_ms <= recording.link.lateness_max_ms
    assert all(in_bounds(tuple(u)) for u in recording.u.tolist())
    if not recording.link.deadline_misses and not recording.link.overruns:
        assert recording.updates == lock_step.updates
        assert recording.trace_sha256 == lock_step.trace_sha256


async def test_sessions_in_real_time_and_in_lock_step_follow_each_other(
    load_a: LoadProfile, simulate: "Simulate", on_the_bus: "OnTheBus"
) -> None:
    lock_step = Scenario(ticks=60, load=load_a, updating_period_s=0.0, seed=1)
    real_time = Scenario(ticks=60, load=load_a, updating_period_s=0.0, seed=1, realtime=True, factor=20.0)
    async with on_the_bus() as bus:
        before = await bus.record(lock_step)
        began = time.monotonic()
        between = await bus.record(real_time)
        assert time.monotonic() - began >= 59 * 0.25 / 20
        after = await bus.record(lock_step)
    assert before.trace_sha256 == after.trace_sha256 == simulate(lock_step).trace_sha256
    assert_consistent(between, before)


async def start_real_time(bus: "Bus", factor: float, *, session: int = 1, optimizer: bool = True) -> None:
    """Start a session in real time as an operator does."""
    ends = bus.endpoints
    async with client(PLANT_MAP, ends.plant.port) as rack, client(CONTROL_MAP, ends.control_plc.port) as plc:
        if optimizer:
            async with client(OPTIMIZER_MAP, ends.optimizer_plc.port) as diagnostics:
                await diagnostics.write(OptimizerSession(session, 1, factor, 0))
        await rack.write_rows([LoadStep(0, 385.0)])
        await rack.write(PlantSession(session, 1, factor, 1, 1))
        await plc.write(ControlSession(session, 1, factor))


async def test_a_killed_optimiser_leaves_the_plant_held_and_a_new_one_takes_over_again(
    on_the_bus: "OnTheBus", processes: harness.Processes
) -> None:
    def start_optimiser() -> harness.Process:
        return processes.service("optimizer_plc", port=bus.endpoints.optimizer_plc.port, settings=bus.settings)

    async with on_the_bus(ENDLESS_HOLD, services=("plant", "control_plc")) as bus:
        optimiser = start_optimiser()
        await start_real_time(bus, factor=5.0)
        async with client(CONTROL_MAP, bus.endpoints.control_plc.port) as plc:

            def status() -> Awaitable[Status]:
                return plc.read(Status)

            await until(lambda: plc.read(Plan), lambda now: now.update >= 4)
            optimiser.kill()  # it has said when its sequence is due, and is at work on it

            held = await until(status, lambda now: now.mode == Mode.HOLD and now.remaining == 0)
            assert held.deadline_misses > 0
            first = await plc.read(ProcessNow)
            later = await until(lambda: plc.read(ProcessNow), lambda now: now.tick >= first.tick + 20)
            assert first.u == later.u
            assert in_bounds(later.u)
            assert later.y != first.y

            start_optimiser()
            back = await until(status, lambda now: now.mode == Mode.MPC and now.accepted >= held.accepted + 5)
            assert back.update > held.update
            assert in_bounds((await plc.read(ProcessNow)).u)


async def test_without_an_optimiser_the_operating_inputs_hold_from_the_start(on_the_bus: "OnTheBus") -> None:
    async with on_the_bus(ENDLESS_HOLD, services=("plant", "control_plc")) as bus:
        await start_real_time(bus, factor=100.0, optimizer=False)
        async with client(CONTROL_MAP, bus.endpoints.control_plc.port) as plc:
            process = await until(lambda: plc.read(ProcessNow), lambda now: now.tick >= 40)
            assert process.u == (43.0, 75.0, 36.0)
            assert (await plc.read(Status)).mode == Mode.HOLD


async def test_the_silence_of_an_optimiser_counts_as_a_miss_whenever_it_begins(on_the_bus: "OnTheBus") -> None:
    async with on_the_bus(services=("plant", "control_plc")) as bus:
        await start_real_time(bus, factor=100.0, optimizer=False)
        async with client(CONTROL_MAP, bus.endpoints.control_plc.port) as plc:
            await until(lambda: plc.read(ProcessNow), lambda now: now.tick >= 100)  # five of the longest periods
            assert (await plc.read(Status)).deadline_misses > 0


async def test_a_plan_that_comes_too_late_costs_an_update_and_not_the_session(
    on_the_bus: "OnTheBus", monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once = RegisterClient.write

    async def dawdling(self: RegisterClient, record: tuple[Any, ...]) -> None:
        if isinstance(record, Plan) and record.update == 3:
            await until(lambda: self.read(Identity), lambda now: now.tick > record.next_update_tick)
        await at_once(self, record)

    monkeypatch.setattr(RegisterClient, "write", dawdling)
    async with on_the_bus() as bus:
        await start_real_time(bus, factor=20.0)
        async with client(CONTROL_MAP, bus.endpoints.control_plc.port) as plc:
            status = await until(lambda: plc.read(Status), lambda now: now.update >= 8)
            assert status.rejected >= 1


class ClockOfTicks:
    """A clock for the client of a session, on which each tick of the plant takes most of what a quiet rig is given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._tick = 0
        read = SampleReader.read

        async def noted(reader: SampleReader) -> int:
            self._tick = await read(reader)
            return self._tick

        monkeypatch.setattr(SampleReader, "read", noted)
        monkeypatch.setattr(coldloop_rig.cosim.session, "time", self)

    def monotonic(self) -> float:
        return 0.9 * QUIET_S * self._tick


async def test_a_slow_run_is_not_given_up_while_it_moves(
    load_a: LoadProfile, on_the_bus: "OnTheBus", monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ClockOfTicks(monkeypatch)
    monkeypatch.setattr(coldloop_rig.cosim.session, "LONGEST_PAUSE_S", 0.002)  # most looks find nothing new
    async with on_the_bus() as bus:
        recording = await bus.record(Scenario(ticks=80, load=load_a, updating_period_s=0.0, seed=1, realtime=True,
                                              factor=40.0))  # fmt: skip
    assert len(recording.load) == 80
    assert clock.monotonic() > 10 * QUIET_S
