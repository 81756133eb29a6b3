"""Takes a session from fault to fault: grants ticks, looks at what happens, brings faults about and takes them back."""

import asyncio
import contextlib
import re
import signal
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from coldloop import config, errors
from coldloop.modbus.client import RegisterClient
from coldloop.process import cold_box, declaration
from coldloop.process.lti_model import discretise, load
from coldloop.process.settings import settings_of
from coldloop.registers import common, control_plc
from coldloop.registers.plant import PlantSample, SensorFault, SensorFaultKind, Surroundings
from coldloop_chaos import faults, proxy
from coldloop_plant.cold_box.model import find_equilibrium, linearise
from coldloop_plant.helium import load_helium
from coldloop_plant.kinds import box_of
from coldloop_rig.cosim import networked_run, session, wiring
from coldloop_rig.cosim.scenario import Scenario, with_copied_load
from coldloop_rig.results.recording import CONTROL, LinkStatistics, Recorder, Recording, Sink
from coldloop_rig.settings import Settings

WRONG_MODEL: Final = "wrong_model.json"
"""File of the wrong model in the folder of a run."""
MOVED_INPUTS: Final = (-3.0, -15.0, 2.0)
"""Shift of the wrong model's inputs from those of the right one: CV155 %, NCR22_A W, CV156 %."""
GAIN: Final = 0.9  # gains of the wrong model of other processes, over those of the right one


def save_wrong_model(right: Path, wrong: Path) -> None:
    """Write the model of the same plant with its inputs moved by `MOVED_INPUTS`; of another process with less gain."""
    model, helium = load(right), load_helium()
    if model.process:
        less = replace(model, B=GAIN * model.B, D=GAIN * model.D, B_tick=GAIN * model.B_tick, declaration_digest="")
        less.save(wrong)
        return
    box = box_of(model)
    rest = find_equilibrium(model.u0 + np.array(MOVED_INPUTS), float(model.y0[cold_box.L1]), box, helium)
    linear = linearise(rest.x, rest.u, rest.w, box, helium)
    tick = discretise(linear.A, linear.B, linear.F, cold_box.TICK_S)
    replace(
        model, **linear._asdict(), A_tick=tick.A, B_tick=tick.B, F_tick=tick.F,
        x0=rest.x, u0=rest.u, w0=rest.w, y0=rest.y,
    ).save(wrong)  # fmt: skip


T = TypeVar("T")

_FAULT: Final[TypeAdapter[faults.AnyFault]] = TypeAdapter(faults.AnyFault)
_SHOWN: Final = {"nan": SensorFaultKind.NOT_A_NUMBER, "frozen": SensorFaultKind.FROZEN, "value": SensorFaultKind.VALUE}


