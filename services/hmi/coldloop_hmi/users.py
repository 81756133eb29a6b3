"""Users of the page: roles and hashes of passwords, sessions, limits of requests, and the audit of what they did.

No sockets; the clock is given. The audit has every login, command and refusal, and whose it was, as JSON lines.
`python -m coldloop_hmi.users FILE NAME view|operate` asks for a password, or reads it from standard input, and
writes a line.
"""

import argparse
import base64
import getpass
import hashlib
import hmac
import json
import logging
import os
import secrets
import stat
import sys
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from functools import partial
from heapq import merge
from pathlib import Path
from typing import Any, Final, NamedTuple

from coldloop.errors import ColdloopError, ConfigurationError, UsageError
from coldloop.text import read_text

log = logging.getLogger("coldloop.hmi.audit")

KEPT: Final = 500
STRANGERS_KEPT: Final = 100
"""Entries about requests without a login: they never push out those of users."""
LONGEST_DETAIL: Final = 300
REPEATS_S: Final = 60.0
"""Refusals that are alike within this time are one entry, and a second one that says how many there were."""
MOST_KINDS: Final = 20
"""Kinds of refusals without a login that have their own entries in this time; all others share one."""
LARGEST_FILE: Final = 8_000_000
OLDER_FILES: Final = 4

Entry = dict[str, Any]


class _Kind(NamedTuple):
    """Fields that refusals of one kind have in common."""

    what: str
    who: str
    address: str
    reason: str


OTHERS: Final = _Kind("request", "", "", "other refusals")


@dataclass
class _Repeats:
    """Refusals of one kind since the first of them."""

    entry: Entry
    until: float
    count: int = 1


class Audit:
    """Keeps the last entries, logs them, and appends them to a file, if one is given.

    A file that has become larger than 8 MB is set aside as `FILE.1`, and four of these are kept. `now` is a monotonic
    clock, s. A file that cannot be written raises a ConfigurationError.
    """

    def __init__(self, file: Path | None, now: Callable[[], float] = time.monotonic) -> None:
        self._file = file
        self._now = now
        self._of_users: deque[Entry] = deque(maxlen=KEPT)
        self._of_strangers: deque[Entry] = deque(maxlen=STRANGERS_KEPT)
        self._repeats: dict[_Kind, _Repeats] = {}
        if file is not None:
            try:
                self._append(file, "")
                if file.is_file():  # and no device, which is everybody's
                    file.chmod(0o600)
            except OSError as error:
                raise ConfigurationError(
                    f"hmi.audit: {file}: {error.strerror}; name a file in a folder that can be written"
                ) from None

    @property
    def entries(self) -> list[Entry]:
        """The last entries, the oldest first."""
        return list(merge(self._of_users, self._of_strangers, key=lambda entry: entry["utc"]))

    def note(self, what: str, *, who: str, address: str, outcome: str, detail: str = "") -> None:
        """Add an entry about a login, logout, command or request: its user, its address, and in `detail` more words.

        `outcome` is done, refused, or uncertain when it is not known.
        """
        self._sum_up()
        self._add(_entry(what, who, address, outcome, detail), self._of_users)

    def refuse(self, what: str, *, who: str, address: str, reason: str, detail: str = "", has_session: bool) -> None:
        """Add a refusal, or count it where one like it has an entry already: for one reason to one user or address.

        `who` is the user, who has logged in if `has_session`, or the name that was given. `detail` is of the first one.
        """
        self._sum_up()
        kind = _Kind(what, who, address, reason) if has_session else _Kind(what, "", address, reason)
        if not has_session and kind not in self._repeats:
            strangers = sum(not known.who for known in self._repeats)
            kind = kind if strangers < MOST_KINDS else OTHERS
        known = self._repeats.get(kind)
        if known is not None:
            known.count += 1
            return
        text = reason if not detail else f"{detail[:LONGEST_DETAIL]}: {reason}"
        entry = _entry(what, who, address, "refused", text)
        self._repeats[kind] = _Repeats(entry, self._now() + REPEATS_S)
        self._add(entry, self._of_users if has_session else self._of_strangers)

    def close(self) -> None:
        """Write how often refusals were repeated that are not summed up yet."""
        self._sum_up(everything=True)

    def _sum_up(self, *, everything: bool = False) -> None:
        now = self._now()
        over = [kind for kind, one in self._repeats.items() if everything or one.until <= now]
        for kind in over:
            one = self._repeats.pop(kind)
            if one.count > 1:
                detail = f"{kind.reason}: {one.count} times since {one.entry['utc']}"
                entry = _entry(kind.what, one.entry["who"], kind.address, "refused", detail)
                self._add(entry, self._of_users if kind.who else self._of_strangers)

    def _add(self, entry: Entry, kept: deque[Entry]) -> None:
        kept.append(entry)
        log.log(
            logging.INFO if entry["outcome"] == "done" else logging.WARNING,
            entry["what"],
            extra={key: value for key, value in entry.items() if key != "what"},
        )
        if self._file is not None:
            try:
                self._append(self._file, json.dumps(entry, ensure_ascii=False) + "\n")
            except OSError as error:
                log.error("audit not written", extra={"file": str(self._file), "reason": error.strerror})  # noqa: TRY400

    def _append(self, file: Path, text: str) -> None:
        private = partial(os.open, mode=0o600)
        with open(file, "a", encoding="utf-8", errors="backslashreplace", opener=private) as lines:
            lines.write(text)
            is_full = lines.tell() > LARGEST_FILE
        if is_full:
            for number in range(OLDER_FILES, 0, -1):
                older = file if number == 1 else _set_aside(file, number - 1)
                if older.exists():
                    older.replace(_set_aside(file, number))


