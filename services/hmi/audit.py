"""The audit of the page: every login, command and refusal, and whose it was, one JSON object a line."""

import json
import logging
from collections import deque
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from coldloop.errors import ConfigurationError

log = logging.getLogger("coldloop.hmi.audit")

KEPT: Final = 500


class Audit:
    """Keeps the last entries, logs them, and appends them to a file.

    Args:
        file: Where to; None is nowhere.

    Raises:
        ConfigurationError: The file cannot be written.
    """

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self.entries: deque[dict[str, Any]] = deque(maxlen=KEPT)
        if file is not None:
            try:
                with file.open("a", encoding="utf-8"):
                    file.chmod(0o600)
            except OSError as error:
                raise ConfigurationError(
                    f"hmi.audit: {file}: {error.strerror}; name a file in a folder that can be written"
                ) from None

    def note(self, what: str, *, who: str, address: str, outcome: str, detail: str = "") -> None:
        """Add an entry.

        Args:
            what: What was asked for: login, logout, command, request.
            who: The user; empty when nobody has logged in.
            address: Where the request came from.
            outcome: done, refused, or uncertain when it is not known.
            detail: The command in words, what came back, or why not.
        """
        utc = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        entry = {"utc": utc, "what": what, "who": who, "address": address, "outcome": outcome, "detail": detail}
        self.entries.append(entry)
        log.log(
            logging.INFO if outcome == "done" else logging.WARNING,
            what,
            extra={k: v for k, v in entry.items() if k != "what"},
        )
        if self._file is not None:
            try:
                with self._file.open("a", encoding="utf-8", errors="backslashreplace") as lines:
                    lines.write(json.dumps(entry, ensure_ascii=False) + "\n")
            except OSError as error:
                log.error("audit not written", extra={"file": str(self._file), "reason": error.strerror})  # noqa: TRY400