@dataclass
class Injector:
    """Acts on the processes, the links and the plant's sensors of one run, in whose folder is a wrong model."""

    services: networked_run.LocalServices
    links: proxy.LinkProxies
    plant: RegisterClient
    folder: Path
    _given_before: dict[str, float] = field(default_factory=dict)

    def prepared(self, kind: str, parameters: Mapping[str, object], model: Path) -> faults.AnyFault:
        """Return a fault whose times the caller decides, and write the wrong model that it may need for this one.

        Raises UsageError: there is no such fault, or a parameter is missing or wrong.
        """
        if of_plan := [name for name in ("at_s", "duration_s", "offset_ms") if name in parameters]:
            raise errors.UsageError(
                f"fault '{kind}': {of_plan[0]} belongs to a plan; here the context decides when it begins and ends"
            )
        try:
            with settings_of(self.plant.process):
                fault = _FAULT.validate_python({"kind": kind, "duration_s": 1.0, **parameters})
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"] if part != kind)
            raise errors.UsageError(f"fault '{kind}': {f'{where}: ' if where else ''}{first['msg']}") from None
        if isinstance(fault, faults.WrongModel):
            save_wrong_model(model, self.folder / WRONG_MODEL)
        return fault

    async def begin(self, fault: faults.AnyFault) -> None:
        """Bring a fault about."""
        if isinstance(fault, faults.LinkFault):
            self.links.by_link[fault.link].begin(fault)
        elif fault.kind in {"pause", "clock"}:
            for service in filter(fault.processes.__contains__, wiring.SERVICES):
                self.services.send(service, signal.SIGSTOP)
        elif isinstance(fault, faults.ProcessFault):
            how = signal.SIGKILL if fault.kind == "kill" else signal.SIGTERM
            await self.services.stop(faults.SERVICE_OF[fault.process], how)
        elif isinstance(fault, faults.Sensor):
            await self._set_sensor(fault.output, SensorFault(_SHOWN[fault.shows], fault.value or 0.0))
        elif isinstance(fault, faults.BoundaryFault):
            before = await self._give(fault.target, fault.value)
            self._given_before.setdefault(fault.target, before)
        elif isinstance(fault, faults.WrongModel):
            await self.services.stop("optimizer_plc", signal.SIGTERM)
            model = {f"{config.PREFIX}MODEL__FILE": str(self.folder / WRONG_MODEL)}
            await self.services.start("optimizer_plc", model, may_end=True)

    async def end(self, fault: faults.AnyFault) -> str | None:
        """Take a fault back; return the service that has been started again, if one has."""
        if isinstance(fault, faults.LinkFault):
            self.links.by_link[fault.link].end(fault)
        elif fault.kind in {"pause", "clock"}:
            for service in filter(fault.processes.__contains__, wiring.SERVICES):
                self.services.send(service, signal.SIGCONT)
        elif isinstance(fault, faults.ProcessFault):
            service = faults.SERVICE_OF[fault.process]
            await self.services.start(service)
            return service
        elif isinstance(fault, faults.Sensor):
            await self._set_sensor(fault.output, SensorFault(SensorFaultKind.NONE, 0.0))
        elif isinstance(fault, faults.BoundaryFault):
            await self._give(fault.target, self._given_before.pop(fault.target))
        elif isinstance(fault, faults.WrongModel):
            await self.services.stop("optimizer_plc", signal.SIGTERM)
            await self.services.start("optimizer_plc")
            return "optimizer_plc"
        return None

    async def _give(self, target: str, value: float) -> float:
        """Change one of a refrigerator's surroundings; return its old value."""

        async def write() -> float:
            given = await self.plant.read(Surroundings)
            before = getattr(given, target)
            await self.plant.write(given._replace(**{target: type(before)(value)}))
            return float(before)

        return await _insisted(write, f"{target} = {value:g}")

    async def _set_sensor(self, output: str, fault: SensorFault) -> None:
        row = self.plant.process.output_names.index(output)
        await _insisted(lambda: self.plant.write_rows([fault], row), f"sensor fault for {output}")


async def _insisted(request: Callable[[], Awaitable[T]], what: str) -> T:
    """Return the answer to a request, which is repeated for a while."""
    reason = "no answer in time"
    for _ in range(20):
        try:
            async with asyncio.timeout(session.CONTACT_S):
                return await request()
        except (errors.PeerUnreachableError, errors.RequestRefusedError) as error:
            reason = str(error)
        except TimeoutError:
            pass
        await asyncio.sleep(0.5)
    raise errors.LinkError(f"the plant did not accept {what}: {reason}")


class Moment(NamedTuple):
    """The beginning or the end of a fault."""

    tick: int
    """Tick before which it is due."""
    is_begin: bool
    fault: faults.AnyFault
    due_s: float | None = None
    """Real time since the start of the session at which it is due in any case."""


