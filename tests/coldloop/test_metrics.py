"""Registers for Prometheus: what the text says, and who is answered."""

import asyncio
import contextlib
import math
import shutil
import subprocess

import pytest

from coldloop.errors import PortInUseError
from coldloop.registers.bank import RegisterBank
from coldloop.registers.plant import Actuators, Measurement
from coldloop.service.monitoring import MOST_OPEN, MetricsServer, bank_families, exposition, gauge
from coldloop.service.settings import MetricsSettings
from tests.harness.records import PLANT_MAP


def bank() -> RegisterBank:
    one = RegisterBank(PLANT_MAP)
    one.put(Measurement(7, 400.0, tuple(float(i) for i in range(22)), (0.0,) * 28, 1, (0.0,) * 3))
    one.put(Actuators(7, (43.0, 75.0, 36.0), 1))
    return one


def test_each_number_is_a_gauge_with_its_description_and_unit() -> None:
    lines = exposition(bank_families(bank())).decode().splitlines()
    assert 'coldloop_plant_measurement_y{element="T5"} 6.0' in lines
    assert "# TYPE coldloop_plant_measurement_load gauge" in lines
    assert "# HELP coldloop_plant_measurement_load Heat load NCR22_HL, which is known (W)" in lines
    assert "coldloop_plant_measurement_load 400.0" in lines
    assert not [line for line in lines if "actuators" in line], "what a client writes is no state of the service"
    assert not [line for line in lines if "_who" in line], "texts are no numbers"


def test_what_is_not_finite_and_what_has_quotes_is_written_as_the_format_asks() -> None:
    values = {"no": math.nan, "up": math.inf, "down": -math.inf, 'say "x"\n\\': 1.0}
    lines = exposition([gauge("one", "two\nlines", values, label="a")]).decode().splitlines()
    assert lines[0] == r"# HELP one two\nlines"
    assert lines[2:5] == ['one{a="no"} NaN', 'one{a="up"} +Inf', 'one{a="down"} -Inf']
    assert lines[5] == 'one{a="say \\"x\\"\\n\\\\"} 1.0'


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool of Debian's prometheus is not there")
def test_promtool_finds_nothing_wrong() -> None:
    text = exposition(bank_families(bank())).decode()
    done = subprocess.run(["promtool", "check", "metrics"], input=text, text=True, capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


async def asked(port: int, request: bytes) -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(request)
    answer = await reader.read()
    writer.close()
    return answer.decode()


async def test_the_server_answers_two_paths_and_survives_what_is_no_request(free_port: int) -> None:
    server = asyncio.create_task(MetricsServer(MetricsSettings(port=free_port), bank()).run())
    try:
        while True:
            try:
                answer = await asked(free_port, b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
                break
            except ConnectionError:
                await asyncio.sleep(0)
        assert answer.startswith("HTTP/1.1 200 OK\r\n")
        assert "coldloop_plant_measurement_load 400.0" in answer
        assert "live" in await asked(free_port, b"GET /healthz?x HTTP/1.0\r\n\r\n")
        assert "404" in await asked(free_port, b"GET / HTTP/1.0\r\n\r\n")
        assert "405" in await asked(free_port, b"POST /metrics HTTP/1.0\r\n\r\n")
        assert await asked(free_port, b"x" * 10_000) == ""
        assert "405" in await asked(free_port, b"\r\n\r\n")
        with pytest.raises(PortInUseError, match=r"metrics\.port"):
            await MetricsServer(MetricsSettings(port=free_port), bank()).run()
    finally:
        server.cancel()
        await asyncio.gather(server, return_exceptions=True)


@pytest.mark.parametrize("text", [b"", b"GET /metr", b"GET /metrics HTTP/1.1\r\n\r\n"])
async def test_whoever_holds_connections_gives_way_to_who_asks(free_port: int, text: bytes) -> None:
    server = asyncio.create_task(MetricsServer(MetricsSettings(port=free_port), bank()).run())
    held: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = []
    try:
        while len(held) < 5 * MOST_OPEN:
            try:
                held.append(await asyncio.open_connection("127.0.0.1", free_port, limit=1))  # reads next to nothing
            except ConnectionError:
                await asyncio.sleep(0)
            else:
                held[-1][1].write(text)
        assert "200 OK" in await asked(free_port, b"GET /healthz HTTP/1.1\r\n\r\n")
        ended = [asyncio.create_task(ends(reader)) for reader, _ in held[: 4 * MOST_OPEN]]
        async with asyncio.timeout(60):
            await asyncio.gather(*ended)
    finally:
        for _, writer in held:
            writer.transport.abort()
        server.cancel()
        await asyncio.gather(server, return_exceptions=True)


async def ends(reader: asyncio.StreamReader) -> None:
    """Read until the server has closed the connection."""
    with contextlib.suppress(ConnectionError):
        while await reader.read(1000):
            pass


async def test_without_a_port_it_is_off() -> None:
    await MetricsServer(MetricsSettings(), bank()).run()
