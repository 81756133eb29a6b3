"""Real servers on free ports, and raw connections to them."""

import asyncio
import contextlib
import inspect
import ssl
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from coldloop.modbus.connection import Connection, RefusalLog, Turns
from coldloop.modbus.requests import RequestHandler
from coldloop.modbus.server import DeviceIdentity, ModbusServer, OnWrite, ServerSettings
from coldloop.modbus.settings import TlsSettings
from coldloop.modbus.tls import tls_context
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import Identity
from coldloop.registers.declaration import Block, RegisterMap, Role
from coldloop_rig.cli.certificates import Authority, Pair
from tests.harness.records import PLANT_MAP

PATIENCE_S = 100.0


def frame(pdu: bytes, transaction: int = 1, unit: int = 1) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


@dataclass
class Wire:
    """A connection that sends and receives bytes."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    def send(self, data: bytes) -> None:
        self.writer.write(data)

    async def answer(self) -> tuple[int, int, bytes]:
        """Return transaction id, unit id and PDU of the next answer."""
        head = await self.reader.readexactly(7)
        transaction, protocol, length, unit = struct.unpack(">HHHB", head)
        assert protocol == 0
        return transaction, unit, await self.reader.readexactly(length - 1)

    async def ask(self, pdu: bytes, transaction: int = 1, unit: int = 1) -> bytes:
        self.send(frame(pdu, transaction, unit))
        answer = await self.answer()
        assert answer[:2] == (transaction, unit)
        return answer[2]

    async def closed(self) -> bytes:
        """Wait until the server closes the connection; return what came before."""
        received = b""
        with contextlib.suppress(ConnectionResetError, ssl.SSLError):
            while data := await self.reader.read(65536):
                received += data
        return received


@dataclass
class Running:
    """A server that is listening, what is behind it, and the names of the blocks that were written."""

    server: ModbusServer
    bank: RegisterBank
    written: list[str] = field(default_factory=list)
    writers: list[asyncio.StreamWriter] = field(default_factory=list)

    tls: ssl.SSLContext | None = None

    async def connect(self, source: str = "127.0.0.1", tls: ssl.SSLContext | None = None) -> Wire:
        reader, writer = await asyncio.open_connection(
            "127.0.0.1", self.server.port, local_addr=(source, 0), ssl=tls or self.tls
        )
        self.writers.append(writer)
        return Wire(reader, writer)


Serve = Callable[..., AbstractAsyncContextManager[Running]]


@contextlib.asynccontextmanager
async def served(
    register_map: RegisterMap = PLANT_MAP,
    *,
    order: WordOrder = WordOrder.HIGH_FIRST,
    on_write: OnWrite | None = None,
    identity: DeviceIdentity | None = None,
    client: ssl.SSLContext | None = None,
    on_departure: Callable[[Role], None] | None = None,
    on_refusal: Callable[[str], None] | None = None,
    **settings: Any,  # noqa: ANN401 - any field of ServerSettings
) -> AsyncIterator[Running]:
    bank = RegisterBank(register_map, order)
    bank.put(Identity(map_digest=register_map.digest, map_version=register_map.version))
    written: list[str] = []

    def note(block: Block, _caller: Caller) -> None:
        written.append(block.name)

    server = ModbusServer(
        bank,
        settings=ServerSettings(**{"port": 0, **settings}),
        on_write=on_write or note,
        identity=identity or DeviceIdentity(product=register_map.service, revision="0.1"),
        on_departure=on_departure,
        on_refusal=on_refusal,
    )
    running = Running(server, bank, written, tls=client)
    await server.start()
    try:
        yield running
    finally:
        for writer in running.writers:
            writer.close()
        await server.close()


@pytest.fixture
def serve() -> Serve:
    return served


class FakeTransport(asyncio.Transport):
    """Keeps what is written."""

    def __init__(self) -> None:
        super().__init__({"peername": ("127.0.0.1", 1)})
        self.written = b""
        self.closed = False

    def write(self, data: Any) -> None:  # noqa: ANN401 - asyncio's signature
        self.written += data

    def close(self) -> None:
        self.closed = True

    abort = close

    def is_closing(self) -> bool:
        return self.closed

    def pause_reading(self) -> None:
        """Nothing is read here."""

    resume_reading = pause_reading


def plugged(
    bank: RegisterBank,
    refusals: RefusalLog,
    turns: Turns | None = None,
    on_write: OnWrite = lambda _block, _caller: None,
    **settings: Any,  # noqa: ANN401 - any field of ServerSettings
) -> tuple[Connection, FakeTransport]:
    """Return a connection of which a test is the wire."""
    identity = DeviceIdentity(product="rig", revision="0.1")
    connection = Connection(
        handler_for=lambda caller: RequestHandler(bank, identity, caller),
        settings=ServerSettings.model_validate({"port": 0, **settings}),
        on_write=on_write,
        refusals=refusals,
        turns=turns or Turns(),
        opened=lambda _connection: True,
        lost=lambda _connection: None,
    )
    transport = FakeTransport()
    connection.connection_made(transport)
    return connection, transport


Plug = Callable[..., tuple[Connection, FakeTransport]]


@pytest.fixture(scope="session")
def plug() -> Plug:
    return plugged


class Pki:
    """Certificates of a site, as files."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.authority = Authority.new("site", 1)
        self.keep("ca", self.authority.pair)
        self.server = self.keep("server", self.authority.issue_server("server", ["127.0.0.1", "localhost"]))

    def keep(self, name: str, pair: Pair) -> TlsSettings:
        certificate, key = self.folder / f"{name}.crt", self.folder / f"{name}.key"
        certificate.write_bytes(pair.certificate_pem)
        key.write_bytes(pair.key_pem)
        key.chmod(0o600)
        return TlsSettings(certificate=certificate, key=key, ca=self.folder / "ca.crt", warn_days=0)

    def client(self, role: str | None) -> ssl.SSLContext:
        name = f"client-{role}"[:20]
        return tls_context(self.keep(name, self.authority.issue_client(name, role)), name)


@pytest.fixture(scope="session")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Pki:
    return Pki(tmp_path_factory.mktemp("pki"))


def written_by_the_operator(register_map: RegisterMap) -> RegisterMap:
    """Return a map of which one certificate may write everything."""
    blocks = [replace(block, writer=Role.OPERATOR) if block.writer else block for block in register_map.blocks]
    return replace(register_map, blocks=tuple(blocks))


@pytest.fixture(params=["tcp", "tls"])
def serve_either(request: pytest.FixtureRequest, pki: Pki) -> Serve:
    """Serve over plain TCP, and over TLS to a client who may write everything."""
    if request.param == "tcp":
        return served
    return partial(served, written_by_the_operator(PLANT_MAP), tls=pki.server, client=pki.client("operator"))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine, in a loop of its own and within `PATIENCE_S`; any traceback logged fails it."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    arguments = {name: pyfuncitem.funcargs[name] for name in names}
    complaints: list[dict[str, Any]] = []

    async def story() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
        async with asyncio.timeout(PATIENCE_S):
            await pyfuncitem.obj(**arguments)

    asyncio.run(story())
    assert not complaints
    return True
