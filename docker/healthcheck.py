"""Healthy is a service that answers and, if it scans, runs a session that goes on from tick to tick in real time.

Needs the standard library only and reads no configuration files, so that it costs next to nothing. The service, its
port and its certificates are those of the environment.
"""  # noqa: INP001 a program, not a package

import os
import socket
import struct
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

PORTS = {"plant": 5020, "control_plc": 5021, "optimizer_plc": 5022}
SESSIONS = {"plant": 400, "control_plc": 450}
"""Who scans, and the address of the block that starts a session: its number, and whether it is in real time.

The optimiser has nothing to do while somebody else drives, and before that no session."""
IDENTITY_WORDS = 13
MAGIC = struct.pack(">f", 123.456)
RUNNING = 1
PATIENCE_S = 4.0
TICK_PATIENCE_S = float(os.environ.get("HEALTHCHECK_TICK_PATIENCE_S", PATIENCE_S))
"""How long a tick may last."""
PAUSE_S = 0.05

Read = Callable[[int, int], bytes]
"""Returns so many words from an address on."""


class UnhealthyError(Exception):
    """What is wrong."""


class Identity(NamedTuple):
    """What the first block of every register map tells."""

    low_first: bool
    state: int
    session: int
    tick: int


def main() -> str | None:
    """Return what is wrong, or None."""
    service = os.environ["SERVICE"]
    port = int(os.environ.get(f"COLDLOOP__{service.upper()}__SERVER__PORT", PORTS[service]))
    try:
        with connected(port) as connection:
            examine(service, reader_of(connection))
    except (OSError, UnhealthyError) as error:
        return f"{service} on port {port}: {error}"
    return None


def connected(port: int) -> socket.socket:
    """Return a connection, secured where the environment names certificates."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
    certificate = os.environ.get("HEALTHCHECK_TLS_CERTIFICATE")
    if not certificate:
        return connection
    import ssl  # noqa: PLC0415 takes longer than all the rest

    context = ssl.create_default_context(cafile=os.environ["HEALTHCHECK_TLS_CA"])
    context.load_cert_chain(certificate, os.environ["HEALTHCHECK_TLS_KEY"])
    return context.wrap_socket(connection, server_hostname="127.0.0.1")


def reader_of(connection: socket.socket) -> Read:
    """Return how to read registers over a connection."""
    stream = connection.makefile("rb")

    def read(address: int, words: int) -> bytes:
        connection.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 255, 3, address, words))
        expected = struct.pack(">HHHBBB", 1, 0, 3 + 2 * words, 255, 3, 2 * words)
        answer = stream.read(len(expected))
        if answer != expected:
            raise UnhealthyError(f"not a register map of ours: {answer.hex()}")
        return stream.read(2 * words)

    return read


def examine(service: str, read: Read) -> None:
    """Raise what is wrong."""
    first = identity(read)
    if service not in SESSIONS:
        return
    if first.state != RUNNING:
        raise UnhealthyError("runs no session")
    if not in_real_time(service, first, read):
        return
    deadline = time.monotonic() + TICK_PATIENCE_S
    while time.monotonic() < deadline:
        time.sleep(PAUSE_S)
        if identity(read) != first:
            return
    raise UnhealthyError(f"stays at tick {first.tick}")


def identity(read: Read) -> Identity:
    """Return what the service says of itself."""
    words = read(0, IDENTITY_WORDS)
    if words[:4] not in {MAGIC, MAGIC[2:] + MAGIC[:2]}:
        raise UnhealthyError(f"not a register map of ours: {words.hex()}")
    low_first = words[:4] != MAGIC
    (state,) = struct.unpack_from(">H", words, 2 * 5)
    return Identity(low_first, state, number(words[16:20], low_first), number(words[20:24], low_first))


def number(data: bytes, low_first: bool) -> int:  # noqa: FBT001 - as the register map says it
    """Return the number in two registers."""
    first, second = struct.unpack(">HH", data)
    return second << 16 | first if low_first else first << 16 | second


def in_real_time(service: str, now: Identity, read: Read) -> bool:
    """Return whether the session goes by the clock: as somebody started it, or by the configuration."""
    block = read(SESSIONS[service], 3)
    if number(block[:4], now.low_first) == now.session:
        return block[4:6] != b"\0\0"
    return os.environ.get("COLDLOOP__SESSION__MODE") == "realtime"


if __name__ == "__main__":
    sys.exit(main())
