"""Function 43 / 14: who a server says it is."""

from typing import TYPE_CHECKING

import pytest
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.pdu.mei_message import ReadDeviceInformationResponse

from coldloop.modbus.server import DeviceIdentity
from tests.harness.records import CONTROL_MAP

if TYPE_CHECKING:
    from tests.modbus.conftest import Serve

PLANT = DeviceIdentity(product="plant", revision="0.1")
WITH_URL = DeviceIdentity(product="plant", revision="0.1", url="here")
BASIC_OBJECTS = b"\x00\x08Coldloop\x01\x05plant\x02\x030.1"

ANSWERS = {
    "basic": (PLANT, "2b 0e 01 00", bytes.fromhex("2b 0e 01 81 00 00 03") + BASIC_OBJECTS),
    "basic from object 2": (PLANT, "2b 0e 01 02", bytes.fromhex("2b 0e 01 81 00 00 01 02 03") + b"0.1"),
    "basic from an object out of it": (WITH_URL, "2b 0e 01 03", bytes.fromhex("2b 0e 01 82 00 00 03") + BASIC_OBJECTS),
    "regular": (WITH_URL, "2b 0e 02 00", bytes.fromhex("2b 0e 02 82 00 00 04") + BASIC_OBJECTS + b"\x03\x04here"),
    "regular of a server that is basic": (PLANT, "2b 0e 02 00", bytes.fromhex("2b 0e 02 81 00 00 03") + BASIC_OBJECTS),
    "extended": (WITH_URL, "2b 0e 03 00", bytes.fromhex("2b 0e 03 82 00 00 04") + BASIC_OBJECTS + b"\x03\x04here"),
    "one object": (PLANT, "2b 0e 04 01", bytes.fromhex("2b 0e 04 81 00 00 01 01 05") + b"plant"),
    "one object that does not exist": (PLANT, "2b 0e 04 03", b"\xab\x02"),
    "one object of the private range": (WITH_URL, "2b 0e 04 80", b"\xab\x02"),
    "read code 0": (PLANT, "2b 0e 00 00", b"\xab\x03"),
    "read code 5": (PLANT, "2b 0e 05 00", b"\xab\x03"),
    "truncated": (PLANT, "2b 0e 01", b"\xab\x03"),
    "a function code only": (PLANT, "2b", b"\xab\x03"),
    "a byte too many": (PLANT, "2b 0e 01 00 00", b"\xab\x03"),
    "CANopen": (PLANT, "2b 0d 01 00", b"\xab\x01"),
}


@pytest.mark.parametrize(("identity", "request_hex", "answer"), ANSWERS.values(), ids=ANSWERS.keys())
async def test_an_identification_request_is_answered(
    serve: "Serve", identity: DeviceIdentity, request_hex: str, answer: bytes
) -> None:
    async with serve(identity=identity) as running:
        wire = await running.connect()
        assert await wire.ask(bytes.fromhex(request_hex)) == answer


async def test_objects_that_do_not_fit_follow_in_a_second_answer(serve: "Serve") -> None:
    identity = DeviceIdentity(product="p" * 120, revision="r" * 120, url="u" * 240)
    async with serve(identity=identity) as running:
        wire = await running.connect()
        objects: dict[int, bytes] = {}
        ask_from, answers = 0, 0
        while True:
            answer = await wire.ask(bytes((0x2B, 0x0E, 0x02, ask_from)))
            answers += 1
            assert len(answer) <= 253
            more_follows, ask_from, count = answer[4:7]
            rest = answer[7:]
            for _ in range(count):
                number, length = rest[:2]
                objects[number], rest = rest[2 : 2 + length], rest[2 + length :]
            assert rest == b""
            if not more_follows:
                break
            assert more_follows == 0xFF
        assert objects == identity.objects()
        assert answers == 3


async def test_two_servers_of_one_process_have_two_identities(serve: "Serve") -> None:
    async with serve() as plant, serve(CONTROL_MAP) as control:
        for running, product in ((plant, b"plant"), (control, b"control_plc")):
            wire = await running.connect()
            assert (await wire.ask(b"\x2b\x0e\x04\x01"))[9:] == product


async def test_pymodbus_reads_the_identity(serve: "Serve") -> None:
    async with serve(identity=WITH_URL) as running:
        client = AsyncModbusTcpClient("127.0.0.1", port=running.server.port)
        await client.connect()
        response = await client.read_device_information(read_code=2)
        client.close()
        assert isinstance(response, ReadDeviceInformationResponse)
        assert response.information == {0: b"Coldloop", 1: b"plant", 2: b"0.1", 3: b"here"}
