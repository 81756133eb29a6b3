"""Ports on localhost for services that are started here."""

import socket
import sys
from typing import Final, Self

HOST: Final = "127.0.0.1"


class ReservedPorts:
    """Ports reserved until they are released; a context that releases them.

    A socket that never listens is bound to each. Servers may listen there all the same, again and again, as they set
    SO_REUSEADDR; while none does, connections are refused. Other systems than Linux do not let two sockets have a port
    in this way: there the sockets are closed at once, and another program may take a port before its server does.

    Args:
        count: How many.
        first: Reserve it and those that follow it; 0 is any.

    Raises:
        OSError: One of them is in use.
    """

    def __init__(self, count: int, first: int = 0) -> None:
        self._sockets = [socket.socket() for _ in range(count)]
        try:
            for place, one in enumerate(self._sockets):
                one.bind((HOST, first and first + place))  # alone: only then it lets servers in
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        except (OSError, OverflowError):
            self.release()
            raise
        self.numbers = [int(one.getsockname()[1]) for one in self._sockets]
        if sys.platform != "linux":
            self.release()

    def release(self) -> None:
        """Give the ports back."""
        for one in self._sockets:
            one.close()

    def __enter__(self) -> Self:
        """Return the ports."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release them."""
        self.release()
