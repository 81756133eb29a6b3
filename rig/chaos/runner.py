"""Runs a plan: starts the rig behind proxies, drives it from fault to fault, and records what becomes of it."""

import asyncio
import time
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

from coldloop.config import PREFIX
from coldloop.errors import LinkError
from coldloop.process import TICK_S
from rig.chaos.faults import AnyFault, Link, ProcessFault, WrongModel
from rig.chaos.injection import Injector
from rig.chaos.models import WRONG_MODEL, save_wrong_model
from rig.chaos.observer import Observer, Sight
from rig.chaos.plan import Plan
from rig.chaos.proxy import LinkProxy
from rig.chaos.resources import log_lines, resident_mb
from rig.chaos.timeline import Moment, Timeline
from rig.chaos.trace import ChaosTrace, Mark, Resources
from rig.local_services import Detours, LocalServices, free_ports
from rig.network import NetworkRig
from rig.scenario import Scenario
from rig.settings import Settings

Progress = Callable[[int, Sight, list[str]], None]
"""Told of the plant's tick, what was seen, and the faults that are on."""

STANDSTILL_PATIENCE_S: Final = 60.0
"""A rig that does not move for so long without a fault is given up."""
RESTART_PATIENCE_S: Final = 90.0
PRESENCE_S: Final = 10.0
"""How long an optimiser may take after a fault, in lock-step, until the control PLC knows of it."""
RESOURCE_TICKS: Final = 1200
LOOK_S: Final = 0.005
SLOWEST: Final = 20.0
"""Seconds of plant time in a second that lock-step should reach with proxies and all."""


async def conduct(
    plan: Plan, scenario: Scenario, settings: Settings, folder: Path, trace: ChaosTrace, progress: Progress
) -> None:
    """Run a plan on three services started for it; `trace` holds what there was even when it fails.

    Raises:
        LinkError: A service ended by itself, the rig stood still, or it all took too long.
    """
    if any(isinstance(fault, WrongModel) for fault in plan.schedule()):  # not while the clock is running
        await asyncio.to_thread(save_wrong_model, settings.model.file, folder / WRONG_MODEL)
    detours = Detours(*free_ports(len(Detours._fields)))
    services = LocalServices(settings, folder / "logs", detours=detours, environment=_retained(folder))
    proxies = {
        Link.PLANT: LinkProxy(detours.plant, services.endpoints.plant.port, f"{plan.seed}/plant"),
        Link.OPTIMIZER: LinkProxy(detours.control_plc, services.endpoints.control_plc.port, f"{plan.seed}/optimizer"),
    }
    async with AsyncExitStack() as stack:
        for proxy in proxies.values():
            await proxy.start()
            stack.push_async_callback(proxy.close)
        await stack.enter_async_context(services)
        session = await services.during(_started(services, settings, scenario))
        observer = Observer(services.endpoints, trace, session)
        stack.callback(observer.close)
        injector = Injector(services, proxies, observer, folder)
        driver = Driver(plan, services, observer, injector, trace, progress)
        try:
            async with asyncio.timeout(_patience_s(plan)):
                await services.during(driver.run())
        except TimeoutError:
            raise LinkError(
                f"plan {plan.name} has taken {_patience_s(plan):.0f} s of real time and stands at "
                f"{driver.tick * TICK_S:g} s: see the logs in {folder / 'logs'}"
            ) from None
        finally:
            driver.finish()


def _retained(folder: Path) -> dict[str, str]:
    """Return the variables that let the control PLC and the plant come back where they were killed."""
    files = {service: folder / f"retained_{service}.json" for service in ("control_plc", "plant")}
    for file in files.values():
        file.unlink(missing_ok=True)
    return {f"{PREFIX}{service.upper()}__RETAIN__FILE": str(file) for service, file in files.items()}


async def _started(services: LocalServices, settings: Settings, scenario: Scenario) -> int:
    rig = NetworkRig(services.endpoints, settings)
    try:
        await rig.connect(services.endpoints.plant.patience_s)
        return await rig.start(scenario)
    finally:
        rig.close()


def _patience_s(plan: Plan) -> float:
    schedule = plan.schedule()
    speed = SLOWEST if not plan.realtime else plan.factor / 2
    return 300.0 + plan.duration_s / speed + sum(60.0 + fault.duration_s / speed for fault in schedule)


