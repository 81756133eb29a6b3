"""Healthy is who answers on its Modbus port with the number that starts every register map.

Needs the standard library only and reads no configuration files, so that it costs next to nothing. The service and
its port are those of the environment.
"""  # noqa: INP001 a program, not a package

import os
import socket
import struct
import sys

PORTS = {"plant": 5020, "control_plc": 5021, "optimizer_plc": 5022}
READ_MAGIC = struct.pack(">HHHBBHH", 1, 0, 6, 255, 3, 0, 2)
MAGIC = struct.pack(">f", 123.456)
ANSWERS = [struct.pack(">HHHBBB", 1, 0, 7, 255, 3, 4) + words for words in (MAGIC, MAGIC[2:] + MAGIC[:2])]
"""With the high word first, and with the low word first."""


def main() -> str | None:
    """Return what is wrong, or None."""
    service = os.environ["SERVICE"]
    port = int(os.environ.get(f"COLDLOOP__{service.upper()}__SERVER__PORT", PORTS[service]))
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=4) as connection:
            connection.sendall(READ_MAGIC)
            answer = connection.makefile("rb").read(len(ANSWERS[0]))
    except OSError as error:
        return f"{service} on port {port}: {error}"
    return None if answer in ANSWERS else f"{service} on port {port}: not a register map of ours: {answer.hex()}"


if __name__ == "__main__":
    sys.exit(main())
