"""A watchdog that counts ticks of plant time: the watched client triggers it, otherwise it expires."""

from coldloop.registers import safety


class Watchdog:
    """Expires when it has not been triggered for `time` ticks; 0 is off. A trigger starts it again."""

    def __init__(self, time: int) -> None:
        self.triggered = 0
        self.trips = 0
        self.set(time, 0)

    def set(self, time: int, tick: int) -> None:
        """Change the time-out and restart at `tick`."""
        self.time = time
        self.lowest = time
        self.expired = False
        self.triggered = tick

    def trigger(self, tick: int) -> None:
        """Trigger it at `tick`."""
        self.lowest = min(self.lowest, self._remaining(tick))
        self.triggered = tick
        self.expired = False

    def set_back(self, tick: int) -> None:
        """Set the time back to a tick before the present one."""
        self.triggered = min(self.triggered, tick)

    def check(self, tick: int) -> bool:
        """Return whether it expires at `tick`; once for each time that it does."""
        if not self.time or self.expired or self._remaining(tick) > 0:
            return False
        self.expired = True
        self.lowest = 0
        self.trips += 1
        return True

    def _remaining(self, tick: int) -> int:
        return min(self.time, max(0, self.time - (tick - self.triggered)))

    def registers(self, tick: int) -> safety.WatchdogStatus:
        """Return what its registers show at `tick`."""
        running = safety.WatchdogState.RUNNING if self.time else safety.WatchdogState.OFF
        state = safety.WatchdogState.EXPIRED if self.expired else running
        remaining = 0 if self.expired else self._remaining(tick)
        return safety.WatchdogStatus(self.time, state, remaining, self.lowest, self.trips & 0xFFFF)
