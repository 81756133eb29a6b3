"""Ports that are kept for services which start later, end and start again."""

import asyncio
import socket
import sys

import pytest
import uvloop

from coldloop.service.settings import TelemetrySettings
from coldloop_rig.cosim.wiring import HOST, ReservedPorts, endpoints_on, wired
from coldloop_rig.live.started_rigs import DEFAULT_PORTS
from coldloop_rig.settings import Settings
from tests.harness.processes import Processes

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="two sockets share a port in this way on Linux alone")


def test_connections_are_refused_until_a_server_listens_and_after_it_has_ended() -> None:
    with ReservedPorts(1) as reserved:
        (port,) = reserved.numbers
        for _ in range(2):
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((HOST, port)).close()
            with socket.create_server((HOST, port)):
                socket.create_connection((HOST, port)).close()


@pytest.mark.parametrize("new_loop", [asyncio.new_event_loop, uvloop.new_event_loop])
def test_the_server_of_an_event_loop_may_listen_there(new_loop: type[asyncio.AbstractEventLoop]) -> None:
    async def serve(port: int) -> None:
        server = await asyncio.get_running_loop().create_server(asyncio.Protocol, HOST, port)
        _, writer = await asyncio.open_connection(HOST, port)
        writer.close()
        server.close()
        await server.wait_closed()

    with ReservedPorts(1) as reserved, asyncio.Runner(loop_factory=new_loop) as runner:
        runner.run(serve(reserved.numbers[0]))


def test_nobody_else_gets_them() -> None:
    with ReservedPorts(50) as reserved, ReservedPorts(400) as others:
        assert len({*reserved.numbers, *others.numbers}) == 450


def test_ports_in_a_row_are_refused_where_one_is_taken() -> None:
    with ReservedPorts(1) as taken:
        (port,) = taken.numbers
        with pytest.raises(OSError, match="in use"):
            ReservedPorts(2, port - 1)


def test_ports_in_a_row_are_reserved_where_none_is_taken(processes: Processes) -> None:
    first = processes.three_ports()
    for port in range(first, first + 3):
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((HOST, port)).close()
        with pytest.raises(OSError, match="in use"):
            ReservedPorts(1, port)


def test_a_rig_at_other_ports_publishes_under_topics_of_its_own() -> None:
    """Else the end of one rig would be read as that of the other."""
    usual, other = (endpoints_on(ports, Settings()) for ports in (DEFAULT_PORTS, (6000, 6001, 6002)))
    assert wired(Settings(), usual).telemetry.prefix == "coldloop"
    assert wired(Settings(), other).telemetry.prefix == "coldloop/6000"
    mine = Settings(telemetry=TelemetrySettings(prefix="site"))
    assert wired(mine, other).telemetry.prefix == "site"
