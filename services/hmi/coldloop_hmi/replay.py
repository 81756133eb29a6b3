"""Replays a recorded run into a model, at any speed: the page is the same as that of a rig that is up."""

import asyncio
import math
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

from aiohttp import web
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coldloop.process.declaration import Process
from coldloop.process.station import STATION_VALVE_NAMES
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import LadderStatus, ProcessNow
from coldloop.registers.optimizer_plc import OperatingLimits, Optimization, UpdatingRuleStatus
from coldloop.registers.plant import LoadStatus, StationSample, StationStatus
from coldloop.registers.safety import Alarm
from coldloop_hmi.guard import refusal
from coldloop_hmi.page_server import PageServer, PageSite
from coldloop_hmi.process_image import JournalEntry, Model
from coldloop_hmi.settings import HmiSection
from coldloop_hmi.signals import SOUND, Doubts

STEP_S: Final = 0.1
MOST_AT_ONCE: Final = 400
"""Ticks that one step of a fast replay draws; of more some are left out."""


class ReplayFrame(NamedTuple):
    """One tick of a run."""

    process: ProcessNow
    mode: int
    cause: int
    since: int
    """Tick at which the mode began."""
    doubts: Doubts = SOUND
    """Outputs whose readings were in doubt. The process has the true value."""
    station: StationSample | None = None
    """Sample of the station of a whole refrigerator."""


class RecordedRun(Protocol):
    """Recorded run, as a replay needs it."""

    name: str
    process: Process
    ticks: int
    """Ticks that were recorded, from 0 on."""
    updates: Sequence[Optimization]
    events: Sequence[JournalEntry]
    """Events in the order of their ticks."""
    rule: UpdatingRuleStatus
    """Rule that decided the updating period."""
    limits: OperatingLimits
    configuration: Mapping[str, Any]
    """Values of the configuration by dotted key."""

    def frame(self, tick: int) -> ReplayFrame | None:
        """Return one tick; None if it is missing in the recording."""

    def alarms(self, events: Sequence[JournalEntry]) -> list[Alarm]:
        """Return the alarms after these events, by number."""


class ReplayRequest(BaseModel):
    """Request of a browser to a replay."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    playing: bool | None = None
    speed: float | None = Field(default=None, gt=0, le=10_000)
    tick: int | None = Field(default=None, ge=0)


class Replay:
    """Plays a run into a model, whose trends have `kept_s` of it."""

    def __init__(self, run: RecordedRun, model: Model, kept_s: float) -> None:
        self._run = run
        self._model = model
        self._kept_ticks = round(kept_s / run.process.tick_s)
        self._playing = False
        self._speed = 20.0
        self._tick = -1
        self._in_gap = False
        """The data read last are missing in the recording."""
        model.put("control_plc", Identity(session=1))
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
            return refusal(422, f"{'.'.join(map(str, first['loc'])) or 'request'}: {first['msg']}")
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
        updates, events = self._run.updates, self._run.events
        model.put_updates(updates[: bisect_right(updates, started, key=lambda update: update.tick)])
        model.put_events(events[: bisect_right(events, started, key=lambda entry: entry.tick)])
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
            self._put(newest)
        updates, events = run.updates, run.events
        first, last = (bisect_right(updates, one, key=lambda update: update.tick) for one in (before, tick))
        model.put_updates(updates[first:last])
        first, last = (bisect_right(events, one, key=lambda entry: entry.tick) for one in (before, tick))
        model.put_events(events[first:last])
        model.put_alarms(run.alarms(events[:last]))

    def _put(self, frame: ReplayFrame) -> None:
        model, process = self._model, frame.process
        model.put("control_plc", LadderStatus(frame.mode, frame.cause, frame.since, 1, frame.doubts.bad, 0))
        model.recorded_doubts = frame.doubts
        model.put("control_plc", process)
        model.put("plant", LoadStatus(watts=process.load))
        if (one := frame.station) is not None:  # what its controller asked for is not recorded
            unknown = (math.nan,) * len(STATION_VALVE_NAMES)
            model.put("plant", StationStatus(one.tick, one.mode, one.alarms, one.signals, unknown))

    def _show(self) -> None:
        for service in self._model.maps:
            self._model.put(service, Identity(session=1, tick=self._tick))
            self._model.heard(service)
        self._model.put("plant", SessionPace(1, 1, self._speed, int(not self._playing)))
        self._model.replay = {
            "name": self._run.name, "playing": self._playing, "speed": self._speed, "tick": self._tick,
            "last_tick": self._run.ticks - 1,
        }  # fmt: skip


async def serve_replays(runs: Sequence[RecordedRun], settings: HmiSection, announce: Callable[[str], None]) -> None:
    """Serve one run, or several side by side, until cancelled.

    Raises:
        PortInUseError: Another program listens there.
        ConfigurationError: A file of the settings cannot be used.
    """
    models = [Model(run.process, time.monotonic, settings.kept_s) for run in runs]
    replays = [Replay(run, model, settings.kept_s) for run, model in zip(runs, models, strict=True)]
    server = PageServer(settings, *(PageSite(m, None, r.routes()) for m, r in zip(models, replays, strict=True)))
    await server.start()
    announce(server.address)
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(server.run(), name="streams")
            for replay in replays:
                tasks.create_task(replay.run(), name="replay")
    finally:
        await server.close()
