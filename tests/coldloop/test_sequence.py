import math
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.registers.codec import WordOrder, codec_of
from coldloop.registers.control_plc import SequenceHeader, SequenceRow
from coldloop.safety.writers import InputSequence, checksum, with_checksum
from tests.harness.records import CONTROL_MAP, Row, as_transmitted

ROWS = [Row(43.0 + 0.01 * tick, 75.0 - tick, 36.0) for tick in range(20)]
HEADER = SequenceHeader(number=7, update=6, first_tick=140, length=20, tau_u=20, model_digest=0x2B8F1A90, crc=0)

words = st.integers(0, 2**32 - 1)
shorts = st.integers(0, 2**16 - 1)
headers = st.builds(SequenceHeader, words, words, words, shorts, shorts, words, words)
rows = st.lists(st.builds(Row, *[st.floats(width=32)] * 3), max_size=40)


def flipped(value: float, bit: int) -> float:
    bits = struct.unpack(">I", struct.pack(">f", value))[0] ^ (1 << bit)
    return float(struct.unpack(">f", struct.pack(">I", bits))[0])


@pytest.mark.parametrize(("field", "bits"), [(0, 32), (1, 32), (2, 32), (3, 16), (4, 16), (5, 32)])
def test_any_flipped_bit_of_the_header_changes_the_crc(field: int, bits: int) -> None:
    expected = checksum(HEADER, ROWS)
    for bit in range(bits):
        values: list[Any] = list(HEADER)
        values[field] ^= 1 << bit
        assert checksum(SequenceHeader(*values), ROWS) != expected


@settings(max_examples=2 * settings.default.max_examples)
@given(row=st.integers(0, 19), column=st.integers(0, 2), bit=st.integers(0, 31))
def test_any_flipped_bit_of_a_row_changes_the_crc(row: int, column: int, bit: int) -> None:
    values: list[float] = list(ROWS[row])
    values[column] = flipped(values[column], bit)
    torn = [*ROWS[:row], Row(*values), *ROWS[row + 1 :]]
    assert checksum(HEADER, torn) != checksum(HEADER, ROWS)


def test_a_missing_an_added_and_two_exchanged_rows_change_the_crc() -> None:
    changed = [ROWS[:-1], [*ROWS, ROWS[-1]], [ROWS[1], ROWS[0], *ROWS[2:]], [*ROWS[:-1], Row(0.0, 0.0, 0.0)]]
    assert len({checksum(HEADER, rows) for rows in [ROWS, *changed]}) == 5


@given(header=headers, rows=rows, crc=words)
def test_the_crc_does_not_depend_on_the_crc_that_stands_in_the_header(
    header: SequenceHeader, rows: list[Row], crc: int
) -> None:
    assert checksum(header._replace(crc=crc), rows) == checksum(header, rows)


@given(header=headers, rows=rows)
def test_a_seal_survives_the_bus(header: SequenceHeader, rows: list[Row]) -> None:
    sequence = with_checksum(header, rows)
    assert sequence.header.crc == checksum(header, rows)
    arrived = InputSequence(as_transmitted(sequence.header), [as_transmitted(row) for row in sequence.rows])
    assert checksum(*arrived) == arrived.header.crc


def test_a_value_is_sealed_as_the_single_precision_number_that_travels() -> None:
    exact = [Row(0.1, 0.2, 0.3)]
    assert checksum(HEADER, exact) == checksum(HEADER, [as_transmitted(row) for row in exact])
    assert checksum(HEADER, [Row(math.nan, 0.0, 0.0)]) != checksum(HEADER, [Row(0.0, 0.0, 0.0)])


def test_the_crc_is_that_of_the_big_endian_words_whatever_the_order_of_the_link() -> None:
    """CRC-32 as in zlib and Ethernet, bit by bit: what another make of PLC would have to compute."""
    header, row = (codec_of(CONTROL_MAP.block_of(kind), WordOrder.HIGH_FIRST) for kind in (SequenceHeader, SequenceRow))
    data = header.encode(HEADER)[:-4] + b"".join(row.encode(SequenceRow(values)) for values in ROWS)
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert checksum(HEADER, ROWS) == crc ^ 0xFFFFFFFF
