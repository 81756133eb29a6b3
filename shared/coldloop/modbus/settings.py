"""Settings of servers: set-up, rights of clients, and the address for a client."""

from ipaddress import IPv4Network, IPv6Network
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, IPvAnyNetwork, PositiveFloat

from coldloop.registers.codec import WordOrder

Networks = tuple[IPvAnyNetwork, ...]
"""Addresses and networks, such as `192.168.7.11` and `10.1.0.0/16`."""

LOOPBACK: Final[Networks] = (IPv4Network("127.0.0.0/8"), IPv6Network("::1/128"))
EVERYBODY: Final[Networks] = (IPv4Network("0.0.0.0/0"), IPv6Network("::/0"))


class AccessSettings(BaseModel, frozen=True, extra="forbid"):
    """Where the clients of each role are, and who may read. A client may have several roles; who has one may read.

    None of this counts with TLS: there the client's certificate says its role, and who has a certificate may read.

    Args:
        control: Where the control PLC is.
        optimizer: Where the optimiser PLC is.
        operator: Where operators are.
        readers: Who may read, without a role.
    """

    control: Networks = LOOPBACK
    optimizer: Networks = LOOPBACK
    operator: Networks = LOOPBACK
    readers: Networks = EVERYBODY


class TlsSettings(BaseModel, frozen=True, extra="forbid"):
    """Files for Modbus/TCP Security, all PEM; `coldloop certificates` makes a set.

    Args:
        certificate: Our certificate, and the intermediate ones that lead to the peer's CA.
        key: Its key, without a passphrase.
        ca: Certificates of the authorities whose peers we accept.
        crl: Revocation lists of these authorities: peers whose certificates are listed are refused. All peers are,
            when the list has expired.
        warn_days: How long before one of these files expires there is a warning, days.
    """

    certificate: Path
    key: Path
    ca: Path
    crl: Path | None = None
    warn_days: float = Field(default=30.0, ge=0)


class ServerSettings(BaseModel):
    """Where a server listens, whom it answers and how many.

    Args:
        host: Address to listen on.
        port: TCP port; 0 takes any free one.
        unit_ids: Unit ids that are answered. Clients that talk to the server itself use 255, 0 or 1.
        unknown_unit: Other unit ids are refused with exception 0x0B, or left without an answer.
        access: Who may write and read.
        tls: Modbus/TCP Security instead of plain Modbus/TCP.
        connection_limit: Connections served at a time. A further one replaces one that is idle, or is refused.
        replaceable_after_s: A connection is idle, and may be replaced, when its last request is this long ago.
        idle_timeout_s: A connection without a whole request for this long is closed.
        request_rate: Requests a second that a connection may keep up; beyond, it is read from later. 0 is no limit.
        reader_request_rate: The same for a client without a role, which has the lower of both; 0 is `request_rate`.
        request_burst: Requests that a connection with a limit may make at once.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    port: int = Field(ge=0, le=0xFFFF)
    unit_ids: frozenset[Annotated[int, Field(ge=0, le=255)]] = frozenset({0, 1, 255})
    unknown_unit: Literal["refuse", "silence"] = "refuse"
    access: AccessSettings = AccessSettings()
    tls: TlsSettings | None = None
    connection_limit: int = Field(default=32, ge=1)
    replaceable_after_s: float = Field(default=10.0, ge=0)
    idle_timeout_s: float = Field(default=300.0, gt=0)
    request_rate: float = Field(default=0.0, ge=0)
    reader_request_rate: float = Field(default=200.0, ge=0)
    request_burst: int = Field(default=100, ge=1)


PLANT_PORT = 5020
CONTROL_PORT = 5021
OPTIMIZER_PORT = 5022


class Endpoint(BaseModel):
    """Address of a Modbus/TCP server."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    """Name or address."""
    port: Annotated[int, Field(ge=1, le=65535)]
    """TCP port."""
    word_order: WordOrder = WordOrder.HIGH_FIRST
    timeout_s: PositiveFloat = 3.0
    """How long an answer may take."""
    tls: TlsSettings | None = None
    """Modbus/TCP Security instead of plain Modbus/TCP."""
