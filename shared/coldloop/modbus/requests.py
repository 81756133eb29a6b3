"""Frames, and the PDUs in them: what each function code does to a register bank.

A frame begins with the MBAP header; `length` counts the unit id and the PDU (Modbus Messaging on TCP/IP V1.0b, section
3.1.3):

    transaction id | protocol id = 0 | length | unit id | PDU
    2 bytes        | 2 bytes         | 2 bytes| 1 byte  | 1 to 253 bytes

Requests are decoded with `struct`. pymodbus converts register by register: an FC23 with 104 words read and 8 written
costs 58 us to decode and encode where this costs 4 us, and its decoders accept what the standard refuses. pymodbus
encodes the device identification, which is rarely requested.
"""

import struct
from collections.abc import Callable
from functools import partial
from typing import Annotated, Final, NamedTuple

from pydantic import BaseModel, StringConstraints
from pymodbus.constants import DeviceInformation
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest, ReadDeviceInformationResponse

from coldloop.registers.bank import Caller, IllegalAddressError, IllegalFunctionError, IllegalValueError, RegisterBank
from coldloop.registers.declaration import Block

MIN_LENGTH: Final = 2
MAX_LENGTH: Final = 254

_PREFIX: Final = struct.Struct(">HHH")
_HEADER: Final = struct.Struct(">HHHB")


class MalformedFrameError(Exception):
    """The stream is not Modbus/TCP; where the next request would begin is unknown."""


class Frame(NamedTuple):
    """One request or answer as it arrived; `end` is the position in the stream's buffer behind it."""

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


