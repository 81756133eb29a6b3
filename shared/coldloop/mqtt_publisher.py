"""Publishes to an MQTT broker (version 3.1.1), and reads nothing from it but the acknowledgements of what was sent.

A client that can subscribe takes packets of up to 256 MB, as many as a broker sends. Control cannot wait for that:
here each answer has four bytes, and whatever else comes ends the connection unread.
"""

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator
from typing import Final, NamedTuple

ANSWER_BYTES: Final = 4
CONNECT, CONNACK, PUBLISH, PUBACK, DISCONNECT = 0x10, 0x20, 0x30, 0x40, 0xE0
AT_LEAST_ONCE_AND_RETAINED: Final = 0x03
"""Quality of service 1 and the flag that the broker keeps the message, in the first byte of PUBLISH."""
_REFUSALS: Final = {
    1: "another version of the protocol",
    2: "the client's name",
    3: "the server is unavailable",
    4: "wrong user name or password",
    5: "not authorised",
}


class BrokerError(Exception):
    """The broker refuses, or sends what is no answer."""


class Login(NamedTuple):
    """Who connects, and what the broker publishes when the connection is lost."""

    username: str
    """Empty is a broker that asks for none."""
    password: str | None
    will_topic: str
    will: str
    keepalive_s: int
    """Something is published more often than this, 1 to 65535."""


class MqttPublisher:
    """A connection to a broker; `connected` makes it."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, timeout_s: float) -> None:
        self._reader = reader
        self._writer = writer
        self._timeout_s = timeout_s
        self._number = 0

    @classmethod
    @contextlib.asynccontextmanager
    async def connected(cls, host: str, port: int, login: Login, timeout_s: float) -> "AsyncIterator[MqttPublisher]":
        """Connect; the connection ends with the context, without a farewell unless `disconnect` was called.

        Raises:
            BrokerError: The broker refuses.
            OSError: It cannot be reached.
            TimeoutError: It does not answer within `timeout_s`.
            EOFError: It has closed the connection.
        """
        async with asyncio.timeout(timeout_s):
            reader, writer = await asyncio.open_connection(host, port, limit=ANSWER_BYTES)
        try:
            one = cls(reader, writer, timeout_s)
            await one._log_in(login)
            yield one
        finally:
            writer.transport.abort()

    async def _log_in(self, login: Login) -> None:
        has_password = login.password is not None
        flags = 0x80 * bool(login.username) | 0x40 * has_password | 0x20 | 0x08 | 0x04 | 0x02  # will retained, QoS 1
        fields = [f"coldloop-{secrets.token_hex(4)}", login.will_topic, login.will]
        if login.username:
            fields += [login.username, *([login.password] if login.password is not None else [])]
        head = _text("MQTT") + bytes((4, flags)) + login.keepalive_s.to_bytes(2, "big")
        async with asyncio.timeout(self._timeout_s):
            await self._send(CONNECT, head + b"".join(map(_text, fields)))
            code = (await self._answer(CONNACK))[1]
        if code:
            raise BrokerError(f"refused: {_REFUSALS.get(code, f'reason {code}')}")

    async def publish(self, topic: str, message: str) -> None:
        """Publish a message that the broker keeps, and wait until it has it.

        Raises:
            BrokerError: The broker sent something else than an acknowledgement.
            OSError, TimeoutError, EOFError: As of `connected`.
        """
        self._number = self._number % 0xFFFF + 1
        number = self._number.to_bytes(2, "big")
        async with asyncio.timeout(self._timeout_s):
            await self._send(PUBLISH | AT_LEAST_ONCE_AND_RETAINED, _text(topic) + number + message.encode())
            while await self._answer(PUBACK) != number:  # of one that was not waited for
                pass

    async def disconnect(self) -> None:
        """Take leave: the broker does not publish the will."""
        async with asyncio.timeout(self._timeout_s):
            await self._send(DISCONNECT, b"")
            self._writer.close()
            await self._writer.wait_closed()

    async def _send(self, kind: int, body: bytes) -> None:
        self._writer.write(bytes((kind,)) + _length(len(body)) + body)
        await self._writer.drain()

    async def _answer(self, kind: int) -> bytes:
        """Return the two bytes that an answer of this kind carries."""
        answer = await self._reader.readexactly(ANSWER_BYTES)
        if answer[:2] != bytes((kind, 2)):
            raise BrokerError(f"it sent a packet of type {answer[0] >> 4}, which nobody has asked for")
        return answer[2:]


def _text(text: str) -> bytes:
    raw = text.encode()
    return len(raw).to_bytes(2, "big") + raw


def _length(length: int) -> bytes:
    """Return a length as MQTT has it: seven bits a byte, the lowest first, the eighth says that more follow."""
    digits = bytearray()
    while True:
        length, digit = divmod(length, 0x80)
        digits.append(digit | 0x80 * bool(length))
        if not length:
            return bytes(digits)
