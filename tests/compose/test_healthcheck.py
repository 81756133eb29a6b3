"""What the containers' health check says of servers, right and wrong; needs no container."""

import asyncio
import json
import runpy
import socket
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.modbus.settings import ServerSettings, TlsSettings
from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import Identity, ServiceState
from coldloop.registers.control_plc import ControlSession
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.plant import PlantSession
from coldloop_rig.cli.certificates import Authority
from tests.harness.process_files import made
from tests.harness.processes import END_S, Processes
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP
from tests.process.runs import started

PROGRAM = Path(__file__).parents[2] / "docker" / "healthcheck.py"
MAPS = {"plant": PLANT_MAP, "control_plc": CONTROL_MAP, "optimizer_plc": OPTIMIZER_MAP}
RUNNING, READY = ServiceState.RUNNING, ServiceState.READY


class Checked(NamedTuple):
    """What the health check says."""

    code: int
    complaint: str


Check = Callable[[int, Mapping[str, str], str], Checked]


@pytest.fixture
def check(processes: Processes) -> Check:
    def checked(port: int, environment: Mapping[str, str], service: str) -> Checked:
        own = {"SERVICE": service, f"COLDLOOP__{service.upper()}__SERVER__PORT": str(port)}
        done = processes.python("-I", "-S", str(PROGRAM), more={**own, **environment})
        return Checked(done.popen.wait(END_S), done.said)

    return checked


class Service:
    """A server of a service, whose scans a test decides on."""

    def __init__(self, check: Check, register_map: RegisterMap, order: WordOrder, tls: TlsSettings | None) -> None:
        self._check = check
        self.map = register_map
        self.bank = RegisterBank(register_map, order)
        self.server = ModbusServer(
            self.bank,
            settings=ServerSettings(port=0, tls=tls),
            on_write=lambda *_: None,
            identity=DeviceIdentity(product="test", revision="0"),
        )

    def show(self, tick: int, state: ServiceState = RUNNING, session: int = 70_000) -> None:
        self.bank.put(Identity(map_digest=self.map.digest, state=state, session=session, tick=tick))

    async def scan(self) -> None:
        """Go from tick to tick until cancelled."""
        for tick in range(0xFFF0, 0x1FFFF):
            self.show(tick)
            await asyncio.sleep(0.01)

    async def check(self, environment: Mapping[str, str] | None = None) -> Checked:
        how = {"COLDLOOP__SESSION__MODE": "realtime", **(environment or {})}
        return await asyncio.to_thread(self._check, self.server.port, how, self.map.service)


Show = Callable[..., AbstractAsyncContextManager[Service]]


@pytest.fixture
def standing(check: Check) -> Show:
    """Serve a service that stands at tick 7."""

    @asynccontextmanager
    async def served(
        service: str = "control_plc", order: WordOrder = WordOrder.HIGH_FIRST, tls: TlsSettings | None = None
    ) -> AsyncIterator[Service]:
        one = Service(check, MAPS[service], order, tls)
        one.show(7)
        await one.server.start()
        try:
            yield one
        finally:
            await one.server.close()

    return served


@pytest.fixture
def scanning(standing: Show) -> Show:
    """Serve a service that goes from tick to tick."""

    @asynccontextmanager
    async def served(*which: Any, **how: Any) -> AsyncIterator[Service]:  # noqa: ANN401 - those of `standing`
        async with standing(*which, **how) as one:
            task = asyncio.create_task(one.scan())
            try:
                yield one
            finally:
                task.cancel()

    return served


@pytest.mark.parametrize("order", WordOrder)
@pytest.mark.parametrize("service", ["plant", "control_plc"])
async def test_a_service_that_goes_from_tick_to_tick_is_healthy(service: str, order: WordOrder, scanning: Show) -> None:
    async with scanning(service, order) as one:
        done = await one.check()
    assert done.code == 0, done.complaint


@pytest.mark.parametrize("service", ["plant", "control_plc"])
async def test_one_that_stands_is_not_though_it_answers(service: str, standing: Show) -> None:
    async with standing(service) as one:
        done = await one.check()
    assert done.code == 1
    assert f"{service} on port" in done.complaint
    assert "stays at tick 7" in done.complaint


