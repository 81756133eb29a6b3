"""The web server of one page: requests that only read, the stream of changes, and its start and end."""

import asyncio
import csv
import io
import math
import ssl
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping
from contextlib import AbstractAsyncContextManager, suppress
from functools import partial
from typing import Any, Final, NamedTuple, cast

from aiohttp import BasicAuth, hdrs, web
from aiohttp.log import server_logger

from coldloop.errors import ConfigurationError, PortInUseError
from coldloop.modbus import connection, tls
from coldloop.service.monitoring import CONTENT_TYPE, exposition
from coldloop_hmi import documents, operator_desk, process_image, users
from coldloop_hmi import guard as guards
from coldloop_hmi.documents import encoded
from coldloop_hmi.guard import Broadcast, Connections, Guard, LongReads, compressed_answer, refusal
from coldloop_hmi.settings import HmiSection

Task = Callable[[], Coroutine[Any, Any, None]]
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
SHORTEST_S: Final = 0.1
"""Between two messages of the stream."""
LONGEST_S: Final = 0.4
"""Without news the stream says that the page lives, and how old everything is."""
SHUTDOWN_S: Final = 0.5
WAITING_S: Final = 30.0
"""A connection without a whole request, or between two, is closed after this time."""
LINGERING_S: Final = 1.0
"""How long the rest of a request that was refused is read, so that the refusal arrives."""


