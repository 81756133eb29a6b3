"""What a server refuses: counted always, logged now and then."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

LOG_INTERVAL_S: Final = 10.0

_logger = logging.getLogger("coldloop.modbus")


@dataclass(slots=True)
class ErrorCounters:
    """Errors since the server was made, by kind."""

    illegal_function: int = 0
    illegal_address: int = 0
    illegal_value: int = 0
    server_failure: int = 0
    unknown_unit: int = 0
    malformed_frame: int = 0
    idle_timeout: int = 0
    connection_evicted: int = 0
    connection_refused: int = 0
    access_refused: int = 0
    tls_refused: int = 0
    rate_limited: int = 0
    second_writer: int = 0


class RefusalLog:
    """Counts each refusal and logs at most one line of a kind in `LOG_INTERVAL_S`, so that no client floods the log.

    Args:
        service: Whose refusals these are.
        on_refusal: Called with the kind of every one.
    """

    def __init__(self, service: str, on_refusal: Callable[[str], None] | None = None) -> None:
        self.counters = ErrorCounters()
        self._service = service
        self._on_refusal = on_refusal
        self._next_line = dict.fromkeys((field.name for field in fields(ErrorCounters)), 0.0)
        self._unlogged = dict.fromkeys(self._next_line, 0)

    def note(self, kind: str, peer: str, reason: str) -> None:
        """Count a refusal of `kind`, a field of `ErrorCounters`."""
        setattr(self.counters, kind, getattr(self.counters, kind) + 1)
        if self._on_refusal is not None:
            self._on_refusal(kind)
        now = time.monotonic()
        if now < self._next_line[kind]:
            self._unlogged[kind] += 1
            return
        _logger.warning(
            "service=%s kind=%s peer=%s unlogged=%d reason=%s", self._service, kind, peer, self._unlogged[kind], reason
        )
        self._next_line[kind] = now + LOG_INTERVAL_S
        self._unlogged[kind] = 0