class Timeline:
    """Faults that are still to come; `factor`: seconds of plant time in a second in real time, None in lock-step."""

    def __init__(self, faults: Iterable[faults.AnyFault], factor: float | None) -> None:
        self._factor = factor
        self._begins = [Moment(fault.tick, True, fault) for fault in faults]  # noqa: FBT003 - a NamedTuple's field
        self.on: list[Moment] = []
        """Ends of the faults that are on, the next one first."""

    @property
    def next_tick(self) -> int | None:
        """The tick of the next moment; None when there is none."""
        return min((moment.tick for moment in [*self._begins[:1], *self.on[:1]]), default=None)

    def left_s(self, seconds: float) -> float | None:
        """Return the real time until an end is due by the clock; None when there is none."""
        due = [end.due_s for end in self.on if end.due_s is not None]
        return max(0.001, min(due) - seconds) if due else None

    def due(self, tick: int, seconds: float) -> Moment | None:
        """Take out and return a moment that is due; ends come before beginnings."""
        for end in self.on:
            if tick >= end.tick or (end.due_s is not None and seconds >= end.due_s):
                return self.take(end)
        if self._begins and tick >= self._begins[0].tick:
            return self._begins.pop(0)
        return None

    def take(self, end: Moment) -> Moment:
        """Take out the end of a fault."""
        self.on.remove(end)
        return end

    def begun(self, moment: Moment, seconds: float) -> None:
        """A fault has begun; its end is to come."""
        fault = moment.fault
        due_s = None if self._factor is None else seconds + fault.duration_s / self._factor
        self.on.append(Moment(moment.tick + fault.end_tick - fault.tick, False, fault, due_s))  # noqa: FBT003
        self.on.sort(key=lambda end: end.tick)


@dataclass
class Mark:
    """A fault as it really was."""

    fault: faults.AnyFault
    begin: int
    """Last tick that was seen before it began."""
    end: int | None = None
    """Tick at which it ended, and what it had stopped answered again."""
    first_event: int = 0
    """Index in `ChaosTrace.events` of the first one after its beginning. Ticks alone are ambiguous: a control PLC that
    was restarted resumes one tick back."""
    done: int | None = None
    """First tick that was seen when it had been brought about: a process had ended by then."""


class Resources(NamedTuple):
    """Resources that the processes use at one tick."""

    tick: int
    seconds: float
    """Real time from the start of the session."""
    rss_mb: dict[str, float]
    """Resident memory of those that run, by service."""


@dataclass
class ChaosTrace(Sink):
    """Collects during a run; ticks that were not recorded stay NaN."""

    ticks: int
    process: declaration.Process
    events: list[common.Event] = field(default_factory=list)
    """Events of the control PLC, in the order of arrival."""
    alarms: list[common.Alarm] = field(default_factory=list)
    ladder: control_plc.LadderStatus | None = None
    marks: list[Mark] = field(default_factory=list)
    resources: list[Resources] = field(default_factory=list)
    log_lines: dict[str, int] = field(default_factory=dict)
    lost_contacts: int = 0
    """Requests of the rig's own that were not answered."""
    seconds: float = 0.0
    """Real time of the run."""

    def __post_init__(self) -> None:
        sizes = (1, len(self.process.inputs), len(self.process.outputs), len(self.process.states))
        self._rows = [np.full((self.ticks, size), np.nan, dtype=np.float32) for size in sizes]

    def sample(self, sample: PlantSample) -> None:
        """Take a tick; a tick that is done again replaces what was there."""
        for rows, values in zip(self._rows, ((sample.load,), sample.u, sample.y, sample.x), strict=True):
            rows[sample.tick] = np.array(values)

    def event(self, service: str, event: common.Event) -> None:
        """Take an event of a journal."""
        if service == CONTROL:
            self.events.append(event)

    def modes(self, first: int = 0, last: int | None = None) -> list[common.Event]:
        """Return the changes of mode among the events from one index to before another."""
        return [event for event in self.events[first:last] if event.kind == common.EventKind.MODE]

    @property
    def missing(self) -> int:
        """Ticks of which there is no sample."""
        return int(np.isnan(self._rows[0]).sum())

    def recording(self) -> Recording:
        """Return the physical trace in the form of an ordinary run's."""
        load, u, y, x = self._rows
        return Recording(load[:, 0], u, y, x, [], LinkStatistics())