class Driver:
    """Takes a session from fault to fault."""

    def __init__(
        self,
        plan: Plan,
        services: LocalServices,
        observer: Observer,
        injector: Injector,
        trace: ChaosTrace,
        progress: Progress,
    ) -> None:
        self._plan = plan
        self._services = services
        self._observer = observer
        self._injector = injector
        self._trace = trace
        self._progress = progress
        self._timeline = Timeline(plan.schedule(), factor=plan.factor if plan.realtime else None)
        self._marks: dict[int, Mark] = {}
        self._began = time.monotonic()
        self.tick = 0

    async def run(self) -> None:
        """Drive the session to its end."""
        while (moment := await self._next_moment()) is not None:
            if moment.is_begin:
                await self._begin(moment)
            else:
                await self._end(moment)
            self._observer.moved()
        await self._observer.read_alarms()

    def finish(self) -> None:
        """Record what is known at the end, whatever the end was."""
        self._trace.seconds = self._seconds
        self._trace.log_lines = log_lines(self._services)

    @property
    def _seconds(self) -> float:
        return time.monotonic() - self._began

    async def _next_moment(self) -> Moment | None:
        """Let the rig go on until a fault begins or ends; return None at the end of the run."""
        while True:
            await self._look()
            moment = self._timeline.due(self.tick, self._seconds) or self._cut_short()
            if moment is not None:
                return moment
            if self.tick >= self._plan.ticks:
                return None
            await self._go_on(self._timeline.next_tick or self._plan.ticks)
            await asyncio.sleep(LOOK_S)

    async def _go_on(self, until: int) -> None:
        if not self._plan.realtime:
            await self._observer.grant(min(until, self._plan.ticks))

    async def _look(self) -> Sight:
        sight = await self._observer.look()
        if sight.tick is not None:
            self.tick = sight.tick
        resources = self._trace.resources
        if not resources or self.tick - resources[-1].tick >= RESOURCE_TICKS:
            resources.append(Resources(self.tick, self._seconds, resident_mb(self._services)))
        self._progress(self.tick, sight, [moment.fault.label for moment in self._timeline.on])
        return sight

    def _cut_short(self) -> Moment | None:
        """Return the end of a fault under which plant time stands still.

        Raises:
            LinkError: It stands still without a fault.
        """
        standing = self._observer.standing_s
        for end in self._timeline.on:
            fault = end.fault
            bearable = self._plan.standstill_s
            if fault.stops_time:
                bearable = min(bearable, fault.duration_s)
            if not self._plan.realtime and standing > bearable:
                return self._timeline.take(end)
        if not self._timeline.on and standing > max(STANDSTILL_PATIENCE_S, 4 * TICK_S / self._plan.factor):
            raise LinkError(
                f"plan {self._plan.name}: the plant stands at {self.tick * TICK_S:g} s for {standing:.0f} s without a "
                f"fault: see {self._services.log('control_plc')}"
            )
        return None

    async def _begin(self, moment: Moment) -> None:
        fault = moment.fault
        if isinstance(fault, ProcessFault) and fault.offset_ms:
            await self._go_on(fault.end_tick)  # the signal is to come while the rig moves on
        mark = Mark(fault, begin=self.tick, first_event=len(self._trace.events))
        self._marks[id(fault)] = mark
        self._trace.marks.append(mark)
        await self._injector.begin(fault)
        if isinstance(fault, WrongModel) and not self._plan.realtime:
            await self._until_refused()
        if isinstance(fault, ProcessFault) and fault.offset_ms:
            await self._look()
            mark.begin = self.tick
        self._timeline.begun(moment, self._seconds)

    async def _end(self, moment: Moment) -> None:
        mark = self._marks.pop(id(moment.fault))
        started = await self._injector.end(moment.fault)
        if started is not None:
            await self._until_up(started, moment.fault)
        if not self._plan.realtime and not self._timeline.on:
            await self._until_optimizer_is_known()
        sight = await self._look()
        if started == "control_plc" and sight.ladder is not None:
            self._trace.sight_mode(self.tick, sight.ladder)
        mark.end = self.tick

    async def _until_up(self, service: str, fault: AnyFault) -> None:
        """Wait until a service that was started again answers."""
        if service == "control_plc":
            self._observer.expect_new_events()
        since = time.monotonic()
        while not await self._observer.answers(service):
            if time.monotonic() - since > RESTART_PATIENCE_S:
                raise LinkError(f"after '{fault.label}' the {service} service does not answer: see its log")
            if self._plan.realtime:
                await self._look()
            await asyncio.sleep(LOOK_S)

    async def _until_refused(self) -> None:
        """Hold plant time until an optimiser with a wrong model has ended, if it does."""
        since = time.monotonic()
        while not self._services.ended("optimizer_plc") and time.monotonic() - since < PRESENCE_S:
            await self._look()
            await asyncio.sleep(LOOK_S)

    async def _until_optimizer_is_known(self) -> None:
        """Hold plant time in lock-step until the control PLC knows of its optimiser again.

        Without one it runs as fast as it can, and what the optimiser takes to come back says nothing in plant time.
        """
        since = time.monotonic()
        while time.monotonic() - since < PRESENCE_S:
            sight = await self._look()
            if sight.ladder is not None and sight.ladder.optimizer:
                return
            await asyncio.sleep(LOOK_S)
