"""Services as processes, and brokers to publish to."""

import asyncio
import contextlib
import json
import os
import shutil
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any, Protocol

import aiomqtt
import pytest

from tests.harness.processes import Process, Processes

# -- processes ---------------------------------------------------------------------------------------------------------

Start = Callable[..., Process]


@pytest.fixture
def start(processes: Processes) -> Start:
    """Start a service with `--set` assignments; its peer is where nobody listens, unless they say otherwise."""
    nobody = processes.free_port()

    def one(service: str, *assignments: str, level: str = "error", **how: Any) -> Process:  # noqa: ANN401 - of `service`
        ports = {"plant": [], "control_plc": ["plant"], "optimizer_plc": ["control_plc"]}[service]
        peers = [f"{service}.{peer}.port={nobody}" for peer in ports]
        return processes.service(service, *peers, *assignments, level=level, **how)

    return one


# -- brokers -----------------------------------------------------------------------------------------------------------


class Broker(Protocol):
    """What a test sees of a broker."""

    async def retained(self, topic: str) -> Any:  # noqa: ANN401 - JSON
        """Return what the broker keeps on a topic, read strictly as JSON; None is nothing."""


Serve = Callable[[int], AbstractAsyncContextManager[Broker]]


def strict_json(payload: bytes) -> Any:  # noqa: ANN401 - JSON
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    return json.loads(payload, parse_constant=refuse)


class SmallBroker:
    """As much of MQTT 3.1.1 as a publisher needs: retained messages, acknowledgements, last wills."""

    def __init__(self) -> None:
        self._kept: dict[str, bytes] = {}
        self.password = b""
        """Whoever connects has to know it, if there is one."""
        self.frozen = False
        """It takes what comes, and answers nothing."""
        self._connections: dict[asyncio.StreamWriter, asyncio.Task[object] | None] = {}

    async def hang_up(self) -> None:
        for writer in self._connections:
            writer.transport.abort()
        await asyncio.gather(*(task for task in self._connections.values() if task))

    async def retained(self, topic: str) -> Any:  # noqa: ANN401 - JSON
        return strict_json(self._kept[topic]) if topic in self._kept else None

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        will: tuple[str, bytes] | None = None
        self._connections[writer] = asyncio.current_task()
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionResetError):
            while True:
                kind, body = await self._packet(reader)
                if self.frozen:
                    continue
                if kind >> 4 == 1:
                    will, password = self._connect(body)
                    if password != self.password:
                        writer.write(b"\x20\x02\0\x05")
                        break
                    writer.write(b"\x20\x02\0\0")
                elif kind >> 4 == 3:
                    self._publish(kind, body, writer)
                elif kind >> 4 == 12:
                    writer.write(b"\xd0\0")
                elif kind >> 4 == 14:
                    will = None
                    break
        if will is not None:
            self._kept[will[0]] = will[1]
        writer.close()

    async def _packet(self, reader: asyncio.StreamReader) -> tuple[int, bytes]:
        kind = (await reader.readexactly(1))[0]
        length = shift = 0
        while True:
            digit = (await reader.readexactly(1))[0]
            length |= (digit & 0x7F) << shift
            shift += 7
            if digit < 0x80:
                return kind, await reader.readexactly(length)

    def _publish(self, kind: int, body: bytes, writer: asyncio.StreamWriter) -> None:
        topic, rest = self._text(body)
        if kind & 0x06:
            writer.write(b"\x40\x02" + rest[:2])
            rest = rest[2:]
        if kind & 0x01:
            self._kept[topic.decode()] = rest

    def _connect(self, body: bytes) -> tuple[tuple[str, bytes] | None, bytes]:
        """Return the last will and the password."""
        _, rest = self._text(body)
        flags = rest[1]
        _, rest = self._text(rest[4:])
        will = None
        if flags & 0x04:
            assert flags & 0x20, "a last will that is not retained tells nobody who comes later"
            topic, rest = self._text(rest)
            message, rest = self._text(rest)
            will = topic.decode(), message
        for flag in (0x80, 0x40):  # name, password
            field, rest = self._text(rest) if flags & flag else (b"", rest)
        return will, field

    @staticmethod
    def _text(data: bytes) -> tuple[bytes, bytes]:
        (length,) = struct.unpack_from(">H", data)
        return data[2 : 2 + length], data[2 + length :]


@contextlib.asynccontextmanager
async def small_broker(port: int) -> AsyncIterator[SmallBroker]:
    broker = SmallBroker()
    server = await asyncio.start_server(broker.serve, "127.0.0.1", port)
    async with server:
        try:
            yield broker
        finally:
            await broker.hang_up()


ServeFrozen = Callable[[int], AbstractAsyncContextManager[SmallBroker]]


class Mosquitto:
    """A real broker, asked by a client that comes later."""

    def __init__(self, port: int) -> None:
        self._port = port

    async def retained(self, topic: str) -> Any:  # noqa: ANN401 - JSON
        async with aiomqtt.Client("127.0.0.1", self._port) as client:
            await client.subscribe(topic, qos=1)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.2):
                    async for message in client.messages:
                        if message.retain:
                            return strict_json(bytes(message.payload))
        return None


@contextlib.asynccontextmanager
async def mosquitto(port: int, program: str, folder: Path) -> AsyncIterator[Mosquitto]:
    settings = folder / "mosquitto.conf"
    settings.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\nuser root\n")
    process = await asyncio.create_subprocess_exec(
        program, "-c", settings, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL
    )
    try:
        while True:
            assert process.returncode is None, "mosquitto has ended"
            with contextlib.suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.close()
                break
            await asyncio.sleep(0.02)
        yield Mosquitto(port)
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


@pytest.fixture
def frozen_broker() -> ServeFrozen:
    """A broker that can be frozen."""
    return small_broker


@pytest.fixture(params=["small", "mosquitto"])
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Serve:
    """Each story is told to a small broker of our own, and to a real one where there is one."""
    if request.param == "small":
        return small_broker
    program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    if program is None:
        pytest.skip("no mosquitto here")
    return lambda port: mosquitto(port, program, tmp_path)
