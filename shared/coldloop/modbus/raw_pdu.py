"""pymodbus PDUs that carry bytes.

pymodbus turns register values into lists of integers and back, one register at a time. Records are encoded and decoded
as bytes, so these PDUs hand the bytes through; transactions, framing and time-outs stay with pymodbus.
"""

from pymodbus.pdu import DecodePDU, ModbusPDU


class RawPdu(ModbusPDU):
    """A request or response: `payload` is what follows the function code."""

    def __init__(self, function: int, payload: bytes) -> None:
        super().__init__(dev_id=1)
        self.function_code = function
        self.payload = payload

    def encode(self) -> bytes:
        """Return the bytes behind the function code."""
        return self.payload


class RawDecoder(DecodePDU):
    """Takes any response as it is; pymodbus' own raises into the event loop when it does not know a function."""

    def decode(self, frame: bytes) -> ModbusPDU:
        """Return the response whose bytes are `frame`."""
        return RawPdu(frame[0], frame[1:])
