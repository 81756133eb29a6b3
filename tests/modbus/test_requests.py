"""Every function code at byte level: what is answered, what is refused and with which exception."""

import struct
from typing import TYPE_CHECKING

import pytest

from coldloop.registers.plant import Actuators, PlantSession
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from tests.modbus.conftest import Serve

ACTUATORS = Actuators(tick=7, u=(50.0, 100.0, 60.0), session=1)
LAST, BEYOND = f"{PLANT_MAP.end - 1:04x}", f"{PLANT_MAP.end:04x}"
"""Address of the last register of the map, and of the one behind it."""
SESSION = PlantSession(session=1, realtime=0, factor=1.0, seed=2, load_steps=3)


def floats(*values: float) -> str:
    return struct.pack(f">{len(values)}f", *values).hex()


TABLE_OF_THE_SPECIFICATION = {
    "FC3 with count 0": ("03 0000 0000", "83 03"),
    "FC3 with count 126": ("03 0000 007e", "83 03"),
    "FC1 with 2001 coils": ("01 0000 07d1", "81 03"),
    "unknown function 0x41": ("41", "c1 01"),
    "unknown function 0x55": ("55 0102", "d5 01"),
    "FC3 truncated": ("03 0000 00", "83 03"),
    "FC16 truncated": ("10 0064 0002 04 00", "90 03"),
    "FC23 truncated": ("17 0000 0001 0064 0002", "97 03"),
    "FC5 with value 0x1234": ("05 0000 1234", "85 03"),
    "FC16 with a wrong byte count": ("10 0064 0002 03 00000000", "90 03"),
    "FC23 whose read half is illegal": (f"17 {BEYOND} 0001 0064 0002 04 00000009", "97 02"),
}

READS = {
    "FC3 with count 65535": ("03 0000 ffff", "83 03"),
    "FC3 of nothing but a function code": ("03", "83 03"),
    "FC3 with a byte too many": ("03 0000 0001 00", "83 03"),
    "FC3 across the end of the map": (f"03 {LAST} 0002", "83 02"),
    "FC3 beyond the end of the map": (f"03 {BEYOND} 0001", "83 02"),
    "FC3 across the end of the address space": ("03 ffff 0002", "83 02"),
    "FC4 with count 0": ("04 0000 0000", "84 03"),
    "FC4 with count 126": ("04 0000 007e", "84 03"),
    "FC4 truncated": ("04 0000", "84 03"),
    "FC4 beyond the end of the map": (f"04 {BEYOND} 0001", "84 02"),
    "FC1 with 0 coils": ("01 0000 0000", "81 03"),
    "FC1 with 2000 coils": ("01 0000 07d0", "81 02"),
    "FC1 truncated": ("01 0000 00", "81 03"),
    "FC2 with 0 inputs": ("02 0000 0000", "82 03"),
    "FC2 with 2001 inputs": ("02 0000 07d1", "82 03"),
    "FC2 with 2000 inputs": ("02 0000 07d0", "82 02"),
    "function 0": ("00", "80 01"),
    "function 7": ("07", "87 01"),
    "function 8": ("08 0000 1234", "88 01"),
    "function 17": ("11", "91 01"),
    "function 24": ("18 0000", "98 01"),
    "a function that is an exception": ("83 02", "83 01"),
}

