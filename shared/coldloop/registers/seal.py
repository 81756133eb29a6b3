"""An end-to-end check of what crosses the links.

TCP's checksum does not see what a gateway, a proxy or a memory does to a value. A sealed record ends with the CRC-32 of
all before it, as big-endian words whatever the word order of the link; 0 is "not sealed", as a simple client leaves it.
A seal is checked on the bytes that arrived: decoding changes some of them (a signalling NaN becomes a quiet one).
"""

import zlib
from enum import Enum
from typing import Any, TypeVar, cast

from coldloop.registers.codec import RecordCodec, codec_of
from coldloop.registers.declaration import RegisterMap

S = TypeVar("S", bound=tuple[Any, ...])

CRC_BYTES = 4


class Seal(Enum):
    """What the seal of a record says."""

    ABSENT = "absent"
    INTACT = "intact"
    BROKEN = "broken"


def seal_of(codec: RecordCodec, data: bytes | bytearray | memoryview, offset: int = 0) -> Seal:
    """Return what the seal says of the record in `data` at `offset`."""
    raw = codec.canonical(data, offset)
    crc = int.from_bytes(raw[-CRC_BYTES:], "big")
    if not crc:
        return Seal.ABSENT
    return Seal.INTACT if crc == _checksum(raw) else Seal.BROKEN


def sealed(record: S, of: RegisterMap) -> S:
    """Return a record of a map with its field `crc`, the last one, filled in."""
    crc = _checksum(codec_of(of.block_of(type(record))).encode(record))
    return cast("S", record._replace(crc=crc))  # type: ignore[attr-defined] # a NamedTuple


def sealed_bytes(codec: RecordCodec, record: tuple[Any, ...]) -> bytes:
    """Return the bytes of `sealed`, which is encoded once only."""
    raw = bytes(codec.canonical(codec.encode(record)))
    return bytes(codec.canonical(raw[:-CRC_BYTES] + _checksum(raw).to_bytes(CRC_BYTES, "big")))  # words back in order


def _checksum(raw: bytes | bytearray | memoryview) -> int:
    return zlib.crc32(raw[:-CRC_BYTES]) or 1