def _set_aside(file: Path, number: int) -> Path:
    return file.with_name(f"{file.name}.{number}")


def _entry(what: str, who: str, address: str, outcome: str, detail: str) -> Entry:
    utc = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return {"utc": utc, "what": what, "who": who, "address": address, "outcome": outcome, "detail": detail}


COST: Final = 2**14
BLOCK_SIZE: Final = 8
DIGEST_BYTES: Final = 32
SHORTEST_PASSWORD: Final = 8
MOST_MEMORY: Final = 64 * 1024 * 1024
COSTS: Final = range(10, 17)
BLOCK_SIZES: Final = range(1, 17)
"""Block sizes of hashes; costs above are exponents of 2. The largest take the memory above and half a second."""
COMMENT: Final = "#"
MOST_SESSIONS: Final = 200
MOST_ADDRESSES: Final = 1000
LOGINS_A_MINUTE: Final = 6.0
LOGIN_BURST: Final = 6.0
"""Wrong passwords for one name from one address."""
PASSWORDS_A_SECOND: Final = 4.0
PASSWORD_BURST: Final = 12.0
"""Passwords that are checked for all names of one address together, but for those that have logged in from there: each
takes a twentieth of a second of a core."""


class PageRole(StrEnum):
    """Role of a user: what the user may do."""

    VIEW = "view"
    OPERATE = "operate"


class User(NamedTuple):
    """One line of the file."""

    name: str
    role: PageRole
    hash: str


def hash_password(password: str) -> str:
    """Return `scrypt$cost$block size$salt$hash` of a password."""
    salt = secrets.token_bytes(16)
    digest = _scrypt(password, salt, COST, BLOCK_SIZE)
    return f"scrypt${COST}${BLOCK_SIZE}$" + "$".join(base64.b64encode(one).decode("ascii") for one in (salt, digest))


def is_password(password: str, stored: str) -> bool:
    """Return whether a password has this hash."""
    _, cost, block_size, salt, digest = stored.split("$")
    found = _scrypt(password, base64.b64decode(salt), int(cost), int(block_size))
    return hmac.compare_digest(found, base64.b64decode(digest))


def _scrypt(password: str, salt: bytes, cost: int, block_size: int) -> bytes:
    encoded = password.encode(errors="surrogatepass")
    return hashlib.scrypt(encoded, salt=salt, n=cost, r=block_size, p=1, maxmem=MOST_MEMORY, dklen=DIGEST_BYTES)


NOBODYS_HASH: Final = hash_password(secrets.token_urlsafe())
"""Checked for a name that does not exist, so that the answer takes as long."""


class Users:
    """The users of a file; without a file there are none.

    Raises:
        ConfigurationError: The file cannot be read, everybody may write to it, or a line is wrong.
    """

    def __init__(self, file: Path | None) -> None:
        self._users: dict[str, User] = {}
        if file is None:
            return
        try:
            lines = _lines(file)
            mode, folder = file.stat().st_mode, file.resolve().parent.stat().st_mode
        except (OSError, UsageError) as error:
            raise ConfigurationError(f"hmi.login.users: {error}") from None
        for path, bits in ((file, mode), (file.parent, folder)):
            if bits & (stat.S_IWOTH | stat.S_IWGRP) and not bits & stat.S_ISVTX:
                raise ConfigurationError(f"hmi.login.users: {path}: others can write to it; `chmod go-w {path}`")
        for number, line in enumerate(lines, 1):
            if line.strip() and not line.startswith(COMMENT):
                user = _user(line, f"{file}:{number}")
                if user.name in self._users:
                    raise ConfigurationError(
                        f"hmi.login.users: {file}:{number}: a second line of {user.name}; keep one"
                    )
                self._users[user.name] = user

    def __len__(self) -> int:
        return len(self._users)

    def check(self, name: str, password: str) -> User | None:
        """Return the user with this password; None when there is none. Takes a twentieth of a second."""
        user = self._users.get(name)
        right = is_password(password, user.hash if user else NOBODYS_HASH)
        return user if right else None


def _lines(file: Path) -> list[str]:
    return read_text(file, f"`python -m coldloop_hmi.users {file} NAME operate` writes it").splitlines()


