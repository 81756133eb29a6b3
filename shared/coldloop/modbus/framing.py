"""The MBAP header: where a request begins and ends in a stream of bytes.

    transaction id | protocol id = 0 | length | unit id | PDU
    2 bytes        | 2 bytes         | 2 bytes| 1 byte  | 1 to 253 bytes

`length` counts the unit id and the PDU (Modbus Messaging on TCP/IP V1.0b, section 3.1.3).
"""

import struct
from typing import Final, NamedTuple

MIN_LENGTH: Final = 2
MAX_LENGTH: Final = 254

_PREFIX: Final = struct.Struct(">HHH")
_HEADER: Final = struct.Struct(">HHHB")


class MalformedFrameError(Exception):
    """The stream is not Modbus/TCP; where the next request would begin is unknown."""


class Frame(NamedTuple):
    """One request as it arrived; `end` is the position in the stream's buffer behind it."""

    transaction: int
    unit: int
    pdu: bytes
    end: int


def next_frame(buffer: bytearray, position: int) -> Frame | None:
    """Return the frame that begins at `position`, or None while it has not arrived whole.

    Raises:
        MalformedFrameError: What is there is no MBAP header.
    """
    if len(buffer) - position < _PREFIX.size:
        return None
    transaction, protocol, length = _PREFIX.unpack_from(buffer, position)
    if protocol != 0:
        raise MalformedFrameError(f"protocol id {protocol} in the MBAP header, not 0")
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        raise MalformedFrameError(f"length {length} in the MBAP header, not {MIN_LENGTH}..{MAX_LENGTH}")
    start = position + _PREFIX.size
    end = start + length
    if len(buffer) < end:
        return None
    return Frame(transaction, buffer[start], bytes(buffer[start + 1 : end]), end)


def framed(request: Frame, pdu: bytes) -> bytes:
    """Return `pdu` as the answer to `request`."""
    return _HEADER.pack(request.transaction, 0, len(pdu) + 1, request.unit) + pdu