WRITES = {
    "FC5 switching on": ("05 0000 ff00", "85 02"),
    "FC5 switching off": ("05 0000 0000", "85 02"),
    "FC5 truncated": ("05 0000 ff", "85 03"),
    "FC15 to a coil": ("0f 0000 0009 02 ffff", "8f 02"),
    "FC15 with 0 coils": ("0f 0000 0000 00", "8f 03"),
    "FC15 with 1969 coils": ("0f 0000 07b1 f7" + "00" * 247, "8f 03"),
    "FC15 with a wrong byte count": ("0f 0000 0009 01 ff", "8f 03"),
    "FC15 truncated": ("0f 0000 0009 02 ff", "8f 03"),
    "FC6 of the first half of a float": ("06 0066 0000", "86 03"),
    "FC6 of the second half of a float": ("06 0067 0000", "86 03"),
    "FC6 of half a uint32": ("06 0064 0000", "86 03"),
    "FC6 out of range": ("06 0192 0002", "86 03"),
    "FC6 of an undeclared register": ("06 0032 0001", "86 02"),
    "FC6 of a read-only register": ("06 0005 0001", "86 02"),
    "FC6 truncated": ("06 0192 00", "86 03"),
    "FC16 with 0 registers": ("10 0064 0000 00", "90 03"),
    "FC16 with 124 registers": ("10 03e8 007c f8" + "00" * 246, "90 03"),
    "FC16 with data missing": ("10 0064 0002 04 0000", "90 03"),
    "FC16 with data too many": ("10 0064 0002 04 000000000000", "90 03"),
    "FC16 of read-only registers": ("10 00c8 0002 04 00000000", "90 02"),
    "FC16 across the end of a block": ("10 0072 0004 08" + "00000000" + floats(1), "90 02"),
    "FC16 to a gap between blocks": ("10 0032 0001 02 0000", "90 02"),
    "FC16 across the end of the address space": ("10 ffff 0002 04 00000000", "90 02"),
    "FC16 that begins with half a float": ("10 0067 0003 06 0000" + floats(1), "90 03"),
    "FC16 that ends with half a float": ("10 0066 0003 06" + floats(1) + "0000", "90 03"),
    "FC16 above the range": ("10 0066 0002 04" + floats(100.5), "90 03"),
    "FC16 below the range": ("10 0066 0002 04" + floats(-0.5), "90 03"),
    "FC16 whose last value is out of range": ("10 0066 0006 0c" + floats(1, 2, 101), "90 03"),
    "FC16 of not-a-number": ("10 0066 0002 04" + floats(float("nan")), "90 03"),
    "FC16 of infinity": ("10 0066 0002 04" + floats(float("inf")), "90 03"),
    "FC22 of half a float": ("16 0066 ffff 0000", "96 03"),
    "FC22 out of range": ("16 0192 0000 0002", "96 03"),
    "FC22 of an undeclared register": ("16 0032 ffff 0000", "96 02"),
    "FC22 of a read-only register": ("16 0005 ffff 0001", "96 02"),
    "FC22 truncated": ("16 0192 ffff 00", "96 03"),
}

WRITES_WITH_READS = {
    "FC23 that reads 0": ("17 0000 0000 0064 0002 04 00000009", "97 03"),
    "FC23 that reads 126": ("17 0000 007e 0064 0002 04 00000009", "97 03"),
    "FC23 that writes 0": ("17 0000 0001 0064 0000 00", "97 03"),
    "FC23 that writes 122": ("17 0000 0001 03e8 007a f4" + "00" * 242, "97 03"),
    "FC23 with a wrong byte count": ("17 0000 0001 0064 0002 02 00000009", "97 03"),
    "FC23 with data missing": ("17 0000 0001 0064 0002 04 0000", "97 03"),
    "FC23 whose write half is read-only": ("17 0000 0001 00c8 0002 04 00000009", "97 02"),
    "FC23 whose write half is undeclared": ("17 0000 0001 0032 0002 04 00000009", "97 02"),
    "FC23 whose value is out of range": ("17 0000 0001 0066 0002 04" + floats(101), "97 03"),
    "FC23 that writes half a float": ("17 0000 0001 0066 0001 02 0000", "97 03"),
    "FC23 with an illegal quantity and an illegal address": (f"17 {BEYOND} 0000 0064 0002 04 00000009", "97 03"),
    "FC23 with an illegal read address and an illegal value": (f"17 {BEYOND} 0001 0066 0002 04" + floats(101), "97 02"),
    "FC23 with an illegal write address and an illegal value": ("17 0000 0001 00c8 0002 04" + floats(101), "97 02"),
}

REFUSED = TABLE_OF_THE_SPECIFICATION | READS | WRITES | WRITES_WITH_READS


@pytest.mark.parametrize(("request_hex", "answer_hex"), REFUSED.values(), ids=REFUSED.keys())
async def test_a_refused_request_gets_its_exception_and_stores_nothing(
    serve: "Serve", request_hex: str, answer_hex: str
) -> None:
    async with serve() as running:
        running.bank.put(ACTUATORS)
        running.bank.put(SESSION)
        wire = await running.connect()
        assert (await wire.ask(bytes.fromhex(request_hex))).hex() == answer_hex.replace(" ", "")
        assert running.bank.get(Actuators) == ACTUATORS
        assert running.bank.get(PlantSession) == SESSION
        assert running.written == []
        assert (await wire.ask(bytes.fromhex("03 0000 0002"))).hex() == "030442f6e979"