def _user(line: str, place: str) -> User:
    name, _, rest = line.partition(":")
    role, _, stored = rest.partition(":")
    if not name or role not in set(PageRole) or not _is_hash(stored.strip()):
        raise ConfigurationError(
            f"hmi.login.users: {place}: not name:role:hash; "
            "`python -m coldloop_hmi.users FILE NAME view|operate` writes such lines"
        )
    return User(name, PageRole(role), stored.strip())


def _is_hash(stored: str) -> bool:
    """Return whether a password can be compared with this hash: it is whole, and of a usual cost."""
    try:
        name, *numbers, first, second = stored.split("$")
        cost, block_size = map(int, numbers)
        salt, digest = (base64.b64decode(field, validate=True) for field in (first, second))
    except ValueError:
        return False
    if name != "scrypt" or not "".join(numbers).isdecimal():
        return False
    costs = [2**power for power in COSTS if 128 * 2**power * block_size < MOST_MEMORY]
    return cost in costs and block_size in BLOCK_SIZES and len(salt) > 0 and len(digest) == DIGEST_BYTES


def write_user(file: Path, name: str, role: PageRole, password: str) -> None:
    """Write a user's line, in the place of an earlier one of the same name; the file is readable by its owner only.

    Raises:
        UsageError: The name or the password cannot be used, or the file cannot be written.
    """
    if not name or name.startswith(COMMENT) or ":" in name or not name.isprintable():
        raise UsageError(f"user '{name}': a name is printable text without a colon, and does not begin with #")
    if len(password) < SHORTEST_PASSWORD:
        raise UsageError(f"user '{name}': a password has {SHORTEST_PASSWORD} characters or more")
    try:
        lines = _lines(file) if file.exists() else []
        kept = [line for line in lines if line.partition(":")[0] != name]
        file.touch(mode=0o600)
        file.chmod(0o600)
        file.write_text("\n".join([*kept, f"{name}:{role.value}:{hash_password(password)}"]) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror}") from None


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


@dataclass
class LoginSessions:
    """Sessions by their tokens, of which only digests are kept."""

    now: Callable[[], float]
    """Monotonic clock, s."""
    idle_s: float
    """A session without a request for so long ends."""
    longest_s: float
    """Every session ends after this time."""
    _sessions: OrderedDict[str, LoginSession] = field(default_factory=OrderedDict, init=False)

    def begin(self, user: User) -> str:
        """Begin a session; return its token. The oldest session ends when there are too many."""
        token, now = secrets.token_urlsafe(32), self.now()
        self._sessions[_digest(token)] = LoginSession(user, now, now)
        while len(self._sessions) > MOST_SESSIONS:
            self._sessions.popitem(last=False)
        return token

    def find(self, token: str | None, *, is_use: bool = True) -> LoginSession | None:
        """Return the session of a token; None when there is none, or it has ended.

        `is_use`: the request counts as a sign of life; what a page asks for by itself does not.
        """
        key = _digest(token) if token else ""
        session = self._sessions.get(key)
        if session is None:
            return None
        now = self.now()
        if now - session.seen > self.idle_s or now - session.began > self.longest_s:
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


@dataclass
class ClientLimit:
    """A bucket of requests for each address or party."""

    now: Callable[[], float]
    """Monotonic clock, s."""
    per_second: float
    """Rate at which it fills."""
    burst: float
    """Its capacity."""
    _buckets: OrderedDict[str | Party, tuple[float, float]] = field(default_factory=OrderedDict, init=False)

    def allows(self, address: str | Party) -> bool:
        """Take a request of an address or a party, or refuse it."""
        now = self.now()
        level, since = self._buckets.pop(address, (self.burst, now))
        level = min(self.burst, level + (now - since) * self.per_second)
        allowed = level >= 1.0
        self._buckets[address] = (level - 1.0 if allowed else level, now)
        while len(self._buckets) > MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return allowed

    def give_back(self, address: str | Party) -> None:
        """Give a request back that shall not count."""
        if address in self._buckets:
            level, since = self._buckets[address]
            self._buckets[address] = (min(self.burst, level + 1.0), since)


class LoginLimit:
    """Limit of the attempts to log in: by address and name, and by address.

    Who has logged in from an address before comes first there: others who try from it, behind a proxy perhaps, do not
    keep such users out. Nothing here depends on whether a name exists. `now` is a monotonic clock, s.
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


def main() -> int:
    """Write a user's line; return the exit code."""
    parser = argparse.ArgumentParser(
        "python -m coldloop_hmi.users", description="Add a user of the page.", allow_abbrev=False
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("name")
    parser.add_argument("role", choices=[role.value for role in PageRole])
    options = parser.parse_args()
    try:
        if sys.stdin.isatty():
            password = getpass.getpass(f"password of {options.name}: ")
        else:
            password = sys.stdin.readline().removeprefix("\ufeff").rstrip("\r\n")
        write_user(options.file, options.name, PageRole(options.role), password)
    except ColdloopError as error:
        sys.stderr.write(f"hmi.users: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{options.file}: user {options.name} may {options.role}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
