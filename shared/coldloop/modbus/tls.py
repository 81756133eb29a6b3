"""Modbus/TCP Security: TLS 1.3 with certificates on both sides."""

import ssl
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.types import PublicKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key

from coldloop.errors import ConfigurationError
from coldloop.modbus.settings import TlsSettings


def server_context(settings: TlsSettings, name: str) -> ssl.SSLContext:
    """Return the context of a server that asks every client for its certificate.

    Args:
        settings: The files.
        name: Whose they are, for messages.

    Raises:
        ConfigurationError: A file cannot be used.
    """
    context = _context(ssl.PROTOCOL_TLS_SERVER, settings, name)
    context.verify_mode = ssl.CERT_REQUIRED
    context.num_tickets = 0  # a session that is resumed would not show its certificate again
    return context


def client_context(settings: TlsSettings, name: str) -> ssl.SSLContext:
    """Return the context of a client that checks the server's certificate and host name.

    Raises:
        ConfigurationError: A file cannot be used.
    """
    return _context(ssl.PROTOCOL_TLS_CLIENT, settings, name)


def _context(protocol: int, settings: TlsSettings, name: str) -> ssl.SSLContext:
    _check_files(settings, name)
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_cert_chain(settings.certificate, settings.key)
        context.load_verify_locations(settings.ca)
    except ssl.SSLError as error:
        raise ConfigurationError(f"{name}: {settings.certificate} cannot be used for TLS: {error.reason}") from None
    return context


def _check_files(settings: TlsSettings, name: str) -> None:
    """Say what OpenSSL would only hint at."""
    certificate = _certificates(settings.certificate, f"{name}: certificate")[0]
    key = _public_key_of(settings.key, f"{name}: key")
    if _comparable(key) != _comparable(certificate.public_key()):
        raise ConfigurationError(
            f"{name}: key {settings.key} does not belong to certificate {settings.certificate}: name a pair"
        )
    for authority in _certificates(settings.ca, f"{name}: ca"):
        _check_time(authority, f"{name}: ca {settings.ca}")
    _check_time(certificate, f"{name}: certificate {settings.certificate}")


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
        return file.read_bytes()
    except OSError as error:
        raise ConfigurationError(
            f"{what} {file}: {error.strerror}; name a readable file, or make some with `coldloop certificates`"
        ) from None


def _comparable(key: PublicKeyTypes) -> bytes:
    return key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)


def _check_time(certificate: x509.Certificate, what: str) -> None:
    now = datetime.now(UTC)
    if now > certificate.not_valid_after_utc:
        raise ConfigurationError(f"{what}: expired on {certificate.not_valid_after_utc:%Y-%m-%d}; make a new one")
    if now < certificate.not_valid_before_utc:
        raise ConfigurationError(
            f"{what}: not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC; check this clock"
        )
