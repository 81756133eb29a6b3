"""Requests that only read: state, stream, trends, explanations, alarms, events, metrics."""

import asyncio
import csv
import io
import math
import time
from collections.abc import Mapping
from contextlib import AbstractAsyncContextManager, suppress
from typing import Final

from aiohttp import BasicAuth, hdrs, web

from coldloop.service.metrics import exposition
from coldloop.service.metrics_server import CONTENT_TYPE
from coldloop_hmi.assets import (
    JSON,
    StreamCompression,
    compressed_answer,
    html_file,
    kept_answer,
    static_files,
    takes_gzip,
)
from coldloop_hmi.broadcast import Broadcast
from coldloop_hmi.documents import (
    alarms_document,
    catalog,
    encoded,
    event_document,
    explanation_document,
    services_document,
    state_document,
    trend_document,
)
from coldloop_hmi.guard import Guard, add_headers, refusal
from coldloop_hmi.long_reads import LongReads
from coldloop_hmi.page_metrics import page_families
from coldloop_hmi.process_image import JournalEntry, Model
from coldloop_hmi.settings import HmiSection

POINTS: Final = 800
MOST_POINTS: Final = 4000
PENS: Final = 8
"""Signals of one trend beside those that the page draws without being asked."""
ROWS_AT_ONCE: Final = 500
"""Rows of a table that are made and sent at a time."""
WINDOW_S: Final = 300.0
EVENTS_SHOWN: Final = 500
CACHED: Final = 16
LONGEST_NAME: Final = 60
STALLED_S: Final = 20.0
"""A browser that takes nothing for so long loses its stream, so that another one can look."""


