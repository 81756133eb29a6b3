"""Search for the rack while the link to it is out of step: the control PLC reads what the rack applies, until it is."""

import asyncio
import contextlib
import logging
import time
from typing import Final

from coldloop.errors import LinkError, PeerUnreachableError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.control_plc import LinkCause, PlantLinkState
from coldloop.registers.plant import Measurement
from coldloop.registers.safety import LeaseState, LeaseStatus
from coldloop_control_plc.plant_link import PlantLink
from coldloop_control_plc.rack_clock import PHASE, RackClock
from coldloop_control_plc.scan_cycle import ScanCycle

log = logging.getLogger("coldloop.control_plc")

SEARCH_S: Final = 0.5
"""How long one attempt to reach a lost rack may take, at least."""
LOOK_PAUSE_S: Final = 0.1
"""Between two reads of a rack that is not synchronised."""
AT_ONCE: Final = 2
"""Looks after a break without a pause: the second confirms what the first has shown."""


class RackFinder:
    """Looks at the rack.

    Args:
        rack: Client of the rack.
        link: The link to it.
        cycle: Takes what is read, and what fails.
        clock: Goes by the rack from the reading on that brings the link into step.
        power_up_s: A rack that has not answered since our start counts as lost after so long, in real time.
    """

    def __init__(
        self, rack: RegisterClient, link: PlantLink, cycle: ScanCycle, clock: RackClock, *, power_up_s: float
    ) -> None:
        self._rack = rack
        self._link = link
        self._cycle = cycle
        self._clock = clock
        self._looks = 0
        self._lost_from = time.monotonic() + power_up_s
        self.reached = False
        """The rack has answered at least once since the start."""

    def read_soon(self) -> None:
        """Make the next looks without a pause before them."""
        self._looks = 0

    async def reach(self) -> bool:
        """Try once to reach the rack, without a session; return whether it answers."""
        try:
            await self._rack.connect(SEARCH_S)
        except LinkError as error:
            self.failed(error)
            return False
        self.reached = True
        return True

    async def look(self, changed: asyncio.Event, patience_s: float | None) -> bool:
        """Read what the rack applies, once; return whether it has answered and has no other master.

        Args:
            changed: What ends the pause between two looks.
            patience_s: How long it may take in real time; None in lock-step.
        """
        if self._looks >= AT_ONCE:
            await self.pause(changed)
        self._looks += 1
        limit = None if patience_s is None else max(SEARCH_S, patience_s)
        try:
            async with asyncio.timeout(limit):
                reading, at = await self._read_back()
        except TimeoutError:
            self.failed(PeerUnreachableError(f"{self._rack.peer} has not answered within {limit:g} s"))
        except LinkError as error:
            self.failed(error)
        else:
            self.reached = True
            if reading is not None:
                self._take(reading, at, realtime=patience_s is not None)
                return True
        return False

    async def _read_back(self) -> tuple[Measurement | None, float]:
        """Return what the rack applies, None while another control PLC holds it, and when it was read, s.

        Raises:
            LinkError: The rack does not answer.
        """
        if self._link.state is PlantLinkState.SEARCHING or not self._rack.connected:
            await self._rack.connect(SEARCH_S)
        lease = await self._rack.read(LeaseStatus) if self._link.cause is LinkCause.SECOND_MASTER else None
        asked_at = time.monotonic()
        reading = await self._rack.read(Measurement)
        held = lease is not None and self._is_held_by_another(lease, reading)
        return None if held else reading, (asked_at + time.monotonic()) / 2

    def _is_held_by_another(self, lease: LeaseStatus, reading: Measurement) -> bool:
        """Return whether the control PLC that we were refused for still holds the lease of the rack.

        One that has our number is another one if the rack has counted that it refused us.
        """
        if lease.holder == self._link.holder:
            return lease.state == LeaseState.HELD and reading.refused != self._link.refused
        return lease.state in (LeaseState.HELD, LeaseState.LINGERING)

    def _take(self, reading: Measurement, at: float, *, realtime: bool) -> None:
        """Resume from a reading if allowed; `at` is when the rack was read, s."""
        self._cycle.answered(reading, at / self._clock.tick_s if realtime else None)
        if self._link.synchronised:
            # at tick 0 the rack's clock waits for the first outputs
            self._clock.synchronise(reading.tick + (reading.age or (0.0 if reading.tick else PHASE)), at)

    async def pause(self, changed: asyncio.Event) -> None:
        """Wait before the next look, unless something changes."""
        changed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(min(LOOK_PAUSE_S, max(0.005, self._clock.tick_s))):
                await changed.wait()

    def failed(self, error: LinkError) -> None:
        """Note that a request came to nothing; a rack that is being powered up with us is not lost yet."""
        if not self.reached and time.monotonic() < self._lost_from:
            self._link.starting()
            return
        self._cycle.failed(error)
        log.warning("plant not synchronised", extra={"reason": str(error), "tick": self._link.tick})
