"""Sessions, request rates and origin of requests. No sockets; the clock is given."""

import hashlib
import re
import secrets
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from coldloop_hmi.users import PageRole, User

MOST_SESSIONS: Final = 200
MOST_ADDRESSES: Final = 1000
LOGINS_A_MINUTE: Final = 6.0
LOGIN_BURST: Final = 6.0
"""Wrong passwords for one name from one address."""
PASSWORDS_A_SECOND: Final = 4.0
PASSWORD_BURST: Final = 12.0
"""Passwords that are checked for all names of one address together, but for those that have logged in from there: each
takes a twentieth of a second of a core."""
REQUESTS_A_BROWSER: Final = 3.0
"""In a second. Behind a proxy all browsers have one address, and each asks for two trends a second."""
REQUEST_BURST: Final = 150.0
LOCAL_NAMES: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_HOST: Final = re.compile(r"(?:\[(?P<v6>[0-9a-fA-F:.]+)\]|(?P<name>[A-Za-z0-9._-]+))(?::(?P<port>[0-9]{1,5}))?")
"""A Host header: a name or an address, and nothing before or after it but a port."""


class Party(NamedTuple):
    """Who shares a bound: a user who has logged in, or all strangers of one address."""

    name: str
    has_session: bool


@dataclass
class LoginSession:
    """A user who has logged in."""

    user: User
    began: float
    seen: float

    @property
    def may_operate(self) -> bool:
        """Whether commands are allowed."""
        return self.user.role is PageRole.OPERATE


class LoginSessions:
    """LoginSessions by their tokens, of which only digests are kept.

    Args:
        now: Monotonic clock, s.
        idle_s: A session without a request for so long ends.
        longest_s: Every session ends after this time.
    """

    def __init__(self, now: Callable[[], float], idle_s: float, longest_s: float) -> None:
        self._now = now
        self._idle_s = idle_s
        self._longest_s = longest_s
        self._sessions: OrderedDict[str, LoginSession] = OrderedDict()

    def begin(self, user: User) -> str:
        """Begin a session; return its token. The oldest session ends when there are too many."""
        token = secrets.token_urlsafe(32)
        now = self._now()
        self._sessions[_digest(token)] = LoginSession(user, now, now)
        while len(self._sessions) > MOST_SESSIONS:
            self._sessions.popitem(last=False)
        return token

    def find(self, token: str | None, *, is_use: bool = True) -> LoginSession | None:
        """Return the session of a token; None when there is none, or it has ended.

        Args:
            token: What the browser sent.
            is_use: The request counts as a sign of life; what a page asks for by itself does not.
        """
        key = _digest(token) if token else ""
        session = self._sessions.get(key)
        if session is None:
            return None
        now = self._now()
        if now - session.seen > self._idle_s or now - session.began > self._longest_s:
            del self._sessions[key]
            return None
        if is_use:
            session.seen = now
        return session

    def end(self, token: str | None) -> None:
        """End a session."""
        if token:
            self._sessions.pop(_digest(token), None)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode(errors="surrogatepass")).hexdigest()


class ClientLimit:
    """A bucket of requests for each address or party.

    Args:
        now: Monotonic clock, s.
        per_second: Rate at which it fills.
        burst: Its capacity.
    """

    def __init__(self, now: Callable[[], float], per_second: float, burst: float) -> None:
        self._now = now
        self._per_second = per_second
        self._burst = burst
        self._buckets: OrderedDict[str | Party, tuple[float, float]] = OrderedDict()

    def allows(self, address: str | Party) -> bool:
        """Take a request of an address or a party, or refuse it."""
        now = self._now()
        level, since = self._buckets.pop(address, (self._burst, now))
        level = min(self._burst, level + (now - since) * self._per_second)
        allowed = level >= 1.0
        self._buckets[address] = (level - 1.0 if allowed else level, now)
        while len(self._buckets) > MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return allowed

    def give_back(self, address: str | Party) -> None:
        """Give a request back that shall not count."""
        if address in self._buckets:
            level, since = self._buckets[address]
            self._buckets[address] = (min(self._burst, level + 1.0), since)


class LoginLimit:
    """Which attempts to log in are looked at: by address and name, and by address.

    Who has logged in from an address before comes first there: others who try from it, behind a proxy perhaps, do not
    keep such users out. Nothing here depends on whether a name exists.

    Args:
        now: Monotonic clock, s.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._of_names = ClientLimit(now, LOGINS_A_MINUTE / 60, LOGIN_BURST)
        self._of_addresses = ClientLimit(now, PASSWORDS_A_SECOND, PASSWORD_BURST)
        self._known: OrderedDict[str, None] = OrderedDict()

    def allows(self, address: str, name: str) -> bool:
        """Return whether a password is checked for this name from this address."""
        both = f"{address} {name}"
        return (both in self._known or self._of_addresses.allows(address)) and self._of_names.allows(both)

    def succeeded(self, address: str, name: str) -> None:
        """Note that the password was right."""
        both = f"{address} {name}"
        self._of_names.give_back(both)
        if both not in self._known:
            self._of_addresses.give_back(address)
        self._known[both] = None
        self._known.move_to_end(both)
        while len(self._known) > MOST_ADDRESSES:
            self._known.popitem(last=False)


def host_of(header: str) -> str:
    """Return the name in a Host header, without its port; empty when it is not one."""
    found = _HOST.fullmatch(header)
    return (found["v6"] or found["name"]).lower() if found else ""


def port_of(header: str) -> int | None:
    """Return the port in a Host header; None when there is none."""
    found = _HOST.fullmatch(header)
    return int(found["port"]) if found and found["port"] else None


def is_own_origin(origin: str | None, host: str) -> bool:
    """Return whether a request that changes something comes from the page itself: `Origin` names the address asked for.

    A request without `Origin` is not: browsers send it with every POST. A proxy in front may add HTTPS.
    """
    return origin in {f"http://{host}", f"https://{host}"}
