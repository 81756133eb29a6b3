"""Certificates for a test site with Modbus/TCP Security: an authority, servers, clients, revocations, configuration.

For trying Modbus/TCP Security out. A real plant has its own authority, and keeps its key elsewhere.
"""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple, Self, TypeVar

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from coldloop import errors, text
from coldloop.modbus.connection import ROLE_EXTENSION, encoded_role
from coldloop.registers.declaration import Role
from coldloop_rig.cosim.wiring import SERVICES
from coldloop_rig.results.run_folder import prepare_folder, writing

T = TypeVar("T")


class Pair(NamedTuple):
    """A certificate and its key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @property
    def certificate_pem(self) -> bytes:
        """The certificate as PEM."""
        return self.certificate.public_bytes(Encoding.PEM)

    @property
    def key_pem(self) -> bytes:
        """The key as PEM, without a passphrase."""
        return self.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


class Authority:
    """A certificate authority. All that it issues ends when it does."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair

    @classmethod
    def new(cls, name: str, days: float) -> Self:
        """Return an authority that is valid from a day ago, as clocks differ, and for so many days from now."""
        now = datetime.now(UTC)
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _draft(name, name, key, now + timedelta(days=days))
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(_key_usage(signs_certificates=True), critical=True)
        return cls(Pair(_signed(builder, key.public_key(), key), key))

    def issue_server(self, name: str, hosts: Sequence[str], days: float | None = None) -> Pair:
        """Return a server's certificate, with the names and addresses that clients reach it by.

        Raises:
            ValueError: One of them is not a host name.
        """
        names = x509.SubjectAlternativeName([_general_name(host) for host in hosts])
        return self._issue(name, ExtendedKeyUsageOID.SERVER_AUTH, names, days)

    def issue_client(self, name: str, role: str | None, days: float | None = None) -> Pair:
        """Return a client's certificate with a role, or with none."""
        identifier, extension = x509.ObjectIdentifier(ROLE_EXTENSION), None
        if role is not None:
            extension = x509.UnrecognizedExtension(identifier, encoded_role(role))
        return self._issue(name, ExtendedKeyUsageOID.CLIENT_AUTH, extension, days)

    def revocation_list(self, revoked: Iterable[x509.RevokedCertificate], days: float) -> bytes:
        """Return the PEM list of revoked certificates, valid from a day ago and for so many days from now."""
        authority, now = self.pair.certificate, datetime.now(UTC)
        identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.pair.key.public_key())
        builder = (
            x509.CertificateRevocationListBuilder()
            .issuer_name(authority.subject)
            .last_update(now - timedelta(days=1))
            .next_update(now + timedelta(days=days))
            .add_extension(x509.CRLNumber(int(now.timestamp())), critical=False)
            .add_extension(identifier, critical=False)
        )
        for each in revoked:
            builder = builder.add_revoked_certificate(each)
        return builder.sign(self.pair.key, hashes.SHA256()).public_bytes(Encoding.PEM)

    def _issue(
        self, name: str, usage: x509.ObjectIdentifier, extension: x509.ExtensionType | None, days: float | None = None
    ) -> Pair:
        authority = self.pair.certificate
        end = authority.not_valid_after_utc if days is None else datetime.now(UTC) + timedelta(days=days)
        key = ec.generate_private_key(ec.SECP256R1())
        issuer = str(authority.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        builder = (
            _draft(name, issuer, key, end)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        )
        if extension is not None:
            builder = builder.add_extension(extension, critical=False)
        return Pair(_signed(builder, self.pair.key.public_key(), self.pair.key), key)


def revoked_now(certificate: x509.Certificate) -> x509.RevokedCertificate:
    """Return the entry of a certificate that is revoked now."""
    builder = x509.RevokedCertificateBuilder().serial_number(certificate.serial_number)
    return builder.revocation_date(datetime.now(UTC)).build()


def _draft(name: str, issuer: str, key: ec.EllipticCurvePrivateKey, end: datetime) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(_name(issuer))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(datetime.now(UTC), end) - timedelta(days=1))
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _signed(
    builder: x509.CertificateBuilder, authority: ec.EllipticCurvePublicKey, key: ec.EllipticCurvePrivateKey
) -> x509.Certificate:
    identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority)
    return builder.add_extension(identifier, critical=False).sign(key, hashes.SHA256())


