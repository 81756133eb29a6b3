"""Rings of rows, such as histories and journals: number n is in row n modulo the number of rows."""

from typing import TypeVar

from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import Identity
from coldloop.registers.optimizer_plc import HISTORY_ROWS, Optimization

R = TypeVar("R", bound=tuple[object, ...])


async def read_ring(client: RegisterClient, record: type[R], ring: int, first: int, last: int) -> list[R]:
    """Return the rows of the numbers `first` to `last`, `ring` or fewer; one that was overwritten has a newer number.

    Raises:
        LinkError: The service does not answer, or refuses.
    """
    start, count = first % ring, max(0, last - first + 1)
    behind = min(count, ring - start)
    rows = await client.read_rows(record, start, behind)
    return rows + await client.read_rows(record, 0, count - behind)


async def last_update(optimizer: RegisterClient, identity: Identity) -> Optimization | None:
    """Return the update that an optimiser, which has this identity, has done last; None before the first."""
    if not identity.heartbeat:
        return None
    newest = identity.heartbeat - 1
    (update,) = await read_ring(optimizer, Optimization, HISTORY_ROWS, newest, newest)
    return update
