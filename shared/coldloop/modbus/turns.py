"""Divides the turns of the event loop: a control program's timers and answers come between a few requests each.

Timers are looked at once in a turn of the event loop, so a scan is as late as the turn in which it falls due is long.
In one turn requests are served for about `TURN_S`, and a few of each connection; the rest waits for later turns.
"""

import asyncio
from collections import deque
from time import monotonic
from typing import Final, Protocol

TURN_S: Final = 0.001
"""Time for requests in one turn. A request that is being served is finished."""
REQUESTS_AT_ONCE: Final = 16
"""Requests of one connection before it is the turn of the next one."""


class Client(Protocol):
    """What a connection offers to be served in turns."""

    has_role: bool

    def serve_some(self, until: float) -> bool:
        """Serve a few requests, none after `until` (monotonic time, s); return whether there are more."""


class Turns:
    """Whose requests are served when; one for each server.

    Clients with a role are served before those without, each kind in the order of arrival. Where clients with a role
    take all the time, one of the others is still served in each turn.
    """

    def __init__(self) -> None:
        self._with_role: deque[Client] = deque()
        self._without: deque[Client] = deque()
        self._until = 0.0
        self._begun = False

    def until(self) -> float:
        """Return until when requests may be served in this turn (monotonic time, s), or 0 when the time is used up."""
        now = monotonic()
        if not self._begun:
            self._begun = True
            self._until = now + TURN_S
            asyncio.get_running_loop().call_soon(self._next_turn)
        return self._until if now < self._until else 0.0

    def queue(self, client: Client) -> None:
        """Serve a client in a later turn; `until` has been called in this one."""
        (self._with_role if client.has_role else self._without).append(client)

    def _next_turn(self) -> None:
        if not self._with_role and not self._without:
            self._begun = False  # what arrives next begins a turn of its own
            return
        # Requests that arrive in this turn share its time with those that have waited for it.
        asyncio.get_running_loop().call_soon(self._next_turn)
        self._until = monotonic() + TURN_S
        self._serve(self._with_role)
        if self._without:
            self._serve_one(self._without)
        self._serve(self._without)

    def _serve(self, clients: deque[Client]) -> None:
        while clients and monotonic() < self._until:
            self._serve_one(clients)

    def _serve_one(self, clients: deque[Client]) -> None:
        client = clients.popleft()
        if client.serve_some(self._until):
            clients.append(client)
