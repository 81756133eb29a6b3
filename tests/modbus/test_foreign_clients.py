"""Clients that we did not write read the magic float and the temperature T5."""

import asyncio
import shutil
import subprocess
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import OUTPUT_NAMES, T5
from coldloop.registers.common import Identity
from coldloop.registers.plant import Measurement
from tests.conftest import install
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from coldloop.registers.declaration import Register
    from tests.modbus.conftest import Running, Serve

pytestmark = pytest.mark.usefixtures("programs")


KELVIN = 20.25
MEASURED = Measurement(
    tick=3,
    load=0.0,
    y=tuple(KELVIN if position == T5 else 1.0 for position in range(len(OUTPUT_NAMES))),
    x=(0.0,) * 28,
    session=1,
    u=(0.0,) * 3,
)

LIBMODBUS_PROGRAM = r"""
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>

int main(int count, char **arguments)
{
    modbus_t *bus = modbus_new_tcp("127.0.0.1", atoi(arguments[1]));
    if (bus == NULL || modbus_set_response_timeout(bus, 60, 0) != 0 || modbus_connect(bus) != 0) {
        fprintf(stderr, "connect: %s\n", modbus_strerror(errno));
        return 1;
    }
    for (int i = 2; i < count; i++) {
        uint16_t words[2];
        if (modbus_read_registers(bus, atoi(arguments[i]), 2, words) != 2) {
            fprintf(stderr, "read: %s\n", modbus_strerror(errno));
            return 1;
        }
        printf("%.3f\n", modbus_get_float_abcd(words));
    }
    modbus_close(bus);
    modbus_free(bus);
    return 0;
}
"""

MODBUS_SERIAL_PROGRAM = """
const ModbusRTU = require("modbus-serial");
const [port, ...addresses] = process.argv.slice(2).map(Number);
async function main() {
  const client = new ModbusRTU();
  await client.connectTCP("127.0.0.1", { port });
  client.setID(1);
  client.setTimeout(60000);
  for (const address of addresses) {
    const { buffer } = await client.readHoldingRegisters(address, 2);
    console.log(buffer.readFloatBE(0).toFixed(3));
  }
  await new Promise((done) => client.close(done));
}
main().catch((error) => { console.error(error.message); process.exit(1); });
"""


def address_of(block: str, name: str) -> str:
    """Return the 0-based address of a register of the plant."""
    registers: list[Register] = [register for each in PLANT_MAP.blocks for register in each.registers()]
    (address,) = [register.address for register in registers if (register.block, register.name) == (block, name)]
    return str(address)


ADDRESSES = [address_of("identity", "magic"), address_of("measurement", "y.T5")]


@pytest.fixture(scope="session")
def libmodbus_program(tmp_path_factory: pytest.TempPathFactory) -> str:
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    if not Path("/usr/include/modbus/modbus.h").exists():
        install("libmodbus-dev")
    place = tmp_path_factory.mktemp("libmodbus")
    (place / "read.c").write_text(LIBMODBUS_PROGRAM)
    command = ["gcc", "-Wall", "-Werror", "-I/usr/include/modbus", "-o", "read", "read.c", "-lmodbus"]
    subprocess.run(command, cwd=place, check=True)
    return str(place / "read")


@pytest.fixture(scope="session")
def modbus_serial_program(tmp_path_factory: pytest.TempPathFactory) -> str:
    if shutil.which("npm") is None:
        pytest.skip("needs node and npm")
    place = tmp_path_factory.mktemp("modbus-serial")
    command = ["npm", "install", "--no-save", "--no-audit", "--no-fund", "--omit=optional", "modbus-serial@8"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode != 0:
        pytest.skip(f"`{' '.join(command)}` failed: {done.stderr.strip().splitlines()[:1]}")
    (place / "read.js").write_text(textwrap.dedent(MODBUS_SERIAL_PROGRAM))
    return str(place / "read.js")


async def output_of(*command: str) -> str:
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    output, errors = await process.communicate()
    assert process.returncode == 0, (output + errors).decode()
    return output.decode()


def measuring(running: "Running") -> str:
    """Let the server hold a measurement; return its port."""
    assert running.bank.get(Identity).map_digest == PLANT_MAP.digest
    running.bank.put(MEASURED)
    return str(running.server.port)


async def test_mbpoll_reads_holding_and_input_registers(serve: "Serve", mbpoll: str) -> None:
    async with serve() as running:
        port = measuring(running)
        for table in ("4:float", "3:float"):
            for address, value in zip(ADDRESSES, ("123.456", "20.25"), strict=True):
                where = ["-p", port, "-a", "1", "-0", "-r", address, "-c", "1", "-B", "-t", table]
                shown = await output_of(mbpoll, "-o", "10", "-m", "tcp", *where, "-1", "127.0.0.1")
                assert f"[{address}]: \t{value}" in shown


async def test_mbpoll_counts_from_one_unless_told_otherwise(serve: "Serve", mbpoll: str) -> None:
    async with serve() as running:
        port = measuring(running)
        where = ["-p", port, "-a", "1", "-r", "1", "-c", "1", "-B", "-t", "4:float"]
        shown = await output_of(mbpoll, "-o", "10", "-m", "tcp", *where, "-1", "127.0.0.1")
        assert "[1]: \t123.456" in shown


async def test_libmodbus(serve: "Serve", libmodbus_program: str) -> None:
    async with serve() as running:
        shown = await output_of(libmodbus_program, measuring(running), *ADDRESSES)
        assert shown.split() == ["123.456", "20.250"]


async def test_modbus_serial(serve: "Serve", modbus_serial_program: str) -> None:
    async with serve() as running:
        shown = await output_of("node", modbus_serial_program, measuring(running), *ADDRESSES)
        assert shown.split() == ["123.456", "20.250"]
