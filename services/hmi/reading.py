"""Requests that only read: state, stream, trends, explanations, alarms, events, metrics."""

import asyncio
import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from aiohttp import BasicAuth, hdrs, web

from coldloop.metrics import CONTENT_TYPE, exposition
from coldloop.process import TICK_S
from hmi.broadcast import Broadcast
from hmi.documents import (
    alarms_document,
    catalog,
    encoded,
    event_document,
    explanation_document,
    services_document,
    state_document,
    trend_document,
)
from hmi.guard import Guard, add_headers, refusal
from hmi.model import Model, Told
from hmi.page_metrics import page_families
from hmi.settings import HmiSection
from hmi.trends import NAMES
from hmi.users import Users

STATIC: Final = Path(__file__).parent / "static"
POINTS: Final = 800
MOST_POINTS: Final = 4000
WINDOW_S: Final = 300.0
EVENTS_SHOWN: Final = 500
CACHED: Final = 16
STALLED_S: Final = 20.0
"""A browser that takes nothing for so long loses its stream, so that another one can look."""


class Reading:
    """Answers requests that only read.

    Args:
        settings: Of the page.
        model: What is shown.
        broadcast: The stream of changes.
        guard: Knows who is asking.
        users: Who may log in, for `/metrics`.
        replay: The model shows a recorded run.
    """

    def __init__(
        self, settings: HmiSection, model: Model, broadcast: Broadcast, guard: Guard, users: Users, *, replay: bool
    ) -> None:
        self._settings = settings
        self._model = model
        self._broadcast = broadcast
        self._guard = guard
        self._users = users
        self._catalog = encoded(catalog(training=settings.training and not replay, replay=replay))
        self._trends: dict[tuple[object, ...], bytes] = {}

    def routes(self) -> list[web.AbstractRouteDef]:
        """Return what is served."""
        return [
            web.get("/", self.page),
            web.static("/static", STATIC),
            web.get("/api/catalog", self.catalog),
            web.get("/api/state", self.state),
            web.get("/api/stream", self.stream),
            web.get("/api/trend", self.trend),
            web.get("/api/trend.csv", self.trend_table),
            web.get("/api/explanation", self.explanation),
            web.get("/api/alarms", self.alarms),
            web.get("/api/events", self.events),
            web.get("/api/events.csv", self.events_table),
            web.get("/healthz", self.health),
            web.get("/metrics", self.metrics),
        ]

    async def page(self, _request: web.Request) -> web.StreamResponse:
        """Answer with the page."""
        return web.FileResponse(STATIC / "index.html")

    async def catalog(self, _request: web.Request) -> web.Response:
        """Answer with what the page is made from."""
        return json_answer(self._catalog)

    async def state(self, _request: web.Request) -> web.Response:
        """Answer with the whole state."""
        return json_answer(encoded(state_document(self._model)))

    async def stream(self, request: web.Request) -> web.StreamResponse:
        """Answer with the state and its changes, as server-sent events, until the browser goes or its session ends."""
        if self._broadcast.is_full:
            return refusal(503, f"{len(self._broadcast)} browsers look already: close some, or raise hmi.browsers")
        answer = web.StreamResponse(headers={hdrs.CONTENT_TYPE: "text/event-stream"})
        add_headers(answer)
        await answer.prepare(request)
        try:
            async for message in self._broadcast.messages():
                if not self._settings.login.anonymous_view and self._guard.session(request) is None:
                    break
                async with asyncio.timeout(STALLED_S):
                    await answer.write(message)
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            pass
        return answer

    def _window(self, query: Mapping[str, str]) -> tuple[list[str], int, int, int]:
        """Return names, first tick, last tick and points of a trend.

        Raises:
            HTTPBadRequest: They are not numbers, or there is no such signal.
        """
        names = [name for name in query.get("names", "").split(",") if name] or ["L1", "T5", "load"]
        unknown = [name for name in names if name not in NAMES]
        if unknown:
            raise web.HTTPBadRequest(reason=f"no trend is called {unknown[0]}")
        try:
            seconds = min(float(query.get("seconds", WINDOW_S)), self._settings.kept_s)
            end = round(float(query["end"]) / TICK_S) if "end" in query else self._model.tick
            points = max(10, min(int(query.get("points", POINTS)), MOST_POINTS))
            return names, end - round(seconds / TICK_S), end, points
        except (ValueError, OverflowError):
            raise web.HTTPBadRequest(reason="seconds, end and points are numbers") from None

    async def trend(self, request: web.Request) -> web.Response:
        """Answer with what is drawn in a window; browsers that ask for the same share one answer."""
        names, start, end, points = self._window(request.query)
        key = (*names, start, end, points, len(self._model.updates), self._model.events_told)
        if key not in self._trends:
            while len(self._trends) >= CACHED:
                self._trends.pop(next(iter(self._trends)))
            self._trends[key] = encoded(trend_document(self._model, names, start, end, points))
        return json_answer(self._trends[key])

    async def trend_table(self, request: web.Request) -> web.Response:
        """Answer with every sample of a window as CSV."""
        names, start, end, _ = self._window(request.query)
        rows = self._model.trends.between(start, end)
        columns = [self._model.trends.column(name, rows) for name in names]
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["time_s", *names, "substituted"])
        for row, *values in zip(rows, *columns, strict=True):
            bad = " ".join(name for name in self._model.trends.substituted_at(row) if name in names)
            writer.writerow([self._model.trends.ticks[row] * TICK_S, *(f"{value:.7g}" for value in values), bad])
        return csv_answer(text.getvalue(), "coldloop-trend.csv")

    async def explanation(self, request: web.Request) -> web.Response:
        """Answer with why an updating period is as long as it is."""
        number, at = request.query.get("update", ""), request.query.get("at", "")
        try:
            at_tick = round(float(at) / TICK_S) if at else None
            document = explanation_document(self._model, int(number) if number else None, at_tick)
        except (ValueError, OverflowError):
            raise web.HTTPBadRequest(reason="update and at are numbers") from None
        if document is None:
            return refusal(404, f"update {number or at or '(the last one)'} is not known: only the newest are kept")
        return json_answer(encoded(document))

    async def alarms(self, _request: web.Request) -> web.Response:
        """Answer with all alarms."""
        return json_answer(encoded({"alarms": alarms_document(self._model)}))

    def _events(self, query: Mapping[str, str]) -> list[Told]:
        wanted, service = query.get("search", "").lower(), query.get("service", "")
        found = []
        for told in reversed(self._model.events):
            if service and told.service != service:
                continue
            if not wanted or wanted in f"{told.text.sentence} {told.utc} {told.service}".lower():
                found.append(told)
        return found

    async def events(self, request: web.Request) -> web.Response:
        """Answer with the newest events that a search finds."""
        found = self._events(request.query)
        return json_answer(
            encoded({"found": len(found), "events": [event_document(told) for told in found[:EVENTS_SHOWN]]})
        )

    async def events_table(self, request: web.Request) -> web.Response:
        """Answer with all events that a search finds as CSV."""
        found = self._events(request.query)
        text = io.StringIO()
        names = (
            "service",
            "number",
            "boot",
            "utc",
            "tick",
            "time_s",
            "kind",
            "subject",
            "cause",
            "value",
            "unit",
            "who",
        )
        writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for told in found:
            row = event_document(told)
            writer.writerow({name: safe_cell(row[name]) for name in names})
        return csv_answer(text.getvalue(), "coldloop-events.csv")

    async def health(self, _request: web.Request) -> web.Response:
        """Answer 200 while all services answer, 503 otherwise."""
        services = services_document(self._model)
        well = all(one["live"] for one in services.values())
        return web.json_response({"page": "live", "services": services}, status=200 if well else 503)

    async def metrics(self, request: web.Request) -> web.Response:
        """Answer with everything as numbers for Prometheus; with a password where looking needs a login."""
        if not self._settings.login.anonymous_view and self._guard.session(request) is None:
            try:
                auth = BasicAuth.decode(request.headers.get(hdrs.AUTHORIZATION, ""))
            except ValueError:
                auth = None
            address = request.remote or ""
            if auth is None or not self._guard.logins.allows(address):
                return refusal(401, "log in first, or send name and password (basic)")
            if await asyncio.to_thread(self._users.check, auth.login, auth.password) is None:
                self._guard.refuse_login(auth.login, address)
                return refusal(401, "wrong name or password")
            self._guard.logins.give_back(address)
        text = exposition(page_families(self._model, len(self._broadcast)))
        return web.Response(body=text.encode(), headers={hdrs.CONTENT_TYPE: CONTENT_TYPE})


def safe_cell(value: object) -> object:
    """Return a cell of a table that no spreadsheet takes for a formula."""
    return (
        f"'{value}"
        if isinstance(value, str) and value[:1] in {"=", "+", "-", "@", "\t", "\r"} and not _is_number(value)
        else value
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def json_answer(body: bytes) -> web.Response:
    """Return an answer of JSON that is encoded already."""
    return web.Response(body=body, content_type="application/json", charset="utf-8")


def csv_answer(text: str, name: str) -> web.Response:
    """Return a file of comma-separated values."""
    disposition = {hdrs.CONTENT_DISPOSITION: f'attachment; filename="{name}"'}
    return web.Response(text=text, content_type="text/csv", headers=disposition)
