"""Rigs: in one process, on the bus in one event loop, as three processes; and the command line."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import NamedTuple, TypeVar

import pytest
from pydantic import BaseModel

import coldloop_control_plc.runtime
import coldloop_optimizer_plc.runtime
import coldloop_plant.runtime
from coldloop.modbus.client import RegisterClient
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import read_header
from coldloop.registers.codec import WordOrder
from coldloop.registers.control_plc import Mode, Status
from coldloop_control_plc.settings import ControlSettings
from coldloop_optimizer_plc.settings import OptimizerSettings
from coldloop_plant.load import find_load
from coldloop_plant.settings import PlantSettings
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.cosim.wiring import SERVICES, ReservedPorts, RigEndpoints, endpoints_on, wired
from coldloop_rig.results.recording import Recorder, Recording
from coldloop_rig.settings import Settings
from tests.harness import configurations
from tests.harness.processes import Processes

PATIENCE_S = 120.0
"""A test on the bus has failed when it takes longer; the first one may have to compile the kernels."""

S = TypeVar("S", bound=BaseModel)


# -- scenarios and the rig in one process ------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def mean_load() -> float:
    """The load of the operating point, W."""
    return read_header(Settings().model.file).w0


@pytest.fixture(scope="session")
def lively(mean_load: float) -> LoadProfile:
    """A load that moves from the first minute on."""
    return configurations.lively(mean_load)


@pytest.fixture(scope="session")
def load_a(mean_load: float) -> LoadProfile:
    return find_load("a", mean_load, COLD_BOX)


@pytest.fixture(scope="session")
def load_e(mean_load: float) -> LoadProfile:
    return find_load("e", mean_load, COLD_BOX)


Simulate = Callable[..., Recording]


@pytest.fixture(scope="session")
def simulate() -> Simulate:
    """Run a scenario in one process, with settings that differ from the defaults in the sections named."""
    rigs: dict[str, OneProcessRig] = {}

    def run(scenario: Scenario, **sections: BaseModel) -> Recording:
        settings = Settings(**sections)  # type: ignore[arg-type]
        key = settings.model_dump_json()
        if key not in rigs:
            rigs[key] = OneProcessRig(settings)
        recorder = Recorder(scenario.ticks)
        rigs[key].run(scenario, recorder)
        return recorder.recording()

    return run


# -- rigs on the bus ---------------------------------------------------------------------------------------------------


def part(kind: type[S], settings: Settings) -> S:
    """Return what one service reads of the whole configuration."""
    return kind.model_validate({name: getattr(settings, name) for name in kind.model_fields})


class Bus(NamedTuple):
    """Services that are up, and what they were told."""

    endpoints: RigEndpoints
    settings: Settings

    async def ready(self) -> None:
        """Wait until all three serve."""
        rig = SessionClient(self.endpoints, self.settings)
        try:
            await rig.connect(PATIENCE_S)
        finally:
            rig.close()

    async def record(self, scenario: Scenario, patience_s: float = PATIENCE_S) -> Recording:
        """Run a session; return what was recorded."""
        recorder = Recorder(scenario.ticks)
        rig = SessionClient(self.endpoints, self.settings)
        try:
            await rig.connect(patience_s)
            await rig.run(scenario, recorder)
        finally:
            rig.close()
        return recorder.recording()


OnTheBus = Callable[..., AbstractAsyncContextManager[Bus]]


@contextlib.asynccontextmanager
async def services_in_this_loop(
    settings: Settings | None = None,
    *,
    order: WordOrder = WordOrder.HIGH_FIRST,
    services: tuple[str, ...] = SERVICES,
) -> AsyncIterator[Bus]:
    """Serve on free ports; a service that ends by an error fails the test."""
    reserved = ReservedPorts(len(SERVICES))
    chosen = settings or Settings()
    ordered = chosen.model_copy(
        update={name: getattr(chosen, name).model_copy(update={"word_order": order}) for name in SERVICES}
    )
    endpoints = endpoints_on(reserved.numbers, ordered)
    settings = wired(ordered, endpoints)
    serving: dict[str, Callable[[], Awaitable[None]]] = {
        "plant": lambda: coldloop_plant.runtime.serve(part(PlantSettings, settings)),
        "control_plc": lambda: coldloop_control_plc.runtime.serve(part(ControlSettings, settings)),
        "optimizer_plc": lambda: coldloop_optimizer_plc.runtime.serve(part(OptimizerSettings, settings)),
    }
    tasks = [asyncio.ensure_future(serving[name]()) for name in services]
    try:
        yield Bus(endpoints, settings)
    finally:
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
        reserved.release()
    for end in ends:
        if end is not None and not isinstance(end, asyncio.CancelledError):
            raise end


@pytest.fixture
def on_the_bus() -> OnTheBus:
    return services_in_this_loop


@pytest.fixture(scope="session")
def three_processes(shared_processes: Processes) -> Bus:
    """One rig of three processes for all tests; each test runs sessions of its own on it."""
    endpoints = endpoints_on([shared_processes.free_port() for _ in SERVICES], Settings())
    settings = wired(Settings(), endpoints)
    for service, endpoint in zip(SERVICES, endpoints, strict=True):
        shared_processes.service(service, port=endpoint.port, settings=settings, level="error")
    return Bus(endpoints, settings)


# -- the command line --------------------------------------------------------------------------------------------------


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder for results, not there yet."""
    return tmp_path / "results"


async def until_accepted(control: RegisterClient, more: int, patience_s: float = 120.0) -> None:
    """Wait until so many more sequences have been accepted, and one of them is being played."""
    wanted = (await control.read(Status)).accepted + more
    async with asyncio.timeout(patience_s):
        while True:
            status = await control.read(Status)
            if status.accepted >= wanted and status.mode == Mode.MPC:
                return
            await asyncio.sleep(0.05)
