"""Hypothesis strategies for the records of every map."""

import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import strategies as st

from coldloop.registers.declaration import Block, Field, Kind
from tests.harness.records import sealed

Records = Callable[[Block], st.SearchStrategy[tuple[Any, ...]]]


def values_of(field: Field) -> st.SearchStrategy[Any]:
    """Return the values that the declaration of a field allows, rounded as the bus rounds them."""
    numbers = [number_of(one) for _, one in field.registers]
    return st.tuples(*numbers) if field.elements else numbers[0]


def number_of(field: Field) -> st.SearchStrategy[Any]:
    if field.kind is Kind.F32:
        low, high = (None if bound is None else single(bound) for bound in (field.low, field.high))
        return st.floats(low, high, width=32, allow_nan=False, allow_infinity=False)
    return st.integers(int(field.low or 0), int(field.high or 2 ** (16 * field.kind.words) - 1))


def single(value: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


@pytest.fixture(scope="session")
def records() -> Records:
    def records_of(block: Block) -> st.SearchStrategy[tuple[Any, ...]]:
        rows = st.tuples(*map(values_of, block.fields.values())).map(lambda row: block.record(*row))
        return rows.map(sealed) if block.sealed else rows

    return records_of
