"""Seals are of the bytes that travel, whatever the values are that they stand for."""

import zlib

import pytest

from coldloop.registers.codec import CRC_BYTES, Seal, WordOrder, codec_of
from coldloop.registers.plant import Actuators, Measurement
from tests.harness.records import PLANT_MAP, sealed

MEASUREMENT = PLANT_MAP.block_of(Measurement)
RECORD = Measurement(7, 385.0, (1.0,) * 22, (2.0,) * 28, 1, (0.0,) * 3)


@pytest.mark.parametrize("bits", [0x7FA00000, 0x7F800001, 0xFFA12345, 0x7FC00000])
def test_the_seal_of_a_record_with_any_nan_is_intact(bits: int) -> None:
    codec = codec_of(MEASUREMENT, WordOrder.HIGH_FIRST)
    raw = bytearray(codec.encode(RECORD))
    raw[8:12] = bits.to_bytes(4, "big")  # L1
    raw[-CRC_BYTES:] = zlib.crc32(raw[:-CRC_BYTES]).to_bytes(CRC_BYTES, "big")
    assert codec.seal_of(raw) is Seal.INTACT
    raw[9] ^= 1
    assert codec.seal_of(raw) is Seal.BROKEN


@pytest.mark.parametrize("order", WordOrder)
def test_a_record_that_is_sealed_while_it_is_encoded_is_that_which_was_sealed_before(order: WordOrder) -> None:
    codec = codec_of(PLANT_MAP.block_of(Actuators), order)
    record = Actuators(7, (43.5, 75.25, 36.1), 0x1234_5678, holder=0xDEAD_BEEF, crc=99)
    assert codec.encode_sealed(record) == codec.encode(sealed(record))
    assert codec.seal_of(codec.encode_sealed(record)) is Seal.INTACT