class Reading:
    """Answers requests that only read; with `replay` the model shows a recorded run."""

    def __init__(
        self, settings: HmiSection, model: process_image.Model, broadcast: Broadcast, guard: Guard, *, replay: bool
    ) -> None:
        self._settings = settings
        self._model = model
        self._broadcast = broadcast
        self._guard = guard
        process, self._tick_s = model.process, model.process.tick_s
        drawn = (process.measured_disturbances, process.inputs, process.banded, model.trends.station_names)
        self._most_names = PENS + 1 + sum(map(len, drawn))
        self._long_reads = LongReads(time.monotonic)
        self._catalog = encoded(documents.catalog(model, training=settings.training and not replay, replay=replay))
        self._trends: dict[tuple[object, ...], bytes] = {}

    def routes(self) -> list[web.AbstractRouteDef]:
        """Return what is served."""
        return [
            guards.html_file("index.html"),
            *guards.static_files(),
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
        guards.add_headers(answer)
        return answer

    async def catalog(self, request: web.Request) -> web.Response:
        """Answer with what the page is made from."""
        return guards.kept_answer(request, self._catalog, guards.JSON)

    async def state(self, request: web.Request) -> web.Response:
        """Answer with the whole state."""
        return compressed_answer(request, encoded(documents.state_document(self._model)))

    async def stream(self, request: web.Request) -> web.StreamResponse:
        """Answer with the state and its changes, as server-sent events, until the browser goes or its session ends."""
        stream = self._broadcast.begin(self._guard.party(request))
        if stream is None:
            return refusal(503, f"{len(self._broadcast)} browsers are connected: close some, or raise hmi.browsers")
        answer = web.StreamResponse(headers={hdrs.CONTENT_TYPE: "text/event-stream"})
        compressed = guards.stream_compression() if guards.takes_gzip(request) else None
        if compressed is not None:
            answer.headers[hdrs.CONTENT_ENCODING] = "gzip"
        guards.add_headers(answer)
        try:
            await answer.prepare(request)
            async for message in self._broadcast.messages(stream):
                if not self._settings.login.anonymous_view and self._guard.session(request) is None:
                    break
                async with asyncio.timeout(STALLED_S):
                    await answer.write(compressed(message) if compressed else message)
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
        model = self._model
        state = (len(model.updates), model.events_told, model.is_planned)
        key = (*names, start, end, points, is_brief, *state)
        if key not in self._trends:
            async with self._turn(request):
                document = encoded(documents.trend_document(model, names, start, end, points, is_brief=is_brief))
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
        guards.add_headers(answer)
        await answer.prepare(request)
        await answer.write(",".join(["time_s", *names, "quality"]).encode() + b"\n")
        trends = self._model.trends
        with suppress(ConnectionError, TimeoutError):  # the client has gone
            while start <= end:
                async with self._turn(request):
                    text, every = io.StringIO(), trends.between(start, end)
                    writer, rows = csv.writer(text, lineterminator="\n"), every[:ROWS_AT_ONCE]
                    for row, *values in zip(rows, *(trends.column(name, rows) for name in names), strict=True):
                        doubts = trends.doubts_at(row)
                        doubted = " ".join(f"{name}={one}" for name, one in doubts.items() if name in names)
                        numbers = ("" if math.isnan(value) else f"{value:.7g}" for value in values)
                        writer.writerow([trends.ticks[row] * self._tick_s, *numbers, doubted])
                    start = end + 1 if len(every) <= ROWS_AT_ONCE else trends.ticks[every[ROWS_AT_ONCE]]
                async with asyncio.timeout(STALLED_S):
                    await answer.write(text.getvalue().encode())
        return answer

    async def explanation(self, request: web.Request) -> web.Response:
        """Answer with the explanation of an updating period."""
        number, at = request.query.get("update", ""), request.query.get("at", "")
        try:
            at_tick = round(float(at) / self._tick_s) if at else None
            document = documents.explanation_document(self._model, int(number) if number else None, at_tick)
        except (ValueError, OverflowError):
            raise web.HTTPBadRequest(reason="update and at must be numbers") from None
        if document is None:
            wanted = printable(number or at) or "(the last one)"
            return refusal(404, f"update {wanted} is not known: only the newest are kept")
        return compressed_answer(request, encoded(document))

    async def alarms(self, request: web.Request) -> web.Response:
        """Answer with all alarms."""
        return compressed_answer(request, encoded({"alarms": documents.alarms_document(self._model)}))

    def _events(self, query: Mapping[str, str]) -> list[process_image.JournalEntry]:
        """Return the events that a search finds, the newest first (HTTPBadRequest: its times are not numbers)."""
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
            shown = [*(documents.event_document(one, self._tick_s) for one in found[start : start + EVENTS_SHOWN])]
            pages = -(-len(found) // EVENTS_SHOWN)
            document = encoded({"found": len(found), "first": start + 1, "pages": pages, "events": shown})
            return compressed_answer(request, document)

    async def events_table(self, request: web.Request) -> web.Response:
        """Answer with all events that a search finds as CSV."""
        text = io.StringIO()
        names = (
            "service", "number", "boot", "utc", "tick", "time_s", "kind", "subject", "cause", "value", "unit", "who",
        )  # fmt: skip
        writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        async with self._turn(request):
            for entry in self._events(request.query):
                row = documents.event_document(entry, self._tick_s)
                writer.writerow({name: safe_cell(row[name]) for name in names})
        return web.Response(body=text.getvalue().encode(), headers=csv_headers("coldloop-events.csv"))

    async def health(self, _request: web.Request) -> web.Response:
        """Answer 200 while all services answer, 503 otherwise."""
        services = documents.services_document(self._model)
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
            await self._guard.log_in(auth.login, auth.password, request.remote or "", self._guard.scrapes)
        body = exposition(documents.page_families(self._model, len(self._broadcast)))
        return compressed_answer(request, body, CONTENT_TYPE)


def safe_cell(value: object) -> object:
    """Return a cell of a table that no spreadsheet takes for a formula."""
    if not isinstance(value, str) or value[:1] not in {"=", "+", "-", "@", "\t", "\r"}:
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def csv_headers(name: str) -> dict[str, str]:
    """Return the headers of a file of comma-separated values."""
    return {hdrs.CONTENT_TYPE: "text/csv; charset=utf-8", hdrs.CONTENT_DISPOSITION: f'attachment; filename="{name}"'}


def printable(text: str) -> str:
    """Return a request's text for a message: short, and on one line."""
    return "".join(one if one.isprintable() else "?" for one in text[:LONGEST_NAME])


class PageSite(NamedTuple):
    """One rig, or one recorded run, and what can be done with it."""

    model: process_image.Model
    desk: operator_desk.OperatorDesk | None = None
    """Carries out commands; None where there are none."""
    routes: tuple[web.AbstractRouteDef, ...] = ()
    """Further requests that are served."""


class PageServer:
    """Serves one site to browsers, or several side by side.

    Raises:
        ConfigurationError: A file of the settings cannot be used.
    """

    def __init__(self, settings: HmiSection, *sites: PageSite) -> None:
        self._settings = settings
        self._audit = users.Audit(settings.audit)
        self._users = users.Users(settings.login.users)
        self._connections = Connections(settings.connections, time.monotonic)
        self._guard = Guard(settings, self._audit, self._users, self._connections)
        self._streams: list[tuple[process_image.Model, Broadcast, asyncio.Event]] = []
        server_logger.addFilter(guards.told_in_a_line)
        app = web.Application(middlewares=[self._guard.middleware], client_max_size=operator_desk.LONGEST_REQUEST)
        if len(sites) == 1:
            app.add_routes(self._routes(sites[0]))
        else:
            app.add_routes([guards.html_file("two-runs.html"), *guards.static_files()])
            for number, site in enumerate(sites, 1):
                part = web.Application()
                part.add_routes(self._routes(site))
                app.add_subapp(f"/run/{number}/", part)
        self._runner = web.AppRunner(
            app, access_log=None, shutdown_timeout=SHUTDOWN_S, keepalive_timeout=WAITING_S,
            lingering_time=LINGERING_S, auto_decompress=False,
        )  # fmt: skip
        self._listener: asyncio.Server | tls.TlsListener | None = None
        self.port = 0

    def _routes(self, site: PageSite) -> list[web.AbstractRouteDef]:
        model, desk, extra = site
        broadcast = Broadcast(lambda: message(documents.state_document(model)), self._settings.browsers)
        news = asyncio.Event()
        model.on_change = news.set
        self._streams.append((model, broadcast, news))
        reading = Reading(self._settings, model, broadcast, self._guard, replay=desk is None)
        commanding = operator_desk.Commanding(self._settings, self._guard, self._users, desk, self._audit)
        return [*reading.routes(), *commanding.routes(), *extra]

    async def start(self) -> None:
        """Listen.

        Raises:
            PortInUseError: Another program already does.
            ConfigurationError: The files for HTTPS cannot be used.
        """
        host, port = self._settings.host, self._settings.port
        https = _https(self._settings)
        await self._runner.setup()  # the places of aiohttp take in everybody who comes, so these are our own
        newcomer = partial(self._connections.newcomer, cast("web.Server", self._runner.server))
        try:
            if https is None:
                self._listener = await asyncio.get_running_loop().create_server(newcomer, host, port)
            else:
                self._listener = await tls.TlsListener.at(
                    host, port, https, make_protocol=newcomer, limit=self._settings.connections,
                    refusals=connection.RefusalLog("hmi"),
                )  # fmt: skip
        except OSError as error:
            await self._runner.cleanup()
            raise PortInUseError(f"{host}:{port}: {error.strerror}; give another port with hmi.port") from None
        self.port = self._listener.sockets[0].getsockname()[1]

    @property
    def address(self) -> str:
        """Address of the page for a browser."""
        name = "127.0.0.1" if self._settings.host in {"0.0.0.0", "::"} else self._settings.host  # noqa: S104
        host = f"[{name}]" if ":" in name else name
        return f"{'https' if self._settings.https else 'http'}://{host}:{self.port}/"

    async def serve(self, others: Iterable[Task], announce: Callable[[], None]) -> None:
        """Listen, announce it, and send what changes to all browsers beside other tasks, until cancelled.

        Raises:
            PortInUseError, ConfigurationError: As `start`.
        """
        await self.start()
        announce()
        try:
            async with asyncio.TaskGroup() as tasks:
                for stream in self._streams:
                    tasks.create_task(_send_changes(*stream), name="stream")
                for each in others:
                    tasks.create_task(each())
        finally:
            await self.close()

    async def close(self) -> None:
        """End all streams and stop listening."""
        if self._listener is not None:
            self._listener.close()
        await self._runner.cleanup()
        self._audit.close()


async def _send_changes(model: process_image.Model, broadcast: Broadcast, news: asyncio.Event) -> None:
    sent = 0.0
    while True:
        with suppress(TimeoutError):
            async with asyncio.timeout(LONGEST_S):
                await news.wait()
        await asyncio.sleep(max(0.0, sent + SHORTEST_S - time.monotonic()))
        news.clear()
        sent = time.monotonic()
        changed, model.changed = model.changed, set()
        if len(broadcast):
            broadcast.send(message(documents.state_document(model, changed)))


def message(document: dict[str, object]) -> bytes:
    """Return a document as a server-sent event."""
    return b"data: " + encoded(document) + b"\n\n"


def _https(settings: HmiSection) -> ssl.SSLContext | None:
    if settings.https is None:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(settings.https.certificate, settings.https.key)
    except (OSError, ssl.SSLError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigurationError(f"hmi.https: {settings.https.certificate}, {settings.https.key}: {reason}") from None
    return context
