"""Hypothesis strategies for the records of every map."""

import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import strategies as st

from coldloop.registers.declaration import Block, Field, Kind, fields_of
from coldloop.registers.seal import sealed

Records = Callable[[Block], st.SearchStrategy[tuple[Any, ...]]]


def values_of(field: Field) -> st.SearchStrategy[Any]:
    """Return the values that the declaration of a field allows, rounded as the bus rounds them."""
    number: st.SearchStrategy[Any]
    if field.kind is Kind.F32:
        low, high = (None if bound is None else single(bound) for bound in (field.low, field.high))
        number = st.floats(low, high, width=32, allow_nan=False, allow_infinity=False)
    else:
        number = st.integers(int(field.low or 0), int(field.high or 2 ** (16 * field.kind.words) - 1))
    return st.tuples(*[number] * len(field.elements)) if field.elements else number


def single(value: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


@pytest.fixture(scope="session")
def records() -> Records:
    def records_of(block: Block) -> st.SearchStrategy[tuple[Any, ...]]:
        rows = st.tuples(*map(values_of, fields_of(block.record).values())).map(lambda row: block.record(*row))
        return rows.map(sealed) if block.sealed else rows

    return records_of