async def test_ticks_may_be_as_long_as_the_process_has_them(standing: Show) -> None:
    async with standing() as one:

        async def scan_now_and_then() -> None:
            for tick in range(8, 100):
                await asyncio.sleep(6.0)
                one.show(tick)

        task = asyncio.create_task(scan_now_and_then())
        assert (await one.check({"HEALTHCHECK_TICK_PATIENCE_S": "60"})).complaint == ""
        task.cancel()
        assert "stays at tick" in (await one.check()).complaint


async def test_in_lock_step_a_service_may_stand_whatever_its_configuration_says(standing: Show) -> None:
    async with standing() as one:
        one.bank.put(ControlSession(70_000, 0, 1.0))
        assert (await one.check()).code == 0
        one.bank.put(ControlSession(70_000, 1, 1.0))
        assert (await one.check({"COLDLOOP__SESSION__MODE": "lockstep"})).code == 1


@pytest.mark.parametrize("state", ServiceState)
async def test_an_optimiser_may_have_nothing_to_do(state: ServiceState, standing: Show) -> None:
    async with standing("optimizer_plc") as one:
        one.show(7, state)
        assert (await one.check()).code == 0


@pytest.mark.parametrize("service", ["plant", "control_plc"])
async def test_without_a_session_nothing_is_scanned(service: str, standing: Show) -> None:
    async with standing(service) as one:
        one.show(0, READY, session=0)
        done = await one.check()
    assert done.code == 1
    assert "runs no session" in done.complaint


async def test_it_speaks_tls_and_trusts_no_other_server(tmp_path: Path, scanning: Show) -> None:
    def kept(folder: str) -> tuple[TlsSettings, dict[str, str]]:
        authority = Authority.new("site", 1)
        pairs = {
            "ca": authority.pair,
            "server": authority.issue_server("server", ["127.0.0.1"]),
            "reader": authority.issue_client("reader", None),
        }
        (tmp_path / folder).mkdir()
        for name, pair in pairs.items():
            (tmp_path / folder / f"{name}.crt").write_bytes(pair.certificate_pem)
            (tmp_path / folder / f"{name}.key").write_bytes(pair.key_pem)
        paths = {name: tmp_path / folder / name for name in ("server.crt", "server.key", "ca.crt")}
        tls = TlsSettings(certificate=paths["server.crt"], key=paths["server.key"], ca=paths["ca.crt"])
        kinds = {"CERTIFICATE": "reader.crt", "KEY": "reader.key", "CA": "ca.crt"}
        return tls, {f"HEALTHCHECK_TLS_{kind}": str(tmp_path / folder / name) for kind, name in kinds.items()}

    (tls, ours), (_, others) = kept("ours"), kept("others")
    async with scanning(tls=tls) as one:
        assert (await one.check(ours)).complaint == ""
        assert "certificate verify failed" in (await one.check(others)).complaint
        assert (await one.check()).code == 1


def test_a_port_on_which_nobody_listens_is_not_healthy(free_port: int, check: Check) -> None:
    done = check(free_port, {}, "control_plc")
    assert done.code == 1
    assert "control_plc on port" in done.complaint


def test_nor_is_a_server_of_something_else(check: Check) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with server.accept()[0] as connection:
                connection.recv(100)
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        done = check(server.getsockname()[1], {}, "control_plc")
        thread.join()
    assert done.code == 1
    assert "not a register map of ours" in done.complaint


def test_the_addresses_it_reads_are_those_of_the_register_maps(processes: Processes, tmp_path: Path) -> None:
    """Those of the largest process too, whose longer blocks leave these where they are."""
    known = runpy.run_path(str(PROGRAM))
    starters = {"plant": PlantSession, "control_plc": ControlSession}
    addresses = {
        service: block.address
        for service, starter in starters.items()
        for block in MAPS[service].blocks
        if block.record is starter
    }
    assert known["SESSIONS"] == addresses
    wide = made(tmp_path, inputs=1, outputs=32, states=20, tick_s=60.0, load=True)
    code, listing, complaints = started(processes, "--process", wide, "registers", "--format", "json")
    assert code == 0, complaints
    starts = {(row["service"], row["block"]): row["address"] for row in json.loads(listing)[::-1]}
    assert {service: starts[service, "session"] for service in addresses} == addresses
    for register_map in MAPS.values():
        (identity,) = [block for block in register_map.blocks if block.record is Identity]
        assert identity.address == 0
