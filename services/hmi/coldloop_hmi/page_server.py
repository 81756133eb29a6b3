"""The web server of one page: requests, the stream of changes, and its start and end."""

import asyncio
import ssl
import time
from contextlib import suppress
from functools import partial
from typing import Final, NamedTuple

from aiohttp import web
from aiohttp.log import server_logger

from coldloop.errors import ConfigurationError, PortInUseError
from coldloop.modbus.refusals import RefusalLog
from coldloop.modbus.tls_listener import TlsListener
from coldloop_hmi.assets import html_file, static_files
from coldloop_hmi.audit import Audit
from coldloop_hmi.broadcast import Broadcast
from coldloop_hmi.commanding import LONGEST_REQUEST, Commanding
from coldloop_hmi.connections import Connections
from coldloop_hmi.documents import encoded, state_document
from coldloop_hmi.guard import Guard, told_in_a_line
from coldloop_hmi.operator_desk import OperatorDesk
from coldloop_hmi.process_image import Model
from coldloop_hmi.reading import Reading
from coldloop_hmi.settings import HmiSection
from coldloop_hmi.users import Users

SHORTEST_S: Final = 0.1
"""Between two messages of the stream."""
LONGEST_S: Final = 0.4
"""Without news the stream says that the page lives, and how old everything is."""
SHUTDOWN_S: Final = 0.5
WAITING_S: Final = 30.0
"""A connection without a whole request, or between two, is closed after this time."""
LINGERING_S: Final = 1.0
"""How long the rest of a request that was refused is read, so that the refusal arrives."""


class PageSite(NamedTuple):
    """One rig, or one recorded run, and what can be done with it."""

    model: Model
    desk: OperatorDesk | None = None
    """Carries out commands; None where there are none."""
    routes: tuple[web.AbstractRouteDef, ...] = ()
    """Further requests that are served."""


class PageServer:
    """Serves one exhibit to browsers, or several side by side.

    Args:
        settings: Of the page.
        exhibits: What is shown.

    Raises:
        ConfigurationError: A file of the settings cannot be used.
    """

    def __init__(self, settings: HmiSection, *exhibits: PageSite) -> None:
        self._settings = settings
        self._audit = Audit(settings.audit)
        self._users = Users(settings.login.users)
        self._connections = Connections(settings.connections, time.monotonic)
        self._guard = Guard(settings, self._audit, self._users, self._connections)
        self._streams: list[tuple[Model, Broadcast, asyncio.Event]] = []
        server_logger.addFilter(told_in_a_line)
        app = web.Application(middlewares=[self._guard.middleware], client_max_size=LONGEST_REQUEST)
        if len(exhibits) == 1:
            app.add_routes(self._routes(exhibits[0]))
        else:
            app.add_routes([html_file("two-runs.html"), *static_files()])
            for number, exhibit in enumerate(exhibits, 1):
                part = web.Application()
                part.add_routes(self._routes(exhibit))
                app.add_subapp(f"/run/{number}/", part)
        self._runner = web.AppRunner(
            app, access_log=None, shutdown_timeout=SHUTDOWN_S, keepalive_timeout=WAITING_S,
            lingering_time=LINGERING_S, auto_decompress=False,
        )  # fmt: skip
        self._listener: asyncio.Server | TlsListener | None = None
        self.port = 0

    def _routes(self, exhibit: PageSite) -> list[web.AbstractRouteDef]:
        model, desk, extra = exhibit
        broadcast = Broadcast(lambda: message(state_document(model)), self._settings.browsers)
        news = asyncio.Event()
        model.on_change = news.set
        self._streams.append((model, broadcast, news))
        reading = Reading(self._settings, model, broadcast, self._guard, replay=desk is None)
        commanding = Commanding(self._settings, self._guard, self._users, desk, self._audit)
        return [*reading.routes(), *commanding.routes(), *extra]

    async def start(self) -> None:
        """Listen.

        Raises:
            PortInUseError: Another program already does.
            ConfigurationError: The files for HTTPS cannot be used.
        """
        settings = self._settings
        https = _https(settings)
        await self._runner.setup()
        try:
            self._listener = await self._listen(https)
        except OSError as error:
            await self._runner.cleanup()
            raise PortInUseError(
                f"{settings.host}:{settings.port}: {error.strerror}; give another port with hmi.port"
            ) from None
        self.port = self._listener.sockets[0].getsockname()[1]

    async def _listen(self, https: ssl.SSLContext | None) -> asyncio.Server | TlsListener:
        """Listen; the places of aiohttp take in everybody who comes, so these are our own."""
        server, host, port = self._runner.server, self._settings.host, self._settings.port
        if server is None:
            raise RuntimeError("the runner is not set up")
        newcomer = partial(self._connections.newcomer, server)
        if https is None:
            return await asyncio.get_running_loop().create_server(newcomer, host, port)
        refusals = RefusalLog("hmi")
        return await TlsListener.at(
            host, port, https, make_protocol=newcomer, limit=self._settings.connections, refusals=refusals
        )

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        name = "127.0.0.1" if self._settings.host in {"0.0.0.0", "::"} else self._settings.host  # noqa: S104
        host = f"[{name}]" if ":" in name else name
        return f"{'https' if self._settings.https else 'http'}://{host}:{self.port}/"

    async def run(self) -> None:
        """Send what changes to all browsers until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            for stream in self._streams:
                tasks.create_task(_send_changes(*stream), name="stream")

    async def close(self) -> None:
        """End all streams and stop listening."""
        if self._listener is not None:
            self._listener.close()
        await self._runner.cleanup()
        self._audit.close()


async def _send_changes(model: Model, broadcast: Broadcast, news: asyncio.Event) -> None:
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
            broadcast.send(message(state_document(model, changed)))


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
