"""A watchdog that counts ticks of plant time: the watched client triggers it, otherwise it expires."""

from dataclasses import dataclass

from coldloop.registers import common


def remaining(watchdog: "Watchdog", tick: int) -> int:
    """Return the ticks until it expires. It and what follows are plain Python that the rig compiles too."""
    return min(watchdog.time, max(0, watchdog.time - (tick - watchdog.triggered)))


def expire(watchdog: "Watchdog", tick: int) -> bool:
    """Return whether it expires at a tick, and let it; once for each time that it does."""
    if watchdog.time == 0 or watchdog.expired or remaining(watchdog, tick) > 0:
        return False
    watchdog.expired, watchdog.lowest = True, 0
    watchdog.trips += 1
    return True


def trigger(watchdog: "Watchdog", tick: int) -> None:
    """Trigger it at `tick`."""
    watchdog.lowest = min(watchdog.lowest, remaining(watchdog, tick))
    watchdog.triggered = tick
    watchdog.expired = False


@dataclass(slots=True, init=False, eq=False)
class Watchdog:
    """Expires when it has not been triggered for `time` ticks; 0 is off. A trigger starts it again."""

    time: int
    triggered: int
    lowest: int
    expired: bool
    trips: int

    def __init__(self, time: int) -> None:
        self.trips = 0
        self.set(time, 0)

    def set(self, time: int, tick: int) -> None:
        """Change the time-out and restart at `tick`."""
        self.time = time
        self.lowest = time
        self.expired = False
        self.triggered = tick

    check, trigger = expire, trigger

    def set_back(self, tick: int) -> None:
        """Set the time back to a tick before the present one."""
        self.triggered = min(self.triggered, tick)

    def registers(self, tick: int) -> common.WatchdogStatus:
        """Return what its registers show at `tick`."""
        running = common.WatchdogState.RUNNING if self.time else common.WatchdogState.OFF
        state = common.WatchdogState.EXPIRED if self.expired else running
        left = 0 if self.expired else remaining(self, tick)
        return common.WatchdogStatus(self.time, state, left, self.lowest, self.trips & 0xFFFF)
