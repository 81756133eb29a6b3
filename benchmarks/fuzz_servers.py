"""Sends seeded nonsense to the three services: do they live, keep their memory, log no traceback, and still answer?

Frames are valid requests of the service's own map, FC23 more often than others, that were damaged: bits flipped, words
replaced, cut off, spliced with another, wrong lengths. Then come random bytes, half of them in sound headers. Frames
are sent many at a time; where the server closes the connection, as it must after a damaged header, another is opened.

    .venv/bin/python benchmarks/fuzz_servers.py --frames 100000 --bytes 10000000 --seed 1
    .venv/bin/python benchmarks/fuzz_servers.py --tls                                # the same over TLS
    .venv/bin/python benchmarks/fuzz_servers.py --tls --frames 2000 --bytes 100000   # in short

Over TLS each connection has the certificate of another client, with and without a role. The frames and the bytes are
for each of the three. Ends with 1 when one of them fails.
"""

import argparse
import asyncio
import random
import ssl
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from coldloop.config import load_configuration
from coldloop.modbus.settings import TlsSettings
from coldloop.modbus.tls import tls_context
from coldloop.process.cold_box import COLD_BOX
from coldloop.registers import maps_of
from coldloop.registers.common import STATISTICS_BLOCK
from coldloop.registers.declaration import RegisterMap
from coldloop_chaos.sequencer import resident_mb
from coldloop_rig import cli
from coldloop_rig.cli.certificates import CLIENTS
from coldloop_rig.cosim.networked_run import LocalServices
from coldloop_rig.cosim.wiring import SERVICES
from coldloop_rig.settings import Settings

MAPS = maps_of(COLD_BOX).by_service

BATCH = 64
WARM_UP_FRAMES = 2000
SILENCE_S = 10.0
"""A server that owes answers and says nothing for so long has failed."""
START_S = 90.0
ODD_WORDS = (0, 1, 2, 121, 122, 123, 124, 125, 126, 0x7F80, 0x7FC0, 0x7FFF, 0x8000, 0xFF80, 0xFFFF)
READ_MAGIC = bytes.fromhex("03 0000 0002")
MAGIC = bytes.fromhex("03 04 42f6e979")
READ_STATISTICS = struct.pack(">BHH", 3, STATISTICS_BLOCK.address, 5)
WAITS = "await update"
"""A block whose writing makes the answer wait: written now and then only, or most of the time would be waiting."""
SENTINEL = 0xABCD
"""Transaction of the last requests of a batch over TLS, where there is no end of the stream to tell that it is one."""
SENTINELS = 24
"""More of them than a frame that was cut off can swallow."""


def framed(pdu: bytes, transaction: int = 1) -> bytes:
    """Return a request in a sound header."""
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, 1) + pdu


