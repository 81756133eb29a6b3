"""How fast a connection may ask."""

from time import monotonic

from coldloop.modbus.settings import ServerSettings


class RateLimit:
    """A token bucket: `rate` requests a second, and up to `burst` at once."""

    def __init__(self, rate: float, burst: int) -> None:
        self.rate = rate
        self._burst = float(burst)
        self._tokens = self._burst
        self._filled_at = monotonic()

    def take(self) -> float:
        """Take the right to one request; return 0, or in how many seconds there will be one."""
        now = monotonic()
        self._tokens = min(self._burst, self._tokens + (now - self._filled_at) * self.rate)
        self._filled_at = now
        if self._tokens < 1.0:
            return (1.0 - self._tokens) / self.rate
        self._tokens -= 1.0
        return 0.0


def rate_limit_of(settings: ServerSettings, *, has_role: bool) -> RateLimit | None:
    """Return the limit of a connection, None where it has none."""
    if has_role:
        return RateLimit(settings.request_rate, settings.request_burst) if settings.request_rate else None
    rates = [rate for rate in (settings.request_rate, settings.reader_request_rate) if rate]
    return RateLimit(min(rates), settings.request_burst) if rates else None
