"""The sequence contract: what the optimiser sends, and the seal that shows a torn one.

The checks themselves are the control PLC's; `docs/link.md` describes the whole exchange.
"""

import struct
import zlib
from collections.abc import Sequence as Rows
from itertools import chain
from typing import NamedTuple, TypeAlias

from coldloop.registers.codec import codec_of
from coldloop.registers.control_plc import SequenceHeader
from coldloop.registers.declaration import Block

Inputs: TypeAlias = tuple[float, ...]
"""Inputs of one tick, in their order."""
_HEADER = codec_of(Block("sequence header", 0, SequenceHeader, ""))
_CRC_BYTES = 4


class InputSequence(NamedTuple):
    """A header and its rows, one row a tick."""

    header: SequenceHeader
    rows: Rows[Inputs]


def checksum(header: SequenceHeader, rows: Rows[Inputs]) -> int:
    """Return the CRC-32 of header (without its CRC) and rows, whatever the word order of the link."""
    crc = zlib.crc32(_HEADER.encode(header)[:-_CRC_BYTES])
    return zlib.crc32(struct.pack(f">{len(rows[0]) * len(rows) if rows else 0}f", *chain.from_iterable(rows)), crc)


def with_checksum(header: SequenceHeader, rows: Rows[Inputs]) -> InputSequence:
    """Return the sequence with its CRC filled in."""
    return InputSequence(header._replace(crc=checksum(header, rows)), rows)
