"""The audit of the page: every login, command and refusal, and whose it was, one JSON object a line."""

import json
import logging
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from heapq import merge
from pathlib import Path
from typing import Any, Final, NamedTuple

from coldloop.errors import ConfigurationError

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
    """Keeps the last entries, logs them, and appends them to a file.

    A file that has become larger than 8 MB is set aside as `FILE.1`, and four of these are kept.

    Args:
        file: Where to; None is nowhere.
        now: Monotonic clock, s.

    Raises:
        ConfigurationError: The file cannot be written.
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
        """Add an entry.

        Args:
            what: Kind of request: login, logout, command, request.
            who: The user who has logged in.
            address: Where the request came from.
            outcome: done, refused, or uncertain when it is not known.
            detail: The command in words, its result, or the reason of a refusal.
        """
        self._sum_up()
        self._add(_entry(what, who, address, outcome, detail), self._of_users)

    def refuse(self, what: str, *, who: str, address: str, reason: str, detail: str = "", has_session: bool) -> None:
        """Add a refusal, or count it where one like it has an entry already.

        Args:
            what: Kind of request.
            who: The user; of a login, the name that was given.
            address: Where the request came from.
            reason: Why; refusals of one reason to one user or address are alike.
            detail: More about the first one.
            has_session: The user has logged in.
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
