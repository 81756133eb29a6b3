"""Sources of what the page shows: pollers of a rig that is up, or a recorded run that is replayed.

A poller reads one service over Modbus, once for all browsers, and keeps polling a silent one. A replay plays a run into
a model, at any speed: the page is the same.
"""

import asyncio
import logging
import math
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple, Protocol

from aiohttp import web
from pydantic import BaseModel, Field, ValidationError

from coldloop.errors import DamagedAnswerError, LinkError, RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.settings import Endpoint
from coldloop.operating.observer import JournalReader, UpdateReader, read_alarms
from coldloop.process import cold_box, declaration
from coldloop.registers import common, control_plc, optimizer_plc, plant
from coldloop.registers.common import Alarm
from coldloop_hmi import documents, guard, operator_desk, page_server, process_image
from coldloop_hmi.settings import HmiSection, HmiSettings

log = logging.getLogger("coldloop.hmi")

FAST: Final[dict[str, tuple[type[tuple[Any, ...]], ...]]] = {
    "plant": (common.SessionPace, plant.LoadStatus),
    "control_plc": (
        control_plc.LadderStatus,
        control_plc.ProcessNow,
        control_plc.Status,
        control_plc.PlantLinkStatus,
        control_plc.Operator,
    ),
    "optimizer_plc": (optimizer_plc.ControlLinkStatus,),
}  # fmt: skip
"""Records that are read in each look; the mode is read before the process that is drawn with it."""
SLOW_S: Final = 1.0
"""Time between two looks at a record that is not among these."""
ALARMS_S: Final = 0.25
RETRY_S: Final = 0.25
AT_ONCE: Final = 64
"""When there are more new updates or events, as with a high factor, only the newest are read."""


async def serve(settings: HmiSettings) -> None:
    """Serve the page until cancelled.

    Raises:
        ConfigurationError: A file of the settings cannot be used.
        PortInUseError: Another program listens there.
    """
    hmi = settings.hmi
    model = process_image.Model(settings.process, time.monotonic, hmi.kept_s)
    ends: dict[str, Endpoint] = {service: getattr(hmi, service) for service in model.maps}
    tls = {"tls": hmi.operator_tls} if hmi.operator_tls else {}
    operated = {service: end.model_copy(update=tls) for service, end in ends.items()}
    desk = operator_desk.OperatorDesk(operated, model, time.monotonic, training=hmi.training)
    server = page_server.PageServer(hmi, page_server.PageSite(model, desk))
    clients = {service: RegisterClient.at(model.maps[service], end) for service, end in ends.items()}
    pollers = [Poller(service, client, model, hmi.poll_s) for service, client in clients.items()]
    await server.serve(
        [poller.run for poller in pollers],
        lambda: log.info("serving", extra={"host": hmi.host, "port": server.port, "address": server.address}),
    )


