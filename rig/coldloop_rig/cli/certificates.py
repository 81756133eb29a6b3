"""Certificates for a test site: an authority, and certificates of servers and clients.

For trying Modbus/TCP Security out. A real plant has its own authority, and keeps its key elsewhere.
"""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from typing import NamedTuple, Self

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from coldloop.modbus.access import ROLE_EXTENSION, encoded_role


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
        builder = _draft(name, name, key, now + timedelta(days=days)).add_extension(
            x509.BasicConstraints(ca=True, path_length=0), critical=True
        )
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
        extension = _role_extension(role) if role is not None else None
        return self._issue(name, ExtendedKeyUsageOID.CLIENT_AUTH, extension, days)

    def revocation_list(self, revoked: Iterable[x509.RevokedCertificate], days: float) -> bytes:
        """Return the PEM list of revoked certificates, valid from a day ago and for so many days from now."""
        authority, now = self.pair.certificate, datetime.now(UTC)
        builder = (
            x509.CertificateRevocationListBuilder()
            .issuer_name(authority.subject)
            .last_update(now - timedelta(days=1))
            .next_update(now + timedelta(days=days))
            .add_extension(x509.CRLNumber(int(now.timestamp())), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self.pair.key.public_key()), critical=False
            )
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


def _role_extension(role: str) -> x509.UnrecognizedExtension:
    return x509.UnrecognizedExtension(x509.ObjectIdentifier(ROLE_EXTENSION), encoded_role(role))


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
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Coldloop test site"),
            x509.NameAttribute(NameOID.COMMON_NAME, common_name),
        ]
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)
