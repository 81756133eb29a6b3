"""Modbus/TCP Security: TLS 1.3 with certificates on both sides, and a listener for it.

The event loop's own TLS server does not report failed handshakes, and has no limit on those under way. Here each
is a task: it is counted when it fails, with the reason, and the oldest one gives way when there are too many.
"""

import asyncio
import logging
import ssl
import stat
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from socket import AI_PASSIVE, SOCK_STREAM, create_server, socket
from typing import Final, NamedTuple, Self

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.types import PublicKeyTypes
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from coldloop.errors import ConfigurationError, UsageError
from coldloop.modbus.connection import RefusalLog
from coldloop.modbus.settings import TlsSettings
from coldloop.text import read_bytes

CRL_BEGIN: Final = b"-----BEGIN X509 CRL-----"
DAY_S: Final = 86400.0

_logger = logging.getLogger("coldloop.modbus")


class Expiry(NamedTuple):
    """The file that expires first, and when."""

    what: str
    end: datetime

    def days_left(self, now: datetime | None = None) -> float:
        """Return the days from now on, negative when it has expired."""
        return (self.end - (now or datetime.now(UTC))).total_seconds() / DAY_S


def first_expiry(settings: TlsSettings, name: str = "tls") -> Expiry:
    """Return which of our certificate, the authorities and the revocation lists expires first.

    Reads the files: not for a control program to do in a scan.

    Raises:
        ConfigurationError: A file cannot be used.
    """
    certificate, authorities, lists = _read(settings, name)
    ends = [Expiry(f"certificate {settings.certificate}", certificate.not_valid_after_utc)]
    ends += [Expiry(f"ca {settings.ca}", authority.not_valid_after_utc) for authority in authorities]
    ends += [Expiry(f"crl {settings.crl}", each.next_update_utc) for each in lists if each.next_update_utc]
    return min(ends, key=lambda expiry: expiry.end)


def tls_context(settings: TlsSettings, name: str, protocol: int = ssl.PROTOCOL_TLS_CLIENT) -> ssl.SSLContext:
    """Return the context of a client, which checks the server's certificate and host name, or of a server.

    A server (`ssl.PROTOCOL_TLS_SERVER`) asks every client for its certificate. `name`, whose the files are, is for
    messages.

    Raises:
        ConfigurationError: A file cannot be used.
    """
    certificate, authorities, lists = _read(settings, name)
    key = _public_key_of(settings.key, f"{name}: key")  # OpenSSL would only hint at what is wrong
    if key != certificate.public_key():
        raise ConfigurationError(
            f"{name}: key {settings.key} does not belong to certificate {settings.certificate}: name a pair"
        )
    if settings.key.stat().st_mode & stat.S_IROTH:
        _logger.warning("%s: key %s: everyone can read it; `chmod o-r` it", name, settings.key)
    # Peers refuse files that have expired or are not valid yet, but the service starts.
    expiry, start = first_expiry(settings, name), certificate.not_valid_before_utc
    if (days := expiry.days_left()) < settings.warn_days:
        when = f"{'expired' if days < 0 else 'expires'} on {expiry.end:%Y-%m-%d}"
        _logger.warning("%s: %s %s; make a new one", name, expiry.what, when)
    if datetime.now(UTC) < start:
        when = f"{start:%Y-%m-%d %H:%M}"
        _logger.warning(
            "%s: certificate %s is not valid before %s UTC; check this clock", name, settings.certificate, when
        )
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    try:
        context.load_cert_chain(settings.certificate, settings.key)
        context.load_verify_locations(settings.ca)
        if settings.crl is not None:
            context.load_verify_locations(settings.crl)
    except ssl.SSLError as error:
        raise ConfigurationError(f"{name}: {settings.certificate} cannot be used for TLS: {error.reason}") from None
    if lists:
        whole = {each.issuer for each in lists} >= {authority.subject for authority in authorities}
        context.verify_flags |= ssl.VERIFY_CRL_CHECK_CHAIN if whole else ssl.VERIFY_CRL_CHECK_LEAF
    if protocol == ssl.PROTOCOL_TLS_SERVER:
        context.num_tickets = 0  # a session that is resumed would not show its certificate again
    return context


def _read(
    settings: TlsSettings, name: str
) -> tuple[x509.Certificate, list[x509.Certificate], list[x509.CertificateRevocationList]]:
    """Return our certificate, those of the authorities, and the revocation lists."""
    certificate = _certificates(settings.certificate, f"{name}: certificate")[0]
    authorities = _certificates(settings.ca, f"{name}: ca")
    lists = _revocation_lists(settings.crl, authorities, f"{name}: crl") if settings.crl else []
    return certificate, authorities, lists


