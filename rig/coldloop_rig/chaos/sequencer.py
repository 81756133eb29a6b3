"""Takes a session from fault to fault: grants ticks, looks at what happens, brings faults about and takes them back."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Final

from coldloop.errors import LinkError
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import LadderStatus
from coldloop.registers.safety import Alarm, alarms_of
from coldloop_rig.chaos.faults import AnyFault, ProcessFault, WrongModel
from coldloop_rig.chaos.injection import Injector
from coldloop_rig.chaos.plan import ChaosPlan
from coldloop_rig.chaos.resources import log_lines, resident_mb
from coldloop_rig.chaos.timeline import Moment, Timeline
from coldloop_rig.chaos.trace import ChaosTrace, Mark, Resources
from coldloop_rig.cosim.local_services import LocalServices
from coldloop_rig.cosim.session import SessionClient

Progress = Callable[[int, LadderStatus | None, list[str]], None]
"""Takes the plant's tick, the state of the control PLC (None while it does not answer), and the faults that are on."""

STANDSTILL_PATIENCE_S: Final = 60.0
"""A rig that does not move for so long without a fault is given up."""
RESTART_PATIENCE_S: Final = 90.0
PRESENCE_S: Final = 10.0
"""How long an optimiser may take after a fault, in lock-step, until the control PLC knows of it."""
RESOURCE_TICKS: Final = 1200
LOOK_S: Final = 0.005


class FaultSequencer:
    """Takes a session from fault to fault."""

    def __init__(
        self,
        plan: ChaosPlan,
        services: LocalServices,
        client: SessionClient,
        injector: Injector,
        trace: ChaosTrace,
        progress: Progress,
    ) -> None:
        self._plan = plan
        self._services = services
        self._client = client
        self._injector = injector
        self._trace = trace
        self._progress = progress
        self._timeline = Timeline(plan.schedule(), factor=plan.factor if plan.realtime else None)
        self._marks: dict[int, Mark] = {}
        self._began = self._stopped_since = time.monotonic()
        self.tick = 0

    async def run(self) -> None:
        """Drive the session to its end."""
        while (moment := await self._next_moment()) is not None:
            if moment.is_begin:
                await self._begin(moment)
            else:
                await self._end(moment)
            self._stopped_since = time.monotonic()
        alarms = await self._client.contact(
            self._client.control.read_rows(Alarm, 0, len(alarms_of(self._client.control.process)))
        )
        self._trace.alarms = alarms or []
        await self._client.conclude()

    def finish(self) -> None:
        """Record the state at the end, however the run ended."""
        self._trace.seconds = self._seconds
        self._trace.log_lines = log_lines(self._services)
        self._trace.lost_contacts = self._client.lost_contacts

    @property
    def _seconds(self) -> float:
        return time.monotonic() - self._began

    async def _next_moment(self) -> Moment | None:
        """Advance the rig until a fault begins or ends; return None at the end of the run."""
        while True:
            with contextlib.suppress(TimeoutError):  # a stopped rig must not keep a fault from ending in time
                async with asyncio.timeout(self._timeline.left_s(self._seconds)):
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
            await self._client.grant(min(until, self._plan.ticks))

    async def _look(self) -> LadderStatus | None:
        """Record what has happened; return the state of the control PLC, None while it does not answer."""
        tick = await self._client.look()
        ladder = await self._client.ladder()
        if tick is not None and tick != self.tick:
            self.tick, self._stopped_since = tick, time.monotonic()
        self._trace.ladder = ladder or self._trace.ladder
        resources = self._trace.resources
        if not resources or self.tick - resources[-1].tick >= RESOURCE_TICKS:
            resources.append(Resources(self.tick, self._seconds, resident_mb(self._services)))
        self._progress(self.tick, ladder, [moment.fault.label for moment in self._timeline.on])
        return ladder

    def _cut_short(self) -> Moment | None:
        """Return the end of a fault that stops plant time.

        Raises:
            LinkError: Plant time stopped without a fault.
        """
        stopped_s = time.monotonic() - self._stopped_since
        for end in self._timeline.on:
            fault = end.fault
            bearable = self._plan.standstill_s
            if fault.stops_time:
                bearable = min(bearable, fault.duration_s)
            if not self._plan.realtime and stopped_s > bearable:
                return self._timeline.take(end)
        tick_s = self._plan.process.tick_s
        if not self._timeline.on and stopped_s > max(STANDSTILL_PATIENCE_S, 4 * tick_s / self._plan.factor):
            raise LinkError(
                f"plan {self._plan.name}: the plant has been at {self.tick * tick_s:g} s for {stopped_s:.0f} s "
                f"without a fault: see {self._services.log('control_plc')}"
            )
        return None

    async def _begin(self, moment: Moment) -> None:
        fault = moment.fault
        if isinstance(fault, ProcessFault) and fault.offset_ms:
            await self._go_on(fault.end_tick)  # the signal is to come while the rig moves on
            await asyncio.sleep(fault.offset_ms / 1000)
            await self._look()
        mark = Mark(fault, begin=self.tick, first_event=len(self._trace.events))
        self._marks[id(fault)] = mark
        self._trace.marks.append(mark)
        await self._injector.begin(fault)
        await self._look()
        mark.done = self.tick
        if isinstance(fault, WrongModel) and not self._plan.realtime:
            await self._until_refused()
        self._timeline.begun(moment, self._seconds)

    async def _end(self, moment: Moment) -> None:
        mark = self._marks.pop(id(moment.fault))
        started = await self._injector.end(moment.fault)
        if started is not None:
            await self._until_up(started, moment.fault)
        if not self._plan.realtime and not self._timeline.on:
            await self._until_optimizer_is_known()
        await self._look()
        mark.end = self.tick

    async def _until_up(self, service: str, fault: AnyFault) -> None:
        """Wait until a service that was started again answers."""
        since = time.monotonic()
        while await self._client.contact(self._client.clients[service].read(Identity)) is None:
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
            ladder = await self._look()
            if ladder is not None and ladder.optimizer:
                return
            await asyncio.sleep(LOOK_S)