ACCEPTED = {
    "FC3": ("03 0064 0008", "03 10 00000007" + floats(50, 100, 60), []),
    "FC3 of half a float": ("03 0067 0001", "03 02 0000", []),
    "FC3 of 125 registers": ("03 4000 007d", "03 fa" + "00" * 250, []),
    "FC3 in a gap between blocks": ("03 0032 0001", "03 02 0000", []),
    "FC3 from a block into the gap behind it": ("03 006a 000c", "03 18" + floats(60) + "00000001" + "0000" * 8, []),
    "FC3 from a gap into the next block": ("03 018f 0003", "03 06 0000 00000001", []),
    "FC3 of the last register": (f"03 {LAST} 0001", "03 02 0000", []),
    "FC4 in a gap between blocks": ("04 0032 0001", "04 02 0000", []),
    "FC4": ("04 0064 0008", "04 10 00000007" + floats(50, 100, 60), []),
    "FC6": ("06 0192 0001", "06 0192 0001", ["session"]),
    "FC16": ("10 0066 0004 08" + floats(1, 2), "10 0066 0004", ["actuators"]),
    "FC16 of 122 registers": ("10 03e8 007a f4" + "00" * 244, "10 03e8 007a", ["load table"]),
    "FC22": ("16 0197 fffe 0004", "16 0197 fffe 0004", ["session"]),
    "FC23 that reads in a gap": ("17 0032 0001 0066 0002 04" + floats(9), "17 02 0000", ["actuators"]),
    "FC23": ("17 0064 0004 0066 0002 04" + floats(9), "17 08 00000007" + floats(9), ["actuators"]),
    "FC23 writing 120 registers": ("17 0000 0001 03e8 0078 f0" + "00" * 240, "17 02 42f6", ["load table"]),
}


@pytest.mark.parametrize(("request_hex", "answer_hex", "blocks"), ACCEPTED.values(), ids=ACCEPTED.keys())
async def test_a_legal_request_is_answered_and_its_blocks_are_told(
    serve: "Serve", request_hex: str, answer_hex: str, blocks: list[str]
) -> None:
    async with serve() as running:
        running.bank.put(ACTUATORS)
        running.bank.put(SESSION)
        wire = await running.connect()
        assert await wire.ask(bytes.fromhex(request_hex)) == bytes.fromhex(answer_hex)
        assert running.written == blocks


async def test_a_mask_write_keeps_the_bits_under_the_and_mask_and_sets_those_of_the_or_mask_elsewhere(
    serve: "Serve",
) -> None:
    async with serve() as running:
        running.bank.put(SESSION._replace(load_steps=0x12))
        wire = await running.connect()
        await wire.ask(bytes.fromhex("16 0197 00f2 0025"))  # the example of section 6.16
        assert running.bank.get(PlantSession).load_steps == 0x17


@pytest.mark.parametrize("unit", [0, 1, 255])
async def test_the_unit_ids_of_a_server_that_is_no_gateway_are_answered(serve: "Serve", unit: int) -> None:
    async with serve() as running:
        wire = await running.connect()
        assert (await wire.ask(bytes.fromhex("03 0000 0002"), unit=unit)).hex() == "030442f6e979"


async def test_an_unknown_unit_id_is_refused_with_0x0b(serve: "Serve") -> None:
    async with serve() as running:
        wire = await running.connect()
        assert (await wire.ask(bytes.fromhex("03 0000 0002"), unit=2)).hex() == "830b"
        assert running.server.statistics().unknown_unit == 1


async def test_an_unknown_unit_id_is_met_with_silence_where_so_configured(serve: "Serve") -> None:
    async with serve(unknown_unit="silence", unit_ids={17}) as running:
        wire = await running.connect()
        wire.send(bytes.fromhex("0001 0000 0006 01 03 0000 0002 0002 0000 0006 11 03 0000 0002"))
        assert await wire.answer() == (2, 17, bytes.fromhex("030442f6e979"))


async def test_refusals_are_logged_in_one_line_and_not_over_and_over(
    serve: "Serve", caplog: pytest.LogCaptureFixture
) -> None:
    async with serve() as running:
        wire = await running.connect()
        for _ in range(50):
            await wire.ask(bytes.fromhex(f"03 {BEYOND} 0001"))
        (line,) = caplog.messages
        assert "service=plant kind=illegal_address" in line
        assert "\n" not in line
