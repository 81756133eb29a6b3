"""What every request passes: whose it is, where it comes from, how often, and the headers of every answer."""

import re
import time
from collections.abc import Awaitable, Callable
from typing import Final

from aiohttp import hdrs, web

from hmi.access import (
    LOCAL_NAMES,
    LOGIN_BURST,
    LOGINS_A_MINUTE,
    REQUEST_BURST,
    REQUESTS_A_BROWSER,
    LoginSession,
    RateLimit,
    Sessions,
    host_of,
    is_own_origin,
    port_of,
)
from hmi.audit import Audit
from hmi.settings import HmiSection

HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
SAFE: Final = frozenset({hdrs.METH_GET, hdrs.METH_HEAD})
BY_ITSELF: Final = frozenset(
    {"/api/stream", "/api/trend", "/api/events", "/api/audit", "/api/me", "/api/explanation", "/api/replay"}
)
"""What a page asks for without a hand on it: no sign of life of its user."""
OPEN: Final = frozenset({"/", "/healthz", "/metrics", "/api/catalog", "/api/login", "/api/me", "/favicon.ico"})
"""What is served without a login; `/metrics` looks at it itself."""

_RUN: Final = re.compile(r"\A/run/\d+/")

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def refusal(status: int, message: str) -> web.Response:
    """Return a refusal, one line of JSON."""
    return web.json_response({"error": message}, status=status)


def cookie_name(request: web.Request) -> str:
    """Return the name of a session's cookie: browsers send cookies to all ports of a host, so it names the port."""
    return f"coldloop_session_{port_of(request.host) or 'default'}"


def path_in_exhibit(request: web.Request) -> str:
    """Return what is asked for of one rig or run, without the number of the run among several."""
    return _RUN.sub("/", request.path, count=1)


class Guard:
    """Judges requests before anything is done.

    Args:
        settings: Of the page.
        audit: Where refusals are noted.
    """

    def __init__(self, settings: HmiSection, audit: Audit) -> None:
        self._settings = settings
        self._audit = audit
        login = settings.login
        self.sessions = Sessions(time.monotonic, login.idle_minutes * 60, login.longest_minutes * 60)
        self.logins = RateLimit(time.monotonic, LOGINS_A_MINUTE / 60, LOGIN_BURST)
        self._requests = RateLimit(time.monotonic, REQUESTS_A_BROWSER * settings.browsers, REQUEST_BURST)
        self._hosts = LOCAL_NAMES | {settings.host, *settings.allowed_hosts}

    def session(self, request: web.Request) -> LoginSession | None:
        """Return the session of a request."""
        return self.sessions.find(
            request.cookies.get(cookie_name(request)), is_use=path_in_exhibit(request) not in BY_ITSELF
        )

    def who(self, request: web.Request) -> str:
        """Return the user of a request; empty when nobody has logged in."""
        session = self.sessions.find(request.cookies.get(cookie_name(request)), is_use=False)
        return session.user.name if session else ""

    def refuse_login(self, name: str, address: str) -> None:
        """Note a wrong password, or a name that nobody has."""
        self._audit.note("login", who=name[:40], address=address, outcome="refused", detail="wrong name or password")

    def _refused(self, request: web.Request, status: int, reason: str) -> web.Response:
        self._audit.note(
            "request", who=self.who(request), address=request.remote or "", outcome="refused",
            detail=f"{request.method} {request.path}: {reason}",
        )  # fmt: skip
        return refusal(status, reason)

    def _judge(self, request: web.Request) -> web.Response | None:
        """Return why a request is refused; None when it is not."""
        if host_of(request.host) not in self._hosts:
            return self._refused(request, 421, f"the page is not called '{request.host}': name it in hmi.allowed_hosts")
        if not self._requests.allows(request.remote or ""):
            return refusal(429, "too many requests: wait a little")
        if request.method not in SAFE and not is_own_origin(request.headers.get(hdrs.ORIGIN), request.host):
            return self._refused(request, 403, "a command comes from the page itself, not from another site")
        path = path_in_exhibit(request)
        is_open = path in OPEN or path.startswith("/static/")
        if not is_open and not self._settings.login.anonymous_view and self.session(request) is None:
            return refusal(401, "log in first")
        return None

    @web.middleware
    async def middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Judge a request, answer it, and put the headers on the answer."""
        answer: web.StreamResponse | None = self._judge(request)
        if answer is None:
            try:
                answer = await handler(request)
            except web.HTTPException as error:
                answer = refusal(error.status, error.reason)
        if not answer.prepared:
            add_headers(answer)
        return answer


def add_headers(answer: web.StreamResponse) -> None:
    """Put the headers of every answer on it."""
    answer.headers.update(HEADERS)
    answer.headers.setdefault(hdrs.CACHE_CONTROL, "no-store")