def framed(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Return `pdu` as a request, or as the answer to the request of this transaction and unit."""
    return _HEADER.pack(transaction, 0, len(pdu) + 1, unit) + pdu


ENCAPSULATED_INTERFACE: Final = 43
READ_DEVICE_IDENTIFICATION: Final = 14

_LAST_OBJECT: Final[dict[int, int]] = {
    DeviceInformation.BASIC: 0x02,
    DeviceInformation.REGULAR: 0x7F,
    DeviceInformation.EXTENDED: 0xFF,
}
_BASIC_CONFORMITY: Final = 0x81
_REGULAR_CONFORMITY: Final = 0x82

# An object must fit into one answer, or a client that follows "more follows" would never end.
_ObjectText = Annotated[str, StringConstraints(max_length=240, pattern=r"^[ -~]*$")]


class DeviceIdentity(BaseModel, frozen=True, extra="forbid"):
    """Who a server says it is. Without `url` only the basic objects exist."""

    vendor: _ObjectText = "Coldloop"
    product: _ObjectText
    revision: _ObjectText
    url: _ObjectText = ""

    def objects(self) -> dict[int, bytes]:
        """Return the identification objects by their number."""
        texts = [self.vendor, self.product, self.revision, *([self.url] if self.url else [])]
        return {number: text.encode("ascii") for number, text in enumerate(texts)}


def identification_answer(identity: DeviceIdentity, pdu: bytes) -> bytes:
    """Answer a function 43 request, Read Device Identification (Application Protocol V1.1b3, section 6.21).

    Raises:
        RefusedAccessError: The request is not 43 / 14, or asks for what does not exist.
    """
    if len(pdu) > 1 and pdu[1] != READ_DEVICE_IDENTIFICATION:
        raise IllegalFunctionError(f"encapsulated interface type {pdu[1]} is not served")
    if len(pdu) != 4:
        raise IllegalValueError(f"a PDU of {len(pdu)} bytes, not 4")
    request = ReadDeviceInformationRequest()
    request.decode(pdu[1:])
    objects, read_code, first = identity.objects(), request.read_code, request.object_id
    if read_code == DeviceInformation.SPECIFIC:
        if first not in objects:
            raise IllegalAddressError(f"no identification object {first}")
        selected = {first: objects[first]}
    elif read_code not in _LAST_OBJECT:
        raise IllegalValueError(f"read device id code {read_code}, not 1..4")
    else:
        in_category = {number: text for number, text in objects.items() if number <= _LAST_OBJECT[read_code]}
        first = first if first in in_category else 0  # the standard's rule for streams: begin again at the first object
        selected = {number: text for number, text in in_category.items() if number >= first}
    answer = ReadDeviceInformationResponse(read_code, selected)
    answer.conformity = _REGULAR_CONFORMITY if identity.url else _BASIC_CONFORMITY
    return bytes((ENCAPSULATED_INTERFACE,)) + answer.encode()


READ_COILS: Final = 1
READ_DISCRETE_INPUTS: Final = 2
READ_HOLDING_REGISTERS: Final = 3
READ_INPUT_REGISTERS: Final = 4
WRITE_SINGLE_COIL: Final = 5
WRITE_SINGLE_REGISTER: Final = 6
WRITE_MULTIPLE_COILS: Final = 15
WRITE_MULTIPLE_REGISTERS: Final = 16
MASK_WRITE_REGISTER: Final = 22
READ_WRITE_REGISTERS: Final = 23

SERVER_FAILURE: Final = 4
NO_SUCH_UNIT: Final = 0x0B

MAX_READ_WORDS: Final = 125
MAX_WRITE_WORDS: Final = 123
MAX_READ_WRITE_WORDS: Final = 121
MAX_READ_BITS: Final = 2000
MAX_WRITE_BITS: Final = 1968

_PAIR: Final = struct.Struct(">xHH")
_WRITE: Final = struct.Struct(">xHHB")
_MASK: Final = struct.Struct(">xHHH")
_READ_WRITE: Final = struct.Struct(">xHHHHB")
_WORD: Final = struct.Struct(">H")


class Written(NamedTuple):
    """A request that has stored something: the blocks that it touched, and what makes its answer."""

    blocks: list[Block]
    answer: Callable[[], bytes]


class RequestHandler:
    """Carries requests of one client out on one bank.

    Nothing is stored unless the whole request is right.
    """

    def __init__(self, bank: RegisterBank, identity: DeviceIdentity, caller: Caller) -> None:
        self._bank = bank
        self._caller = caller
        self._functions: Final[dict[int, Callable[[bytes], bytes | Written]]] = {
            **dict.fromkeys((READ_COILS, READ_DISCRETE_INPUTS, WRITE_SINGLE_COIL, WRITE_MULTIPLE_COILS), _refuse_bits),
            READ_HOLDING_REGISTERS: self._read,
            READ_INPUT_REGISTERS: self._read,
            WRITE_SINGLE_REGISTER: self._write_single,
            WRITE_MULTIPLE_REGISTERS: self._write_multiple,
            MASK_WRITE_REGISTER: self._mask_write,
            READ_WRITE_REGISTERS: self._read_write,
            ENCAPSULATED_INTERFACE: partial(identification_answer, identity),
        }

    def handle(self, pdu: bytes) -> bytes | Written:
        """Carry a request out; return its answer, or `Written` when blocks were written.

        Raises:
            RefusedAccessError: The request is refused; nothing was stored.
        """
        function = self._functions.get(pdu[0])
        if function is None:
            raise IllegalFunctionError(f"function {pdu[0]} is not served")
        return function(pdu)

    def _read(self, pdu: bytes) -> bytes:
        address, count = _unpacked(_PAIR, pdu)
        _check_quantity(count, MAX_READ_WORDS)
        return self._registers(pdu[0], address, count)

    def _registers(self, function: int, address: int, count: int) -> bytes:
        return bytes((function, 2 * count)) + self._bank.read(address, count)

    def _write_single(self, pdu: bytes) -> Written:
        address, _ = _unpacked(_PAIR, pdu)
        return Written(self._bank.write(address, pdu[3:], self._caller), lambda: pdu)

    def _write_multiple(self, pdu: bytes) -> Written:
        address, count, byte_count = _unpacked(_WRITE, pdu, has_data=True)
        data = pdu[_WRITE.size :]
        _check_quantity(count, MAX_WRITE_WORDS)
        _check_byte_count(byte_count, 2 * count, data)
        return Written(self._bank.write(address, data, self._caller), lambda: pdu[: _PAIR.size])

    def _mask_write(self, pdu: bytes) -> Written:
        address, and_mask, or_mask = _unpacked(_MASK, pdu)
        (present,) = _WORD.unpack(self._bank.read(address, 1))
        word = (present & and_mask) | (or_mask & ~and_mask)
        return Written(self._bank.write(address, _WORD.pack(word), self._caller), lambda: pdu)

    def _read_write(self, pdu: bytes) -> Written:
        read_address, read_count, address, count, byte_count = _unpacked(_READ_WRITE, pdu, has_data=True)
        data = pdu[_READ_WRITE.size :]
        _check_quantity(read_count, MAX_READ_WORDS)
        _check_quantity(count, MAX_READ_WRITE_WORDS)
        _check_byte_count(byte_count, 2 * count, data)
        self._bank.check_readable(read_address, read_count)  # before anything is stored
        blocks = self._bank.write(address, data, self._caller)
        return Written(blocks, partial(self._registers, READ_WRITE_REGISTERS, read_address, read_count))


def _refuse_bits(pdu: bytes) -> bytes:
    """Refuse a request for coils or discrete inputs, after the checks that the standard makes first."""
    if pdu[0] == WRITE_MULTIPLE_COILS:
        address, count, byte_count = _unpacked(_WRITE, pdu, has_data=True)
        _check_quantity(count, MAX_WRITE_BITS)
        _check_byte_count(byte_count, (count + 7) // 8, pdu[_WRITE.size :])
    else:
        address, value = _unpacked(_PAIR, pdu)
        if pdu[0] != WRITE_SINGLE_COIL:
            _check_quantity(value, MAX_READ_BITS)
        elif value not in (0x0000, 0xFF00):
            raise IllegalValueError(f"coil value 0x{value:04x}, not 0x0000 or 0xff00")
    raise IllegalAddressError(f"no coil or discrete input at {address}: this server has registers only")


def _unpacked(layout: struct.Struct, pdu: bytes, *, has_data: bool = False) -> tuple[int, ...]:
    """Unpack a PDU whose length is that of `layout`, or more when data follow."""
    if len(pdu) != layout.size and not (has_data and len(pdu) > layout.size):
        raise IllegalValueError(f"a PDU of {len(pdu)} bytes, not {layout.size}")
    return layout.unpack_from(pdu)


def _check_quantity(count: int, limit: int) -> None:
    if not 1 <= count <= limit:
        raise IllegalValueError(f"quantity {count}, not 1..{limit}")


def _check_byte_count(byte_count: int, expected: int, data: bytes) -> None:
    if not byte_count == expected == len(data):
        raise IllegalValueError(f"byte count {byte_count} and {len(data)} bytes of data, not {expected}")
