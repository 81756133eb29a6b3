import struct
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.registers.codec import WordOrder, codec_of
from coldloop.registers.common import IDENTITY_BLOCK, MAGIC, Identity
from coldloop.registers.control_plc import Grant
from coldloop.registers.declaration import Block
from coldloop.registers.plant import LoadStep, Measurement
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP, as_transmitted

if TYPE_CHECKING:
    from tests.registers.conftest import Records

BLOCKS = {
    f"{register_map.service}: {block.name}": block
    for register_map in (PLANT_MAP, CONTROL_MAP, OPTIMIZER_MAP)
    for block in register_map.blocks
}
each_block = pytest.mark.parametrize("block", BLOCKS.values(), ids=BLOCKS.keys())
each_order = pytest.mark.parametrize("order", WordOrder)


@each_block
@each_order
@settings(max_examples=10)
@given(data=st.data())
def test_every_record_survives_the_bus(records: "Records", block: Block, order: WordOrder, data: st.DataObject) -> None:
    record = data.draw(records(block))
    codec = codec_of(block, order)
    raw = codec.encode(record)
    assert len(raw) == codec.size == 2 * block.row_words
    decoded = codec.decode(raw)
    assert decoded == record
    assert type(decoded) is block.record
    assert codec.decode(b"\0\0\0" + raw + b"\0", 3) == record
    assert as_transmitted(record) == record


@each_block
@settings(max_examples=10)
@given(data=st.data())
def test_the_word_orders_differ_in_the_halves_of_32_bit_values_only(
    records: "Records", block: Block, data: st.DataObject
) -> None:
    record = data.draw(records(block))
    high = codec_of(block, WordOrder.HIGH_FIRST).encode(record)
    low = codec_of(block, WordOrder.LOW_FIRST).encode(record)
    for register in block.registers():
        start = 2 * (register.address - block.address)
        if register.kind.words == 1:
            assert high[start : start + 2] == low[start : start + 2]
        else:
            assert high[start : start + 4] == low[start + 2 : start + 4] + low[start : start + 2]


def test_the_magic_float_stands_at_address_0_as_every_client_expects() -> None:
    assert codec_of(IDENTITY_BLOCK).encode(Identity())[:4] == bytes.fromhex("42f6e979")
    assert codec_of(IDENTITY_BLOCK, WordOrder.LOW_FIRST).encode(Identity())[:4] == bytes.fromhex("e97942f6")


def test_a_float_arrives_rounded_to_single_precision() -> None:
    arrived = as_transmitted(Identity()).magic
    assert arrived != MAGIC
    assert arrived == struct.unpack("f", struct.pack("f", MAGIC))[0]


@pytest.mark.parametrize("record", [Grant(-1), Grant(2**32), LoadStep(0, 1e39)])
def test_a_value_that_fits_no_register_is_an_error(record: tuple[float, ...]) -> None:
    block = next(block for block in BLOCKS.values() if block.record is type(record))
    with pytest.raises((struct.error, OverflowError)):
        codec_of(block).encode(record)


def test_an_array_of_the_wrong_length_is_an_error() -> None:
    block = BLOCKS["plant: measurement"]
    with pytest.raises(struct.error):
        codec_of(block).encode(Measurement(0, 0.0, (1.0,) * 21, (1.0,) * 28, 1, (0.0,) * 3))