class Reading:
    """Answers requests that only read.

    Args:
        settings: Of the page.
        model: What is shown.
        broadcast: The stream of changes.
        guard: Knows who is asking.
        replay: The model shows a recorded run.
    """

    def __init__(self, settings: HmiSection, model: Model, broadcast: Broadcast, guard: Guard, *, replay: bool) -> None:
        self._settings = settings
        self._model = model
        self._broadcast = broadcast
        self._guard = guard
        process, self._tick_s = model.process, model.process.tick_s
        drawn = (process.measured_disturbances, process.inputs, process.banded, model.trends.station_names)
        self._most_names = PENS + 1 + sum(map(len, drawn))
        self._long_reads = LongReads(time.monotonic)
        self._catalog = encoded(catalog(model, training=settings.training and not replay, replay=replay))
        self._trends: dict[tuple[object, ...], bytes] = {}

    def routes(self) -> list[web.AbstractRouteDef]:
        """Return what is served."""
        return [
            html_file("index.html"),
            *static_files(),
            web.get("/mimic.svg", self.mimic),
            web.get("/api/catalog", self.catalog),
            web.get("/api/state", self.state),
            web.get("/api/stream", self.stream, allow_head=False),
            web.get("/api/trend", self.trend),
            web.get("/api/trend.csv", self.trend_table),
            web.get("/api/explanation", self.explanation),
            web.get("/api/alarms", self.alarms),
            web.get("/api/events", self.events),
            web.get("/api/events.csv", self.events_table),
            web.get("/healthz", self.health),
            web.get("/metrics", self.metrics),
        ]

    async def mimic(self, _request: web.Request) -> web.Response:
        """Answer with the drawing that the process brings; those of the cold box are static files."""
        answer = web.Response(text=self._model.process.drawing, content_type="image/svg+xml")
        add_headers(answer)
        return answer

    async def catalog(self, request: web.Request) -> web.Response:
        """Answer with what the page is made from."""
        return kept_answer(request, self._catalog, JSON)

    async def state(self, request: web.Request) -> web.Response:
        """Answer with the whole state."""
        return compressed_answer(request, encoded(state_document(self._model)))

    async def stream(self, request: web.Request) -> web.StreamResponse:
        """Answer with the state and its changes, as server-sent events, until the browser goes or its session ends."""
        stream = self._broadcast.begin(self._guard.party(request))
        if stream is None:
            return refusal(503, f"{len(self._broadcast)} browsers are connected: close some, or raise hmi.browsers")
        answer = web.StreamResponse(headers={hdrs.CONTENT_TYPE: "text/event-stream"})
        compression = StreamCompression() if takes_gzip(request) else None
        if compression is not None:
            answer.headers[hdrs.CONTENT_ENCODING] = "gzip"
        add_headers(answer)
        try:
            await answer.prepare(request)
            async for message in self._broadcast.messages(stream):
                if not self._settings.login.anonymous_view and self._guard.session(request) is None:
                    break
                async with asyncio.timeout(STALLED_S):
                    await answer.write(compression.message(message) if compression else message)
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            pass
        return answer

    def _window(self, query: Mapping[str, str]) -> tuple[list[str], int, int, int]:
        """Return names, first tick, last tick and points of a trend.

        Raises:
            HTTPBadRequest: They are not numbers, or there is no such signal.
        """
        asked = [name for name in query.get("names", "").split(",") if name]
        names = list(dict.fromkeys(asked or (*(one.name for one in self._model.process.banded), "load")))
        unknown = [name for name in names if name not in self._model.trends.names]
        if unknown:
            raise web.HTTPBadRequest(reason=f"unknown trend {printable(unknown[0])}")
        if len(names) > self._most_names:
            raise web.HTTPBadRequest(reason=f"a trend has at most {self._most_names} signals, not {len(names)}")
        try:
            seconds = min(float(query.get("seconds", WINDOW_S)), self._settings.kept_s)
            end = round(float(query["end"]) / self._tick_s) if "end" in query else self._model.tick
            points = max(10, min(int(query.get("points", POINTS)), MOST_POINTS))
            return names, end - round(seconds / self._tick_s), end, points
        except (ValueError, OverflowError):
            raise web.HTTPBadRequest(reason="seconds, end and points must be numbers") from None

    async def trend(self, request: web.Request) -> web.Response:
        """Answer with what is drawn in a window; browsers that ask for the same share one answer."""
        names, start, end, points = self._window(request.query)
        is_brief = request.query.get("brief") == "1"
        key = (
            *names,
            start,
            end,
            points,
            is_brief,
            len(self._model.updates),
            self._model.events_told,
            self._model.is_planned,
        )
        if key not in self._trends:
            async with self._turn(request):
                document = encoded(trend_document(self._model, names, start, end, points, is_brief=is_brief))
                answer = compressed_answer(request, document)  # takes time, too
            while len(self._trends) >= CACHED:
                self._trends.pop(next(iter(self._trends)))
            self._trends[key] = document
            return answer
        return compressed_answer(request, self._trends[key])

    def _turn(self, request: web.Request) -> AbstractAsyncContextManager[None]:
        return self._long_reads.turn(has_session=self._guard.party(request).has_session)

    async def trend_table(self, request: web.Request) -> web.StreamResponse:
        """Answer with every sample of a window as CSV, some rows at a time."""
        names, start, end, _ = self._window(request.query)
        answer = web.StreamResponse(headers=csv_headers("coldloop-trend.csv"))
        add_headers(answer)
        await answer.prepare(request)
        await answer.write(",".join(["time_s", *names, "quality"]).encode() + b"\n")
        with suppress(ConnectionError, TimeoutError):  # the client has gone
            while start <= end:
                async with self._turn(request):
                    rows, start = self._trend_rows(names, start, end)
                async with asyncio.timeout(STALLED_S):
                    await answer.write(rows)
        return answer

    def _trend_rows(self, names: list[str], start: int, end: int) -> tuple[bytes, int]:
        """Return some rows from tick `start` on, and the tick that the next ones begin with: after `end` at the end."""
        trends = self._model.trends
        rows = trends.between(start, end)
        following = end + 1 if len(rows) <= ROWS_AT_ONCE else trends.ticks[rows[ROWS_AT_ONCE]]
        rows = rows[:ROWS_AT_ONCE]
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        for row, *values in zip(rows, *(trends.column(name, rows) for name in names), strict=True):
            doubts = " ".join(f"{name}={one}" for name, one in trends.doubts_at(row).items() if name in names)
            numbers = ("" if math.isnan(value) else f"{value:.7g}" for value in values)
            writer.writerow([trends.ticks[row] * self._tick_s, *numbers, doubts])
        return text.getvalue().encode(), following

    async def explanation(self, request: web.Request) -> web.Response:
        """Answer with the explanation of an updating period."""
        number, at = request.query.get("update", ""), request.query.get("at", "")
        try:
            at_tick = round(float(at) / self._tick_s) if at else None
            document = explanation_document(self._model, int(number) if number else None, at_tick)
        except (ValueError, OverflowError):
            raise web.HTTPBadRequest(reason="update and at must be numbers") from None
        if document is None:
            wanted = printable(number or at) or "(the last one)"
            return refusal(404, f"update {wanted} is not known: only the newest are kept")
        return compressed_answer(request, encoded(document))

    async def alarms(self, request: web.Request) -> web.Response:
        """Answer with all alarms."""
        return compressed_answer(request, encoded({"alarms": alarms_document(self._model)}))

    def _events(self, query: Mapping[str, str]) -> list[JournalEntry]:
        """Return the events that a search finds, the newest first.

        Raises:
            HTTPBadRequest: Its times are not numbers.
        """
        wanted, service = query.get("search", "").lower(), query.get("service", "")
        try:
            first, last = (float(query.get(name) or end) for name, end in (("from", -math.inf), ("to", math.inf)))
        except ValueError:
            raise web.HTTPBadRequest(reason="from and to must be times in s") from None
        found = []
        for entry in reversed(self._model.events):
            if (service and entry.service != service) or not first <= entry.tick * self._tick_s <= last:
                continue
            if not wanted or wanted in f"{entry.text.sentence} {entry.utc} {entry.service}".lower():
                found.append(entry)
        return found

    async def events(self, request: web.Request) -> web.Response:
        """Answer with a page of the events that a search finds; page 0 is the newest."""
        try:
            start = EVENTS_SHOWN * max(0, int(request.query.get("page") or 0))
        except ValueError:
            raise web.HTTPBadRequest(reason="page must be a whole number") from None
        async with self._turn(request):
            found = self._events(request.query)
            shown = [*(event_document(one, self._tick_s) for one in found[start : start + EVENTS_SHOWN])]
            pages = -(-len(found) // EVENTS_SHOWN)
            document = encoded({"found": len(found), "first": start + 1, "pages": pages, "events": shown})
            return compressed_answer(request, document)

    async def events_table(self, request: web.Request) -> web.Response:
        """Answer with all events that a search finds as CSV."""
        async with self._turn(request):
            return self._events_as_table(self._events(request.query))

    def _events_as_table(self, found: list[JournalEntry]) -> web.Response:
        text = io.StringIO()
        names = (
            "service", "number", "boot", "utc", "tick", "time_s", "kind", "subject", "cause", "value", "unit", "who",
        )  # fmt: skip
        writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for entry in found:
            row = event_document(entry, self._tick_s)
            writer.writerow({name: safe_cell(row[name]) for name in names})
        return web.Response(body=text.getvalue().encode(), headers=csv_headers("coldloop-events.csv"))

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
            if auth is None:
                return refusal(401, "log in first, or send name and password (basic)")
            user = await self._guard.log_in(auth.login, auth.password, request.remote or "", self._guard.scrapes)
            if isinstance(user, web.Response):
                return user
        body = exposition(page_families(self._model, len(self._broadcast)))
        return compressed_answer(request, body, CONTENT_TYPE)


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


def csv_headers(name: str) -> dict[str, str]:
    """Return the headers of a file of comma-separated values."""
    return {
        hdrs.CONTENT_TYPE: "text/csv; charset=utf-8",
        hdrs.CONTENT_DISPOSITION: f'attachment; filename="{name}"',
    }


def printable(text: str) -> str:
    """Return a request's text for a message: short, and on one line."""
    return "".join(one if one.isprintable() else "?" for one in text[:LONGEST_NAME])