@dataclass
class Door:
    """Where a server is, and with which certificates to go in; none is plain Modbus/TCP."""

    port: int
    certificates: list[ssl.SSLContext]
    opened: int = 0

    async def open(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Connect, with the next certificate."""
        self.opened += 1
        tls = self.certificates[self.opened % len(self.certificates)] if self.certificates else None
        return await asyncio.open_connection("127.0.0.1", self.port, ssl=tls)


class Requests:
    """Valid requests of one map, and damaged ones."""

    def __init__(self, register_map: RegisterMap, chance: random.Random, *, waits: bool) -> None:
        self._chance = chance
        self._blocks = register_map.blocks
        self._writable = [block for block in register_map.blocks if block.writer is not None and block.name != WAITS]
        self._all_writable = [
            block for block in register_map.blocks if block.writer is not None and (waits or block.name != WAITS)
        ]

    def valid(self) -> bytes:
        """Return the PDU of a request that is right but for its values."""
        chance = self._chance
        kind = chance.choice((23, 23, 23, 16, 16, 6, 22, 3, 4, 43))
        block = chance.choice(self._writable if chance.random() < 0.999 else self._all_writable)
        count = min(block.row_words, 60)
        data = b"".join(chance.choice((bytes(2), bytes((0, 1)), chance.randbytes(2))) for _ in range(count))
        read = chance.choice(self._blocks)
        where = struct.pack(">HH", read.address, min(read.row_words, 125))
        write = struct.pack(">HHB", block.address, count, 2 * count) + data
        bodies = {
            23: where + write,
            16: write,
            6: struct.pack(">H", block.address) + chance.randbytes(2),
            22: struct.pack(">H", block.address) + chance.randbytes(4),
            43: bytes((14, chance.randrange(1, 5), 0)),
        }
        return bytes((kind,)) + bodies.get(kind, where)

    def damaged(self) -> bytes:
        """Return a PDU with something wrong, of 1 to 253 bytes."""
        chance = self._chance
        pdu = bytearray(self.valid())
        what = chance.randrange(6)
        if what == 0:
            for _ in range(chance.randrange(1, 9)):
                pdu[chance.randrange(len(pdu))] ^= 1 << chance.randrange(8)
        elif what == 1:
            at = chance.randrange(1, len(pdu))
            pdu[at : at + 2] = struct.pack(">H", chance.choice(ODD_WORDS))
        elif what == 2:
            del pdu[chance.randrange(1, len(pdu)) :]
        elif what == 3:
            other = self.valid()
            pdu = pdu[: chance.randrange(1, len(pdu) + 1)] + other[chance.randrange(len(other)) :]
        elif what == 4:
            pdu += chance.randbytes(chance.randrange(1, 40))
        return bytes(pdu[:253])

    def broken_header(self) -> bytes:
        """Return a frame whose header is damaged or whose length is wrong."""
        frame = bytearray(framed(self.damaged()))
        frame[self._chance.randrange(2, 6)] ^= 1 << self._chance.randrange(8)
        return bytes(frame)

    def batches(self, frames: int) -> Iterator[tuple[int, bytes]]:
        """Yield the number of frames and their bytes; a broken header can only be the last of its batch."""
        for first in range(0, frames, BATCH):
            count = min(BATCH, frames - first)
            sound = [framed(self.damaged(), number) for number in range(count - 1)]
            last = self.broken_header() if self._chance.random() < 0.5 else framed(self.damaged(), count)
            yield count, b"".join([*sound, last])

    def garbage(self, size: int) -> Iterator[bytes]:
        """Yield random bytes, bare and in sound headers by turns."""
        while size > 0:
            bare = self._chance.randbytes(4096)
            dressed = b"".join(
                framed(self._chance.randbytes(self._chance.randrange(1, 254))) for _ in range(4096 // 128)
            )
            for chunk in (bare, dressed):
                yield chunk[:size]
                size -= len(chunk)


@dataclass
class Tally:
    """What came of it."""

    frames: int = 0
    sent: int = 0
    received: int = 0
    served: int = 0
    connections: int = 0
    failures: list[str] = field(default_factory=list)


async def provoke(door: Door, data: bytes, tally: Tally) -> None:
    """Send bytes; read what is answered until the server closes, or has answered the last request."""
    reader, writer = await door.open()
    tally.connections += 1
    tally.sent += len(data)
    end = framed(MAGIC, SENTINEL)
    tail = b""
    try:
        if writer.can_write_eof():
            writer.write(data)
            writer.write_eof()
        else:
            writer.write(data + framed(READ_MAGIC, SENTINEL) * SENTINELS)
        while not tail.endswith(end) and (received := await asyncio.wait_for(reader.read(65536), SILENCE_S)):
            tally.received += len(received)
            tail = (tail + received)[-len(end) :]
    except (ConnectionError, ssl.SSLError):
        pass  # closed with bytes unread
    except TimeoutError:
        tally.failures.append(f"silent for {SILENCE_S:g} s")
    finally:
        writer.transport.abort()


async def ask(door: Door, pdu: bytes) -> bytes:
    """Return the answer to a valid request, empty when there is none."""
    reader, writer = await door.open()
    try:
        writer.write(framed(pdu))
        head = await asyncio.wait_for(reader.readexactly(7), SILENCE_S)
        return await reader.readexactly(head[5] - 1)
    except (TimeoutError, OSError, asyncio.IncompleteReadError):
        return b""
    finally:
        writer.transport.abort()


async def up(port: int) -> None:
    """Wait until a server listens."""
    deadline = time.monotonic() + START_S
    while True:
        try:
            _, writer = await asyncio.open_connection("127.0.0.1", port)
        except ConnectionRefusedError:
            if time.monotonic() > deadline:
                raise
            await asyncio.sleep(0.1)
        else:
            writer.close()
            return


def site(folder: Path) -> Settings:
    """Make certificates; return the configuration that puts TLS on everything."""
    if cli.main(["certificates", "--out", str(folder)]):
        raise SystemExit(1)
    return load_configuration(Settings, file=folder / "tls.toml", environment={}).settings


def certificates(folder: Path) -> list[ssl.SSLContext]:
    """Return what clients of each kind connect with."""
    files = [(folder / f"{name}.crt", folder / f"{name}.key") for name in CLIENTS]
    ca = folder / "ca.crt"
    return [tls_context(TlsSettings(certificate=certificate, key=key, ca=ca), "fuzz") for certificate, key in files]


def text_of(log: Path) -> str:
    """Return a log."""
    return log.read_text(encoding="utf-8", errors="replace")


async def fuzz(service: str, services: LocalServices, folder: Path, options: argparse.Namespace) -> tuple[str, bool]:
    """Fuzz one service; return its line of the table, and whether it passed."""
    chance = random.Random(f"{options.seed} {service}")  # noqa: S311 - must be repeatable
    requests = Requests(MAPS[service], chance, waits=not options.tls)
    door = Door(getattr(services.endpoints, service).port, certificates(folder) if options.tls else [])
    log = services.log(service)
    await up(door.port)
    tally = Tally()
    before, began = 0.0, time.monotonic()
    try:
        for count, data in requests.batches(options.frames):
            if not before and tally.frames >= min(WARM_UP_FRAMES, options.frames // 2):
                before = resident_mb(services)[service]
            await provoke(door, data, tally)
            tally.frames += count
        for data in requests.garbage(options.bytes):
            await provoke(door, data, tally)
        if await ask(door, READ_MAGIC) != MAGIC:
            tally.failures.append("a valid request got no valid answer")
        statistics = await ask(door, READ_STATISTICS)
        tally.served = int.from_bytes(statistics[8:12], "big")
    except ConnectionRefusedError:
        tally.failures.append("no longer listens")
    seconds = time.monotonic() - began
    ended = services.ended(service)
    if ended:
        tally.failures.append("ended")
    if "Traceback" in text_of(log):
        tally.failures.append("traceback in its log")
    after = 0.0 if ended else resident_mb(services)[service]
    outcome = ", ".join(dict.fromkeys(tally.failures)) or "passed"
    line = _row(
        service, tally.frames, tally.served, tally.sent, tally.received, tally.connections,
        f"{seconds:.0f}", f"{before:.1f}", f"{after:.1f}",
    )  # fmt: skip
    return f"{line}  {outcome}", not tally.failures


def _row(service: str, *cells: object) -> str:
    return f"{service:<14}" + "".join(f"{cell:>12}" for cell in cells)


async def main(options: argparse.Namespace) -> int:
    """Fuzz all three; return the exit code."""
    print(_row("service", "frames", "served", "sent", "received", "connections", "seconds", "MB then", "MB now"))
    passed = True
    with tempfile.TemporaryDirectory() as folder:
        settings = site(Path(folder)) if options.tls else Settings()
        async with LocalServices(settings, Path(folder)) as services:
            for service in options.service or SERVICES:
                line, one_passed = await fuzz(service, services, Path(folder), options)
                print(line, flush=True)
                passed = passed and one_passed
        if not passed:
            for service in SERVICES:
                log = text_of(Path(folder) / f"{service}.log")
                print(f"--- the end of the log of {service}", *log.splitlines()[-options.log_lines :], sep="\n")
    return 0 if passed else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(allow_abbrev=False, description="Sends seeded nonsense to the three services.")
    parser.add_argument("--frames", type=int, default=100_000, help="damaged requests for each (default: 100000)")
    parser.add_argument("--bytes", type=int, default=10_000_000, help="random bytes for each (default: 10000000)")
    parser.add_argument("--tls", action="store_true", help="over TLS")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--service", action="append", choices=SERVICES, help="only this one; may be repeated")
    parser.add_argument("--log-lines", type=int, default=5, help="lines of each log to show after a failure")
    sys.exit(asyncio.run(main(parser.parse_args())))
