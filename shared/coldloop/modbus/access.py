"""Identity and rights of a client: by its address, or with TLS by the role in its certificate.

A certificate says its role in the X.509v3 extension of the Modbus/TCP Security Protocol Specification (v21, section
8.2, "Role extension"): a UTF8String. One without a role, or with a role that we do not know, may only read.
"""

import json
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final

from coldloop.modbus.settings import AccessSettings, Networks
from coldloop.registers.bank import Caller
from coldloop.registers.declaration import Role

ROLE_EXTENSION: Final = "1.3.6.1.4.1.50316.802.1"
UTF8_STRING: Final = 0x0C
"""Tag of a UTF8String in DER."""
MAX_LENGTH: Final = 127
"""Longest role, in bytes: what DER says the length of in one byte."""


def caller_at(host: str, name: str, access: AccessSettings) -> Caller | None:
    """Return the caller at an address, or None if the address is not allowed."""
    address = _plain_address(host)
    places = {Role.CONTROL: access.control, Role.OPTIMIZER: access.optimizer, Role.OPERATOR: access.operator}
    roles = frozenset(role for role, networks in places.items() if _within(address, networks))
    if not roles and not _within(address, access.readers):
        return None
    return Caller(name, roles)


def caller_with(certificate: bytes, name: str) -> Caller:
    """Return the caller with a verified certificate (DER)."""
    subject, role = _subject_and_role(certificate)
    known = {each.value: each for each in Role}
    described = " ".join(f"{key}={json.dumps(text)}" for key, text in (("certificate", subject), ("role", role)))
    return Caller(f"{name} {described}", frozenset({known[role]} if role in known else ()))


def _plain_address(host: str) -> IPv4Address | IPv6Address:
    """Return an address; an IPv4 client of a dual-stack socket is returned as IPv4."""
    address = ip_address(host)
    return getattr(address, "ipv4_mapped", None) or address


def _within(address: IPv4Address | IPv6Address, networks: Networks) -> bool:
    return any(address in network for network in networks)


def _subject_and_role(der: bytes) -> tuple[str, str]:
    """Return both as they stand in a certificate; empty where it is too odd to be read, though OpenSSL took it."""
    from cryptography import x509  # noqa: PLC0415 a service without TLS starts without it

    odd = (x509.DuplicateExtension, x509.UnsupportedGeneralNameType, x509.InvalidVersion)
    subject = ""
    try:
        certificate = x509.load_der_x509_certificate(der)
        subject = certificate.subject.rfc4514_string()
        extension = certificate.extensions.get_extension_for_oid(x509.ObjectIdentifier(ROLE_EXTENSION)).value
    except (x509.ExtensionNotFound, ValueError, *odd):
        return subject, ""
    return subject, decoded_role(extension.public_bytes())


def encoded_role(text: str) -> bytes:
    """Return a role as the extension's DER."""
    raw = text.encode()
    if len(raw) > MAX_LENGTH:
        raise ValueError(f"a role of more than {MAX_LENGTH} bytes")
    return bytes((UTF8_STRING, len(raw))) + raw


def decoded_role(der: bytes) -> str:
    """Return the role in an extension's DER, empty when it is not one."""
    if len(der) < 2 or der[0] != UTF8_STRING or der[1] > MAX_LENGTH or der[1] != len(der) - 2:
        return ""
    return der[2:].decode(errors="replace")
