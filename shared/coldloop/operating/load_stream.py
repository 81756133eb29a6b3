"""A load of any length, written to the plant ahead of its clock."""

from bisect import bisect_right
from typing import Final

from coldloop.errors import LinkError, PeerUnreachableError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.plant import AHEAD_STEPS, LOAD_ROWS, LoadAhead, LoadStatus, LoadStep
from coldloop.registers.seal import sealed

LAST_TICK: Final = 2**32 - 1
KEPT_AHEAD: Final = LOAD_ROWS
"""Steps that the plant is to know in advance; it keeps twice as many."""


class LoadStream:
    """Keeps the plant supplied with the steps of a load.

    Args:
        plant: Client of the plant.
        session: Whose load it is.
        load: All of it.
        sent: Steps that the plant has already.
        begin: Tick of the session at which the load begins.

    Raises:
        UsageError: A step is beyond the last tick of a session.
    """

    def __init__(
        self, plant: RegisterClient, session: int, load: LoadProfile, *, sent: int = 0, begin: int = 0
    ) -> None:
        self._plant = plant
        self._session = session
        self._times = [begin + tick for tick in load.times]
        if self._times[-1] > LAST_TICK:
            raise UsageError(f"a load with a step at tick {self._times[-1]}: the last tick of a session is {LAST_TICK}")
        self._watts = load.watts
        self._sent = sent
        self._unanswered = 0
        """Steps behind those of which it is not known whether the plant has them."""

    @property
    def steps(self) -> int:
        """Steps of the load."""
        return len(self._times)

    @property
    def done(self) -> bool:
        """Whether the plant has all steps."""
        return self._sent >= len(self._times)

    @property
    def known_until(self) -> int | None:
        """First tick whose load the plant does not know yet; None when it knows all of it."""
        return None if self.done else self._times[self._sent]

    async def feed(self, tick: int) -> None:
        """Write what the plant should know at `tick`.

        Raises:
            LinkError: The plant does not answer; or it refuses steps, because they come too late or the session is
                another one.
        """
        while not self.done and self._sent - bisect_right(self._times, tick) < KEPT_AHEAD:
            await self._send()

    async def fill(self) -> int:
        """Write as much as the plant has room for; return how many steps it has by now.

        The first steps replace what it knew from there on, and so make room for themselves.

        Raises:
            LinkError: As `feed`.
        """
        if not self._sent:
            await self._send()
        free = (await self._plant.read(LoadStatus)).free
        while not self.done and free >= AHEAD_STEPS:
            free -= await self._send()
        return self._sent

    async def _send(self) -> int:
        """Write the next steps; return how many."""
        some = slice(self._sent, self._sent + AHEAD_STEPS)
        record = LoadAhead.first_of(self._session, self._times[some], self._watts[some])
        self._unanswered = record.length
        try:
            await self._plant.write(sealed(record, self._plant.map))
        except LinkError as error:
            if not self._sent:
                raise
            kind = PeerUnreachableError if isinstance(error, PeerUnreachableError) else LinkError
            unit, since_s = self._plant.process.load.unit, self._times[self._sent - 1] * self._plant.process.tick_s
            raise kind(
                f"{error}; of {self.steps} steps the plant has taken at least the first {self._sent}, and holds "
                f"{self._watts[self._sent - 1]:g} {unit} from {since_s:g} s on"
            ) from None
        self._sent, self._unanswered = self._sent + record.length, 0
        return record.length

    async def was_replaced(self) -> bool:
        """Return whether another client has written the load since: the last step known is not the last one sent."""
        status = await self._plant.read(LoadStatus)
        if self._unanswered and status.last_tick == self._times[self._sent + self._unanswered - 1]:
            self._sent += self._unanswered  # the answer was lost, the request was not
        self._unanswered = 0
        last = self._times[self._sent - 1] if self._sent else 0
        return status.last_tick != last


async def write_table(plant: RegisterClient, load: LoadProfile) -> int:
    """Write the load table of a session that is to begin; return the steps that are in it.

    Raises:
        LinkError: The plant does not answer, or refuses.
    """
    steps = [LoadStep(*step) for step in zip(load.times[:LOAD_ROWS], load.watts[:LOAD_ROWS], strict=True)]
    await plant.write_rows(steps)
    return len(steps)
