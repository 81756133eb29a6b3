"""An end-to-end check of what crosses the links.

TCP's checksum does not see what a gateway, a proxy or a memory does to a value. A sealed record ends with the CRC-32 of
all before it, as big-endian words whatever the word order of the link; 0 is "not sealed": a simple client's outputs,
and the rack's answer to outputs that it has not taken.
"""

import zlib
from typing import Any, TypeVar

from coldloop.registers.codec import RecordCodec, codec_of
from coldloop.registers.control_plc import CONTROL_MAP, Update
from coldloop.registers.plant import PLANT_MAP, Actuators, Measurement

S = TypeVar("S", Actuators, Measurement, Update)

_CODECS: dict[type[tuple[Any, ...]], RecordCodec] = {
    Actuators: codec_of(PLANT_MAP.block_of(Actuators)),
    Measurement: codec_of(PLANT_MAP.block_of(Measurement)),
    Update: codec_of(CONTROL_MAP.block_of(Update)),
}
_CRC_BYTES = 4


def _checksum(record: tuple[Any, ...]) -> int:
    return zlib.crc32(_CODECS[type(record)].encode(record)[:-_CRC_BYTES]) or 1


def sealed(record: S) -> S:
    """Return the record with its CRC filled in."""
    return record._replace(crc=_checksum(record))


def is_intact(record: Actuators | Measurement | Update) -> bool:
    """Tell whether a record that arrived is what was sent."""
    return not record.crc or record.crc == _checksum(record)