class Poller:
    """Reads one service into a model until cancelled, with `poll_s` between two looks."""

    def __init__(self, service: str, client: RegisterClient, model: process_image.Model, poll_s: float) -> None:
        self._service = service
        self._client = client
        self._model = model
        self._poll_s = poll_s
        self._journal = JournalReader(client, queries=False, most=AT_ONCE)
        self._updates = UpdateReader(client, lambda update: model.put_updates([update]), most=AT_ONCE)
        frequent = (common.Identity, common.JournalPage, *FAST[service])
        self._slow = [
            block.record for block in process_image.shown_blocks(model.maps[service]) if block.record not in frequent
        ]
        self._slow_at = 0.0
        self._alarms_at = 0.0
        self._checked = False
        self._configured: common.ConfigurationDigest | None = None
        self._told = ""

    async def run(self) -> None:
        """Read on and on."""
        try:
            while True:
                begun = time.monotonic()
                try:
                    await self._look()
                except LinkError as error:
                    self._lose(error)
                    await asyncio.sleep(RETRY_S)
                else:
                    self._model.heard(self._service)
                    if self._told:
                        self._told = ""
                        log.info("answers", extra={"peer": self._service})
                    await asyncio.sleep(max(0.005, begun + self._poll_s - time.monotonic()))
        finally:
            self._client.close()

    def _lose(self, error: LinkError) -> None:
        self._client.close()
        self._checked = False
        self._journal.connection_lost()
        self._model.silent(self._service, str(error))
        if str(error) != self._told:
            self._told = str(error)
            log.warning("silent", extra={"peer": self._service, "reason": self._told})

    async def _look(self) -> None:
        model, service, client = self._model, self._service, self._client
        if not self._checked:
            await client.connect(0.0)
            self._checked = True
            self._slow_at = 0.0
        identity = await client.read(common.Identity)
        model.put(service, identity)
        for record in FAST[service]:
            model.put(service, await client.read(record))
        if service == "plant" and model.configuration.get(documents.KIND) == documents.REFRIGERATOR:
            model.put(service, await client.read(plant.StationStatus))
        if service == "optimizer_plc" and await self._updates.read(identity):
            model.put(service, await client.read(optimizer_plc.Prediction))
        now = time.monotonic()
        if service == "control_plc" and now - self._alarms_at >= ALARMS_S:
            self._alarms_at = now
            model.put_alarms(await read_alarms(client))
        if now - self._slow_at >= SLOW_S:
            self._slow_at = now
            await self._read_slow()
        events = await self._journal.read_on()
        model.put(service, self._journal.page)
        model.put_events(process_image.JournalEntry.of(service, event, model.process) for event in events)

    async def _read_slow(self) -> None:
        for record in self._slow:
            with suppress(DamagedAnswerError, RequestRefusedError):  # not sealed: not written yet
                self._model.put(self._service, await self._client.read(record))
        if self._service != "plant":
            return
        digest = self._model.record(self._service, common.ConfigurationDigest)
        if digest is not None and digest != self._configured:
            lines = await self._client.read_rows(common.ConfigurationLine, 0, common.lines_of(digest.length))
            with suppress(ValueError):  # not one of ours, or it has changed meanwhile
                self._model.configuration = common.configuration_of(digest, lines)
                self._configured = digest
        with suppress(RequestRefusedError):  # a plant without sensor faults
            faults = await self._client.read_rows(plant.SensorFault, 0, len(self._model.process.outputs))
            self._model.faulty_sensors = sum(bool(fault.kind) << i for i, fault in enumerate(faults))


STEP_S: Final = 0.1
MOST_AT_ONCE: Final = 400
"""Ticks that one step of a fast replay draws; of more some are left out."""


class ReplayFrame(NamedTuple):
    """One tick of a run."""

    process: control_plc.ProcessNow
    mode: int
    cause: int
    since: int
    """Tick at which the mode began."""
    doubts: process_image.Doubts = process_image.SOUND
    """Outputs whose readings were in doubt. The process has the true value."""
    station: plant.StationSample | None = None
    """Sample of the station of a whole refrigerator."""


class RecordedRun(Protocol):
    """Recorded run, as a replay needs it."""

    name: str
    process: declaration.Process
    ticks: int
    """Ticks that were recorded, from 0 on."""
    updates: Sequence[optimizer_plc.Optimization]
    events: Sequence[process_image.JournalEntry]
    """Events in the order of their ticks."""
    rule: optimizer_plc.UpdatingRuleStatus
    """Rule that decided the updating period."""
    limits: optimizer_plc.OperatingLimits
    configuration: Mapping[str, Any]
    """Values of the configuration by dotted key."""

    def frame(self, tick: int) -> ReplayFrame | None:
        """Return one tick; None if it is missing in the recording."""

    def alarms(self, events: Sequence[process_image.JournalEntry]) -> list[Alarm]:
        """Return the alarms after these events, by number."""