def _name(common_name: str) -> x509.Name:
    organisation = x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Coldloop test site")
    return x509.Name([organisation, x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    others = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only")
    none = dict.fromkeys((*others, "decipher_only"), False)
    certificates = dict.fromkeys(("key_cert_sign", "crl_sign"), signs_certificates)
    return x509.KeyUsage(digital_signature=not signs_certificates, **certificates, **none)


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


CLIENTS = {**{role.value: role.value for role in Role}, "reader": None}
"""Clients and their roles."""
CONFIGURATION = "tls.toml"
REVOCATIONS = "ca.crl"
MADE = "name a certificate that `coldloop certificates` has made"
OWNERS = {
    "plant.server.tls": "plant", "control_plc.server.tls": "control_plc", "optimizer_plc.server.tls": "optimizer_plc",
    "control_plc.plant.tls": "control", "optimizer_plc.control_plc.tls": "optimizer", "rig.tls": "operator",
}  # fmt: skip
"""Sections of the configuration, and whose certificate goes there."""


def write_site(out: Path, hosts: Sequence[str], days: int) -> tuple[int, Path]:
    """Write all files, or none where one of them exists; return the number of certificates and the configuration file.

    Raises:
        UsageError: A file exists, or the folder cannot be written to.
        ResultsError: A file cannot be written.
    """
    authority = Authority.new("Coldloop test CA", days)
    pairs = {"ca": authority.pair}
    pairs |= {name: authority.issue_server(name, ["localhost", "127.0.0.1", *hosts]) for name in SERVICES}
    pairs |= {name: authority.issue_client(name, role) for name, role in CLIENTS.items()}
    files = {f"{name}.crt": pair.certificate_pem for name, pair in pairs.items()}
    files |= {f"{name}.key": pair.key_pem for name, pair in pairs.items()}
    lines, folder = ["# Made by `coldloop certificates`: Modbus/TCP Security on all three servers."], out.resolve()
    for section, owner in OWNERS.items():
        names = {"certificate": f"{owner}.crt", "key": f"{owner}.key", "ca": "ca.crt", "crl": REVOCATIONS}
        lines += ["", f"[{section}]"]
        lines += [f"{key} = {json.dumps(str(folder / name), ensure_ascii=False)}" for key, name in names.items()]
    files |= {REVOCATIONS: authority.revocation_list([], days), CONFIGURATION: ("\n".join(lines) + "\n").encode()}
    if present := next((name for name in files if (out / name).exists()), None):
        raise errors.UsageError(f"{out / present} exists: name another folder with --out, or remove the old files")
    prepare_folder(out)
    try:
        for name, data in files.items():
            mode = 0o600 if name.endswith(".key") else 0o644  # a key is private from the start
            descriptor = os.open(out / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(data)
    except OSError as error:
        raise errors.ResultsError(f"{error.filename or out}: {error.strerror}; choose another --out") from None
    return len(pairs), out / CONFIGURATION


def revoke(out: Path, names: Sequence[str], days: int) -> tuple[int, Path]:
    """Rewrite the list of revoked certificates with these added; return how many it has, and its file.

    Raises:
        UsageError: The folder has no such certificate, list or key of the authority.
        ResultsError: The list cannot be written.
    """
    needed, ours = "the key of the authority is needed to revoke", "name the folder of `coldloop certificates`"
    certificate = _loaded(out / "ca.crt", MADE, x509.load_pem_x509_certificate)
    key = _loaded(out / "ca.key", needed, partial(load_pem_private_key, password=None))
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise errors.UsageError(f"{out / 'ca.key'}: not a key that `coldloop certificates` has made")
    authority = Authority(Pair(certificate, key))
    revoked = list(_loaded(out / REVOCATIONS, ours, x509.load_pem_x509_crl))
    present = {each.serial_number for each in revoked}
    certificates = [_loaded(out / f"{name}.crt", MADE, x509.load_pem_x509_certificate) for name in names]
    revoked += [revoked_now(each) for each in certificates if each.serial_number not in present]
    with writing(out / REVOCATIONS):
        text.require_regular_file(out / REVOCATIONS)
        text.replace_file(out / REVOCATIONS, authority.revocation_list(revoked, days))
    return len(revoked), out / REVOCATIONS


def _loaded(file: Path, remedy: str, load: Callable[[bytes], T]) -> T:
    try:
        return load(text.read_bytes(file, remedy))
    except (ValueError, TypeError) as error:
        raise errors.UsageError(f"{file}: {error}; {remedy}") from None
