"""The web server of one page: requests, the stream of changes, and its start and end."""

import asyncio
import ssl
import time
from typing import Final

from aiohttp import web

from coldloop.errors import ConfigurationError, PortInUseError
from hmi.audit import Audit
from hmi.broadcast import Broadcast
from hmi.commanding import LONGEST_REQUEST, Commanding
from hmi.documents import encoded, state_document
from hmi.guard import Guard
from hmi.model import Model
from hmi.operator_desk import OperatorDesk
from hmi.reading import Reading
from hmi.settings import HmiSection
from hmi.users import Users

SHORTEST_S: Final = 0.1
"""Between two messages of the stream."""
LONGEST_S: Final = 0.4
"""Without news the stream says that the page lives, and how old everything is."""
SHUTDOWN_S: Final = 0.5


class PageServer:
    """Serves one model to browsers.

    Args:
        settings: Of the page.
        model: What is shown.
        desk: Carries out commands; None where there are none.
        extra: Further requests that are served.

    Raises:
        ConfigurationError: A file of the settings cannot be used.
    """

    def __init__(
        self,
        settings: HmiSection,
        model: Model,
        desk: OperatorDesk | None,
        extra: list[web.AbstractRouteDef] | None = None,
    ) -> None:
        self._settings = settings
        self._model = model
        self._news = asyncio.Event()
        model.on_change = self._news.set
        audit = Audit(settings.audit)
        guard = Guard(settings, audit)
        users = Users(settings.login.users)
        self.broadcast = Broadcast(lambda: message(state_document(model)), settings.browsers)
        app = web.Application(middlewares=[guard.middleware], client_max_size=LONGEST_REQUEST)
        reading = Reading(settings, model, self.broadcast, guard, users, replay=desk is None)
        commanding = Commanding(settings, guard, users, desk, audit)
        app.add_routes([*reading.routes(), *commanding.routes(), *(extra or [])])
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=SHUTDOWN_S)
        self.port = 0

    async def start(self) -> None:
        """Listen.

        Raises:
            PortInUseError: Somebody else does already.
            ConfigurationError: The files for HTTPS cannot be used.
        """
        settings = self._settings
        await self._runner.setup()
        site = web.TCPSite(self._runner, settings.host, settings.port, ssl_context=_https(settings))
        try:
            await site.start()
        except OSError as error:
            await self._runner.cleanup()
            raise PortInUseError(
                f"{settings.host}:{settings.port}: {error.strerror}; give another port with hmi.port"
            ) from None
        self.port = self._runner.addresses[0][1]

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        name = "127.0.0.1" if self._settings.host in {"0.0.0.0", "::"} else self._settings.host  # noqa: S104
        host = f"[{name}]" if ":" in name else name
        return f"{'https' if self._settings.https else 'http'}://{host}:{self.port}/"

    async def run(self) -> None:
        """Send what changes to all browsers until cancelled."""
        sent = 0.0
        while True:
            try:
                async with asyncio.timeout(LONGEST_S):
                    await self._news.wait()
            except TimeoutError:
                pass
            await asyncio.sleep(max(0.0, sent + SHORTEST_S - time.monotonic()))
            self._news.clear()
            sent = time.monotonic()
            changed, self._model.changed = self._model.changed, set()
            if len(self.broadcast):
                self.broadcast.send(message(state_document(self._model, changed)))

    async def close(self) -> None:
        """End all streams and stop listening."""
        await self._runner.cleanup()


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