class ReplayRequest(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """Request of a browser to a replay."""

    playing: bool | None = None
    speed: float | None = Field(default=None, gt=0, le=10_000)
    tick: int | None = Field(default=None, ge=0)


class Replay:
    """Plays a run into a model, whose trends have `kept_s` of it."""

    def __init__(self, run: RecordedRun, model: process_image.Model, kept_s: float) -> None:
        self._run = run
        self._model = model
        self._kept_ticks = round(kept_s / run.process.tick_s)
        self._playing = False
        self._speed = 20.0
        self._tick = -1
        self._in_gap = False
        """The data read last are missing in the recording."""
        model.put("control_plc", common.Identity(session=1))
        model.configuration = run.configuration
        model.put("optimizer_plc", run.rule)
        model.put("optimizer_plc", run.limits)
        self.go_to(0)

    def routes(self) -> tuple[web.AbstractRouteDef, ...]:
        """Return what is served."""
        return (web.get("/api/replay", self.state), web.post("/api/replay", self.steer))

    async def state(self, _request: web.Request) -> web.Response:
        """Answer with where the replay is."""
        return web.json_response(self._model.replay)

    async def steer(self, request: web.Request) -> web.Response:
        """Play, stand still, go elsewhere."""
        try:
            wish = ReplayRequest.model_validate_json(await request.read())
        except ValidationError as error:
            first = error.errors()[0]
            return guard.refusal(422, f"{'.'.join(map(str, first['loc'])) or 'request'}: {first['msg']}")
        if wish.speed is not None:
            self._speed = wish.speed
        if wish.tick is not None:
            self.go_to(min(wish.tick, self._run.ticks - 1))
        if wish.playing is not None:
            self._playing = wish.playing
            if self._playing and self._tick >= self._run.ticks - 1:
                self.go_to(0)
        self._show()
        return web.json_response(self._model.replay)

    async def run(self) -> None:
        """Play until cancelled."""
        position, last = float(self._tick), time.monotonic()
        while True:
            self._show()
            await asyncio.sleep(STEP_S)
            now = time.monotonic()
            if int(position) != self._tick:  # a user has moved the position
                position = float(self._tick)
            if self._playing:
                position = min(self._run.ticks - 1.0, position + (now - last) * self._speed / self._run.process.tick_s)
                self._advance(int(position))
                self._playing = self._tick < self._run.ticks - 1
            last = now

    # -- updates of the model ------------------------------------------------------------------------------------------

    def go_to(self, tick: int) -> None:
        """Show the run up to a tick as if it had just been played until there."""
        model = self._model
        model.trends.clear()
        model.updates.clear()
        model.events.clear()
        self._in_gap = False
        self._tick = max(0, tick - self._kept_ticks) - 1
        started = self._tick
        model.put_updates(self._run.updates[: _count(self._run.updates, started)])
        model.put_events(self._run.events[: _count(self._run.events, started)])
        self._advance(tick, tick - started)

    def _advance(self, tick: int, points: int = MOST_AT_ONCE) -> None:
        if tick <= self._tick:
            return
        run, model, before = self._run, self._model, self._tick
        every = max(1, math.ceil((tick - before) / points))
        newest = None
        for each in (*range(before + 1, tick, every), tick):
            frame = run.frame(each)
            if frame is not None:
                station = frame.station.signals if frame.station else ()
                model.trends.add(frame.process, frame.mode, frame.doubts, station, is_after_gap=self._in_gap)
                newest = frame
            self._in_gap = frame is None
        self._tick = tick
        if newest is not None:  # after a step back it may be the one known
            ladder = (newest.mode, newest.cause, newest.since, 1, newest.doubts.bad, 0)
            model.put("control_plc", control_plc.LadderStatus(*ladder))
            model.recorded_doubts = newest.doubts
            model.put("control_plc", newest.process)
            model.put("plant", plant.LoadStatus(watts=newest.process.load))
            if (one := newest.station) is not None:  # what its controller asked for is not recorded
                unknown = (math.nan,) * len(cold_box.STATION_VALVE_NAMES)
                model.put("plant", plant.StationStatus(one.tick, one.mode, one.alarms, one.signals, unknown))
        model.put_updates(run.updates[_count(run.updates, before) : _count(run.updates, tick)])
        events = run.events[: _count(run.events, tick)]
        model.put_events(events[_count(events, before) :])
        model.put_alarms(run.alarms(events))

    def _show(self) -> None:
        for service in self._model.maps:
            self._model.put(service, common.Identity(session=1, tick=self._tick))
            self._model.heard(service)
        self._model.put("plant", common.SessionPace(1, 1, self._speed, int(not self._playing)))
        self._model.replay = {
            "name": self._run.name, "playing": self._playing, "speed": self._speed, "tick": self._tick,
            "last_tick": self._run.ticks - 1,
        }  # fmt: skip


def _count(rows: Sequence[optimizer_plc.Optimization] | Sequence[process_image.JournalEntry], tick: int) -> int:
    """Return how many of these there are up to a tick."""
    return bisect_right(rows, tick, key=lambda row: row.tick)


async def serve_replays(runs: Sequence[RecordedRun], settings: HmiSection, announce: Callable[[str], None]) -> None:
    """Serve one run, or several side by side, until cancelled.

    Raises:
        PortInUseError: Another program listens there.
        ConfigurationError: A file of the settings cannot be used.
    """
    models = [process_image.Model(run.process, time.monotonic, settings.kept_s) for run in runs]
    replays = [Replay(run, model, settings.kept_s) for run, model in zip(runs, models, strict=True)]
    server = page_server.PageServer(
        settings, *(page_server.PageSite(m, None, r.routes()) for m, r in zip(models, replays, strict=True))
    )
    await server.serve([replay.run for replay in replays], lambda: announce(server.address))
