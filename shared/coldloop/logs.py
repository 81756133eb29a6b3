"""Structured logs: one JSON object a line on standard error."""

import json
import logging
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, TextIO

STANDARD_ATTRIBUTES = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName"}


class JsonFormatter(logging.Formatter):
    """Formats a record as JSON: time, level, service, logger, event, and whatever was passed as `extra`."""

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "service": self._service,
            "logger": record.name,
            "event": record.getMessage(),
        }
        line.update((key, value) for key, value in record.__dict__.items() if key not in STANDARD_ATTRIBUTES)
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str, ensure_ascii=False)


MOST_EVENTS = 1000
"""Different events that are counted at a time."""


class FloodFilter(logging.Filter):
    """Lets at most `lines` of one event through in an interval; the next one says how many were left out."""

    def __init__(self, lines: int = 20, interval_s: float = 10.0, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._lines = lines
        self._interval_s = interval_s
        self._now = now
        self._seen: dict[tuple[str, ...], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Tell whether a record is to be written."""
        about = tuple(str(getattr(record, name, "")) for name in ("alarm", "mode"))
        event, now = (record.name, str(record.msg), *about), self._now()
        if len(self._seen) > MOST_EVENTS:
            self._seen.clear()
        since, count = self._seen.get(event, (now, 0))
        if now - since >= self._interval_s:
            if count > self._lines:
                record.left_out = count - self._lines
            since, count = now, 0
        self._seen[event] = since, count + 1
        return count < self._lines


def set_up_logs(service: str, level: str, stream: TextIO = sys.stderr) -> None:
    """Send the logs of this process, from `level` up, to `stream`."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter(service))
    handler.addFilter(FloodFilter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # what it would say is raised by our client