def _revocation_lists(
    file: Path, authorities: Sequence[x509.Certificate], what: str
) -> list[x509.CertificateRevocationList]:
    _, *blocks = _contents(file, what).split(CRL_BEGIN)
    try:
        lists = [x509.load_pem_x509_crl(CRL_BEGIN + block) for block in blocks]
    except ValueError:
        lists = []
    if not lists:
        raise ConfigurationError(f"{what} {file}: no PEM revocation list in it; name a file that has one")
    for each in lists:
        if not any(_is_by(each, authority) for authority in authorities):
            raise ConfigurationError(f"{what} {file}: not issued by an authority in ca; name the list of one of them")
    return lists


def _is_by(revocations: x509.CertificateRevocationList, authority: x509.Certificate) -> bool:
    if revocations.issuer != authority.subject:
        return False
    try:
        return revocations.is_signature_valid(authority.public_key())  # type: ignore[arg-type] # others raise
    except TypeError:
        return False


def _certificates(file: Path, what: str) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(_contents(file, what))
    except ValueError:
        raise ConfigurationError(f"{what} {file}: no PEM certificate in it; name a file that has one") from None


def _public_key_of(file: Path, what: str) -> PublicKeyTypes:
    try:
        return load_pem_private_key(_contents(file, what), password=None).public_key()
    except TypeError:
        raise ConfigurationError(f"{what} {file}: has a passphrase; name a key without one") from None
    except ValueError:
        raise ConfigurationError(f"{what} {file}: no PEM key in it; name a file that has one") from None


def _contents(file: Path, what: str) -> bytes:
    try:
        return read_bytes(file, "name a readable file, or make some with `coldloop certificates`", most=2**24)
    except UsageError as error:
        raise ConfigurationError(f"{what} {error}") from None


HANDSHAKE_S: Final = 5.0
"""How long a handshake may take."""
FAREWELL_S: Final = 1.0
"""How long a client may take to answer the end of the TLS session."""
PAUSE_S: Final = 0.1
"""How long to wait when the system has no more sockets."""


class TlsListener:
    """Sockets that are listened on, and the handshakes under way, so many at most; `refusals` takes those that fail.

    `make_protocol` makes what serves a connection that is secure, by the context of a server.
    """

    def __init__(
        self, sockets: Sequence[socket], context: ssl.SSLContext, make_protocol: Callable[[], asyncio.Protocol],
        limit: int, refusals: RefusalLog,
    ) -> None:  # fmt: skip
        self.sockets = tuple(sockets)
        self._context = context
        self._make_protocol = make_protocol
        self._limit = limit
        self._refusals = refusals
        self._handshakes: dict[asyncio.Task[None], str] = {}  # with the peer of each, the oldest first
        self._doors = [asyncio.create_task(self._listen(door), name="TLS listener") for door in self.sockets]

    @classmethod
    async def at(
        cls, host: str, port: int, context: ssl.SSLContext, *, make_protocol: Callable[[], asyncio.Protocol],
        limit: int, refusals: RefusalLog,
    ) -> Self:  # fmt: skip
        """Listen on all addresses of a host.

        Raises:
            OSError: One of them cannot be listened on.
        """
        loop = asyncio.get_running_loop()
        infos = await loop.getaddrinfo(host or None, port, type=SOCK_STREAM, flags=AI_PASSIVE)
        sockets: list[socket] = []
        try:
            for family, _, _, _, address in dict.fromkeys(infos):
                sockets.append(create_server(address, family=family, backlog=100))
                sockets[-1].setblocking(False)  # noqa: FBT003 - it takes it by position only
        except OSError:
            for each in sockets:
                each.close()
            raise
        return cls(sockets, context, make_protocol, limit, refusals)

    def close(self) -> None:
        """Listen no more, and give up the handshakes under way."""
        for task in (*self._doors, *self._handshakes):
            task.cancel()
        for each in self.sockets:
            each.close()

    async def _listen(self, door: socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                client, address = await loop.sock_accept(door)
            except OSError:
                await asyncio.sleep(PAUSE_S)
                continue
            if len(self._handshakes) >= self._limit:
                oldest = next(iter(self._handshakes))
                oldest.cancel()
                why = "too many handshakes under way, and this is the oldest"
                self._refusals.note("tls_refused", self._handshakes.pop(oldest), why)
            peer = f"{address[0]}:{address[1]}"
            task = loop.create_task(self._secure(client, peer), name="TLS handshake")
            self._handshakes[task] = peer
            task.add_done_callback(partial(self._forget, client))

    def _forget(self, client: socket, task: asyncio.Task[None]) -> None:
        self._handshakes.pop(task, None)
        if task.cancelled():
            client.close()

    async def _secure(self, client: socket, peer: str) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                self._make_protocol, client,
                ssl=self._context, ssl_handshake_timeout=HANDSHAKE_S, ssl_shutdown_timeout=FAREWELL_S,
            )  # fmt: skip
        except ssl.SSLCertVerificationError as error:
            reason = f"its certificate is invalid: {error.verify_message}"
        except ssl.SSLError as error:
            reason = (error.reason or "TLS failed").replace("_", " ").lower()
        except OSError as error:
            reason = f"the handshake ended early: {error}".rstrip(": ")
        else:
            return
        self._refusals.note("tls_refused", peer, reason)
