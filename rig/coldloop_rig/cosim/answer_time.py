"""The time within which a rig answers."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from coldloop.errors import PeerUnreachableError

ANSWER_S: Final = 10.0
"""How long a rig may take to answer all that a command asks at once."""
QUIET_S: Final = 20.0
"""A run gives up a rig on which nothing happens, or a service that does not answer, for this long."""


@asynccontextmanager
async def answered_in_time(what: str) -> AsyncIterator[None]:
    """Give up what is done in this context after `ANSWER_S`.

    Raises:
        PeerUnreachableError: It took longer.
    """
    try:
        async with asyncio.timeout(ANSWER_S):
            yield
    except TimeoutError:
        raise PeerUnreachableError(f"{what} takes longer than {ANSWER_S:g} s: the rig answers too slowly") from None
