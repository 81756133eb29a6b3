"""How fast a connection may ask."""

from time import monotonic


class RateLimit:
    """A token bucket: `rate` requests a second, and up to `burst` at once."""

    def __init__(self, rate: float, burst: int) -> None:
        self._rate = rate
        self._burst = float(burst)
        self._tokens = self._burst
        self._filled_at = monotonic()

    def take(self) -> float:
        """Take the right to one request; return 0, or in how many seconds there will be one."""
        now = monotonic()
        self._tokens = min(self._burst, self._tokens + (now - self._filled_at) * self._rate)
        self._filled_at = now
        if self._tokens < 1.0:
            return (1.0 - self._tokens) / self._rate
        self._tokens -= 1.0
        return 0.0
