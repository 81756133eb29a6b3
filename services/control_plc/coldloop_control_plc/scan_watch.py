"""Whether scans are made, watched from outside of them: an alarm that they are not cannot come from a scan. Pure."""

from typing import Final

LOOK_S: Final = 0.25
"""Real time between two looks."""
LOOKS: Final = 8
"""Looks without a scan between them after which scans have stopped: looks, so that a process that had no processor time
does not take that for a fault."""
SCANS: Final = 8
"""Scans that are missing then, at least, where the factor is low."""


class ScanWatch:
    """Counts checks since the last scan."""

    def __init__(self) -> None:
        self._looks = 0

    def scanned(self) -> None:
        """Note that a scan was made, or that none is expected."""
        self._looks = 0

    def look(self, tick_s: float) -> bool:
        """Return, `LOOK_S` after the last check, whether scans have stopped; a tick lasts `tick_s` of real time."""
        self._looks += 1
        return self._looks > max(LOOKS, SCANS * tick_s / LOOK_S)
