"""Read Device Identification, function 43 / 14 (Application Protocol V1.1b3, section 6.21)."""

from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, StringConstraints
from pymodbus.constants import DeviceInformation
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest, ReadDeviceInformationResponse

from coldloop.registers.bank import IllegalAddressError, IllegalValueError, RefusedAccessError

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


class DeviceIdentity(BaseModel):
    """Who a server says it is. Without `url` only the basic objects exist."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    vendor: _ObjectText = "Coldloop"
    product: _ObjectText
    revision: _ObjectText
    url: _ObjectText = ""

    def objects(self) -> dict[int, bytes]:
        """Return the identification objects by their number."""
        texts = [self.vendor, self.product, self.revision, *([self.url] if self.url else [])]
        return {number: text.encode("ascii") for number, text in enumerate(texts)}


def identification_answer(identity: DeviceIdentity, pdu: bytes) -> bytes:
    """Answer a function 43 request.

    Raises:
        RefusedAccessError: The request is not 43 / 14, or asks for what does not exist.
    """
    if len(pdu) > 1 and pdu[1] != READ_DEVICE_IDENTIFICATION:
        raise RefusedAccessError(1, f"encapsulated interface type {pdu[1]} is not served")
    if len(pdu) != 4:
        raise IllegalValueError(f"a PDU of {len(pdu)} bytes, not 4")
    request = ReadDeviceInformationRequest()
    request.decode(pdu[1:])
    objects = identity.objects()
    answer = ReadDeviceInformationResponse(request.read_code, _selected(objects, request.read_code, request.object_id))
    answer.conformity = _REGULAR_CONFORMITY if identity.url else _BASIC_CONFORMITY
    return bytes((ENCAPSULATED_INTERFACE,)) + answer.encode()


def _selected(objects: dict[int, bytes], read_code: int, first: int) -> dict[int, bytes]:
    if read_code == DeviceInformation.SPECIFIC:
        if first not in objects:
            raise IllegalAddressError(f"no identification object {first}")
        return {first: objects[first]}
    if read_code not in _LAST_OBJECT:
        raise IllegalValueError(f"read device id code {read_code}, not 1..4")
    in_category = {number: text for number, text in objects.items() if number <= _LAST_OBJECT[read_code]}
    if first not in in_category:
        first = 0  # the standard's rule for streams: an unknown object starts from the beginning
    return {number: text for number, text in in_category.items() if number >= first}
