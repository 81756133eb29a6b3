import struct
from typing import TYPE_CHECKING, Annotated, NamedTuple

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from coldloop.registers.bank import IllegalAddressError, IllegalValueError, RefusedAccessError, RegisterBank
from coldloop.registers.codec import WordOrder, codec_of
from coldloop.registers.common import IDENTITY_BLOCK
from coldloop.registers.control_plc import SequenceRow
from coldloop.registers.declaration import Block, RegisterMap, Role, f32
from coldloop.registers.plant import Actuators, LoadStep, PlantSession
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP

if TYPE_CHECKING:
    from tests.registers.conftest import Records

BANKS = {order: {each: RegisterBank(each, order) for each in (CONTROL_MAP, OPTIMIZER_MAP)} for order in WordOrder}
WRITABLE = {
    f"{register_map.service}: {block.name}": (register_map, block)
    for register_map in (CONTROL_MAP, OPTIMIZER_MAP)
    for block in register_map.blocks
    if block.writer is not None
}


class Bounds(NamedTuple):
    above: Annotated[float, f32("At least 1", low=1)]
    below: Annotated[float, f32("At most 2", high=2)]


@pytest.fixture
def control() -> RegisterBank:
    return RegisterBank(CONTROL_MAP)


@pytest.mark.parametrize("order", WordOrder)
@pytest.mark.parametrize(("register_map", "block"), WRITABLE.values(), ids=WRITABLE.keys())
@settings(max_examples=10)
@given(data=st.data())
def test_what_is_written_is_what_is_read(
    records: "Records", order: WordOrder, register_map: RegisterMap, block: Block, data: st.DataObject
) -> None:
    bank = BANKS[order][register_map]
    record = data.draw(records(block))
    row = data.draw(st.integers(0, block.rows - 1))
    raw = codec_of(block, order).encode(record)
    address = block.address + row * block.row_words
    assert bank.write(address, raw) == [block]
    assert bank.get(block.record, row) == record
    assert bank.read(address, block.row_words) == raw


@settings(max_examples=2 * settings.default.max_examples)
@given(address=st.integers(0, 0xFFFF), data=st.binary(min_size=1, max_size=123).map(lambda half: half + half))
def test_a_refused_write_stores_nothing_and_an_accepted_one_everything(address: int, data: bytes) -> None:
    bank = BANKS[WordOrder.HIGH_FIRST][CONTROL_MAP]
    whole = bank.read(0, CONTROL_MAP.end)
    try:
        bank.write(address, data)
    except RefusedAccessError:
        assert bank.read(0, CONTROL_MAP.end) == whole
    else:
        assert bank.read(address, len(data) // 2) == data


@given(first=st.integers(0, 7), count=st.integers(1, 8))
def test_a_write_takes_32_bit_values_whole_or_not_at_all(first: int, count: int) -> None:
    assume(first + count <= 8)
    bank = BANKS[WordOrder.HIGH_FIRST][CONTROL_MAP]
    if first % 2 == 0 and count % 2 == 0:
        bank.write(500 + first, bytes(2 * count))
    else:
        with pytest.raises(IllegalValueError, match="whole or not at all"):
            bank.write(500 + first, bytes(2 * count))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_float_that_is_no_number_is_refused_even_without_a_range(control: RegisterBank, value: float) -> None:
    with pytest.raises(IllegalValueError, match=r"sequence\.ncr22 is not a finite number"):
        control.write(500, struct.pack(">3f", 1.0, value, 1.0))
    assert control.get(SequenceRow) == SequenceRow((0.0, 0.0, 0.0))


@pytest.mark.parametrize(("address", "count"), [(CONTROL_MAP.end, 1), (CONTROL_MAP.end - 1, 2), (0xFFFF, 2)])
def test_nothing_is_read_beyond_the_end_of_the_map(control: RegisterBank, address: int, count: int) -> None:
    with pytest.raises(IllegalAddressError, match=f"the map ends at {CONTROL_MAP.end - 1}"):
        control.read(address, count)


@given(address=st.integers(0, CONTROL_MAP.end - 1), count=st.integers(1, 125))
def test_a_block_read_may_cross_the_gaps_of_a_map_which_are_zero(address: int, count: int) -> None:
    bank = BANKS[WordOrder.HIGH_FIRST][CONTROL_MAP]
    assume(address + count <= CONTROL_MAP.end)
    words = bank.read(address, count)
    assert len(words) == 2 * count
    declared = {each for block in CONTROL_MAP.blocks for each in range(block.address, block.end)}
    for place in range(count):
        if address + place not in declared:
            assert words[2 * place : 2 * place + 2] == b"\0\0"


@pytest.mark.parametrize(("address", "count"), [(0, 2), (13, 1), (406, 2), (400, 8), (0xFFFF, 1), (0xFFFF, 2)])
def test_registers_that_are_not_writable_are_not_written(control: RegisterBank, address: int, count: int) -> None:
    with pytest.raises(IllegalAddressError):
        control.write(address, bytes(2 * count))


def test_a_range_with_one_end_is_checked_and_named() -> None:
    bounds = RegisterMap("bounds", 1, (IDENTITY_BLOCK, Block("bounds", 50, Bounds, "", Role.OPERATOR)))
    bank = RegisterBank(bounds)
    bank.write(50, struct.pack(">2f", 1e30, -1e30))
    with pytest.raises(IllegalValueError, match=r"bounds\.above = 0\.5 is below 1"):
        bank.write(50, struct.pack(">f", 0.5))
    with pytest.raises(IllegalValueError, match=r"bounds\.below = 2\.5 is above 2"):
        bank.write(52, struct.pack(">f", 2.5))


def test_the_ends_of_a_range_belong_to_it() -> None:
    bank = RegisterBank(PLANT_MAP)
    bank.write(100, struct.pack(">Ifff", 1, 0.0, 1000.0, 100.0))
    assert bank.get(Actuators) == Actuators(1, (0.0, 1000.0, 100.0), 0)
    bank.put(PlantSession(session=1, realtime=0, factor=1.0, seed=2, load_steps=3))
    bank.write(403, struct.pack(">f", 0.01))  # in single precision this is less than 0.01


def test_a_write_over_several_rows_names_its_block_once() -> None:
    bank = RegisterBank(PLANT_MAP)
    assert [block.name for block in bank.write(1000, struct.pack(">IfIf", 0, 1.0, 5, 2.0))] == ["load table"]
    assert bank.get(LoadStep, 1) == LoadStep(5, 2.0)