def resident_mb(services: networked_run.LocalServices) -> dict[str, float]:
    """Return the resident memory of the services that run, where the system reports it (Linux)."""
    sizes = {}
    for service, process in services.processes.items():
        with contextlib.suppress(OSError):
            found = re.search(r"VmRSS:\s*(\d+) kB", Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8"))
            if found:
                sizes[service] = int(found[1]) / 1024
    return sizes


ShowProgress = Callable[[int, control_plc.LadderStatus | None, list[str]], None]
"""Takes the plant's tick, the state of the control PLC (None while it does not answer), and the faults that are on."""

STANDSTILL_PATIENCE_S: Final = 60.0  # a rig that does not move for so long without a fault is given up
RESTART_PATIENCE_S: Final = 90.0
PRESENCE_S: Final = 10.0
"""Longest real time after a fault, in lock-step, until the control PLC detects the optimiser, s."""
RESOURCE_TICKS: Final = 1200
LOOK_S: Final = 0.005


@dataclass
class FaultSequencer:
    """Takes a session from fault to fault."""

    plan: faults.ChaosPlan
    services: networked_run.LocalServices
    client: session.SessionClient
    injector: Injector
    trace: ChaosTrace
    progress: ShowProgress
    tick: int = 0
    _marks: dict[int, Mark] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._timeline = Timeline(self.plan.schedule(), factor=self.plan.factor if self.plan.realtime else None)
        self._began = self._stopped_since = time.monotonic()

    async def run(self) -> None:
        """Drive the session to its end."""
        while (moment := await self._next_moment()) is not None:
            if moment.is_begin:
                await self._begin(moment)
            else:
                await self._end(moment)
            self._stopped_since = time.monotonic()
        control, contact = self.client.control, self.client.contact
        self.trace.alarms = (
            await contact(control.read_rows(common.Alarm, 0, len(common.alarms_of(control.process)))) or []
        )
        await self.client.conclude()

    def finish(self) -> None:
        """Record the state at the end, however the run ended."""
        self.trace.seconds = self._seconds
        logs = {service: self.services.log(service).read_bytes() for service in wiring.SERVICES}
        self.trace.log_lines = {service: log.count(b"\n") for service, log in logs.items()}
        self.trace.lost_contacts = self.client.lost_contacts

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
            if self.tick >= self.plan.ticks:
                return None
            if not self.plan.realtime:
                await self.client.grant(min(self._timeline.next_tick or self.plan.ticks, self.plan.ticks))
            await asyncio.sleep(LOOK_S)

    async def _look(self) -> control_plc.LadderStatus | None:
        """Record what has happened; return the state of the control PLC, None while it does not answer."""
        tick = await self.client.look()
        ladder = await self.client.ladder()
        if tick is not None and tick != self.tick:
            self.tick, self._stopped_since = tick, time.monotonic()
        self.trace.ladder = ladder or self.trace.ladder
        resources = self.trace.resources
        if not resources or self.tick - resources[-1].tick >= RESOURCE_TICKS:
            resources.append(Resources(self.tick, self._seconds, resident_mb(self.services)))
        self.progress(self.tick, ladder, [moment.fault.label for moment in self._timeline.on])
        return ladder

    def _cut_short(self) -> Moment | None:
        """Return the end of a fault that stops plant time. Raises LinkError if plant time stopped without a fault."""
        stopped_s = time.monotonic() - self._stopped_since
        for end in self._timeline.on:
            bearable = self.plan.standstill_s
            if end.fault.processes & {"plant", "control_plc"}:  # they advance plant time in lock-step
                bearable = min(bearable, end.fault.duration_s)
            if not self.plan.realtime and stopped_s > bearable:
                return self._timeline.take(end)
        tick_s = self.plan.process.tick_s
        if not self._timeline.on and stopped_s > max(STANDSTILL_PATIENCE_S, 4 * tick_s / self.plan.factor):
            raise errors.LinkError(
                f"plan {self.plan.name}: the plant has been at {self.tick * tick_s:g} s for {stopped_s:.0f} s "
                f"without a fault: see {self.services.log('control_plc')}"
            )
        return None

    async def _begin(self, moment: Moment) -> None:
        fault = moment.fault
        if isinstance(fault, faults.ProcessFault) and fault.offset_ms:
            if not self.plan.realtime:
                await self.client.grant(min(fault.end_tick, self.plan.ticks))  # the rig moves on until the signal comes
            await asyncio.sleep(fault.offset_ms / 1000)
            await self._look()
        mark = Mark(fault, begin=self.tick, first_event=len(self.trace.events))
        self._marks[id(fault)] = mark
        self.trace.marks.append(mark)
        await self.injector.begin(fault)
        await self._look()
        mark.done = self.tick
        if isinstance(fault, faults.WrongModel) and not self.plan.realtime:
            await self._hold_time(lambda _: self.services.ended("optimizer_plc"))  # which it does, if it is refused
        self._timeline.begun(moment, self._seconds)

    async def _end(self, moment: Moment) -> None:
        mark = self._marks.pop(id(moment.fault))
        started = await self.injector.end(moment.fault)
        if started is not None:
            since = time.monotonic()
            while await self.client.contact(self.client.clients[started].read(common.Identity)) is None:
                if time.monotonic() - since > RESTART_PATIENCE_S:
                    raise errors.LinkError(
                        f"after '{moment.fault.label}' the {started} service does not answer: see its log"
                    )
                if self.plan.realtime:
                    await self._look()
                await asyncio.sleep(LOOK_S)
        if not self.plan.realtime and not self._timeline.on:
            await self._hold_time(lambda ladder: ladder is not None and bool(ladder.optimizer))
        await self._look()
        mark.end = self.tick

    async def _hold_time(self, until: Callable[[control_plc.LadderStatus | None], bool]) -> None:
        """Hold plant time in lock-step until something is so; without an optimiser it runs as fast as it can."""
        since = time.monotonic()
        while time.monotonic() - since < PRESENCE_S:
            if until(await self._look()):
                return
            await asyncio.sleep(LOOK_S)


SLOWEST: Final = 20.0  # seconds of plant time in a second that lock-step should reach with proxies and all


async def conduct(
    plan: faults.ChaosPlan, scenario: Scenario, settings: Settings, trace: ChaosTrace, progress: ShowProgress,
    recorder: Recorder, folder: Path,
) -> None:  # fmt: skip
    """Run a plan on new services. Raises LinkError: one ended by itself, plant time stopped, or it took too long."""
    schedule, speed = plan.schedule(), plan.factor / 2 if plan.realtime else SLOWEST
    patience_s = 300.0 + plan.duration_s / speed + sum(60.0 + fault.duration_s / speed for fault in schedule)
    if any(isinstance(fault, faults.WrongModel) for fault in schedule):  # not while the clock is running
        await asyncio.to_thread(save_wrong_model, settings.model.file, folder / WRONG_MODEL)
    copied = with_copied_load(settings, scenario.load, folder)
    async with contextlib.AsyncExitStack() as stack:
        links = proxy.LinkProxies(str(plan.seed))
        retained = wiring.retaining(copied, folder, always=True)
        services = await stack.enter_async_context(networked_run.LocalServices(retained, folder / "logs", links=links))
        client = session.SessionClient(services.endpoints, settings, tolerant=True)
        stack.callback(client.close)
        await services.during(client.connect(wiring.START_PATIENCE_S))
        await links.connect()
        await services.during(client.begin(scenario, recorder))
        injector = Injector(services, links, client.plant, folder)
        driver = FaultSequencer(plan, services, client, injector, trace, progress)
        try:
            async with asyncio.timeout(patience_s):
                await services.during(driver.run())
        except TimeoutError:
            raise errors.LinkError(
                f"plan {plan.name} has taken {patience_s:.0f} s of real time and is at "
                f"{driver.tick * plan.process.tick_s:g} s: see the logs in {folder / 'logs'}"
            ) from None
        finally:
            driver.finish()
            await client.last_look()
