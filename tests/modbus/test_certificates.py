"""Certificates that have expired or have been revoked: what still starts, who is warned, and who is refused."""

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import Encoding

from coldloop.errors import ConfigurationError, PeerUnreachableError, UntrustedPeerError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.settings import Endpoint, TlsSettings
from coldloop.modbus.tls import first_expiry, tls_context
from coldloop_rig.cli.certificates import Authority, Pair, revoked_now
from tests.harness.records import CONTROL_MAP

if TYPE_CHECKING:
    from tests.modbus.conftest import Pki, Running, Serve

READ_MAGIC = bytes.fromhex("03 0000 0002")
MAGIC = bytes.fromhex("03 04 42f6e979")


def client_of(running: "Running", tls: TlsSettings) -> RegisterClient:
    return RegisterClient.at(CONTROL_MAP, Endpoint(port=running.server.port, timeout_s=60.0, tls=tls))


def not_yet_valid(pki: "Pki") -> Pair:
    """Return a certificate that will be valid tomorrow."""
    pair, authority = pki.authority.issue_client("tomorrow", "operator"), pki.authority.pair
    start = datetime.now(UTC) + timedelta(days=1)
    builder = (
        x509.CertificateBuilder(pair.certificate.issuer, pair.certificate.subject, pair.key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(start)
        .not_valid_after(start + timedelta(days=1))
    )
    return Pair(builder.sign(authority.key, hashes.SHA256()), pair.key)


def with_list(pki: "Pki", tls: TlsSettings, *revoked: Pair, days: float = 1, name: str = "ca") -> TlsSettings:
    """Return the same settings with a list of revoked certificates."""
    file = pki.folder / f"{name}.crl"
    file.write_bytes(pki.authority.revocation_list([revoked_now(pair.certificate) for pair in revoked], days))
    return tls.model_copy(update={"crl": file})


async def test_a_server_whose_certificate_has_expired_starts_warns_and_is_not_trusted(
    serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture
) -> None:
    pair = pki.authority.issue_server("old server", ["127.0.0.1"], days=-3)
    async with serve(CONTROL_MAP, tls=pki.keep("old-server", pair)) as running:
        (line,) = caplog.messages
        assert line.startswith(f"control_plc.server.tls: certificate {pki.folder / 'old-server.crt'} expired on 20")
        assert line.endswith("; make a new one")
        client = client_of(running, pki.keep("operator", pki.authority.issue_client("operator", "operator")))
        with pytest.raises(UntrustedPeerError, match="certificate has expired"):
            await client.connect(60.0)


async def test_a_client_whose_certificate_has_expired_exists_and_is_refused_by_the_server(
    serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture
) -> None:
    files = pki.keep("old", pki.authority.issue_client("old", "control", days=-1))
    async with serve(CONTROL_MAP, tls=pki.server) as running:
        client = client_of(running, files)
        with pytest.raises(PeerUnreachableError, match="that it accepts our certificate"):
            await client.connect(0.0)
        client.close()
        assert running.server.statistics().tls_refused == 1
    assert "old.crt expired on" in caplog.messages[0]
    assert "certificate has expired" in caplog.messages[1]


async def test_a_certificate_that_is_not_valid_yet_is_told_and_starts(
    serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture
) -> None:
    async with serve(CONTROL_MAP, tls=pki.keep("tomorrow", not_yet_valid(pki))):
        (line,) = caplog.messages
        assert "tomorrow.crt is not valid before 20" in line
        assert line.endswith(" UTC; check this clock")


def test_days_left_are_those_of_whatever_expires_first(pki: "Pki", tmp_path: Path) -> None:
    long = Authority.new("long", 100)
    pair = long.issue_client("short", None, days=20)
    files = {"certificate": tmp_path / "c", "key": tmp_path / "k", "ca": tmp_path / "a"}
    contents = (pair.certificate_pem, pair.key_pem, long.pair.certificate_pem)
    for file, data in zip(files.values(), contents, strict=True):
        file.write_bytes(data)
    tls = TlsSettings(**files)
    assert first_expiry(tls).days_left() == pytest.approx(20, abs=0.01)
    assert first_expiry(tls).days_left(datetime.now(UTC) + timedelta(days=25)) == pytest.approx(-5, abs=0.01)
    (tmp_path / "l").write_bytes(long.revocation_list([], 7))
    listed = tls.model_copy(update={"crl": tmp_path / "l"})
    assert first_expiry(listed).what == f"crl {tmp_path / 'l'}"
    assert first_expiry(listed).days_left() == pytest.approx(7, abs=0.01)
    files["ca"].write_bytes(pki.authority.pair.certificate_pem)
    assert first_expiry(tls).what == f"ca {tmp_path / 'a'}"
    assert first_expiry(tls).days_left() == pytest.approx(1, abs=0.01)
    files["certificate"].unlink()
    with pytest.raises(ConfigurationError, match=r"certificate .*: No such file"):
        first_expiry(tls).days_left()


@pytest.mark.parametrize(("warn_days", "lines"), [(0.0, 0), (0.5, 0), (30.0, 1)])
def test_a_certificate_that_expires_within_the_days_of_the_warning_is_logged(
    pki: "Pki", caplog: pytest.LogCaptureFixture, warn_days: float, lines: int
) -> None:
    tls_context(pki.server.model_copy(update={"warn_days": warn_days}), "plant.server.tls", ssl.PROTOCOL_TLS_SERVER)
    assert len(caplog.messages) == lines
    assert all(" expires on 20" in line for line in caplog.messages)


async def test_a_client_whose_certificate_is_revoked_is_refused_counted_and_logged_and_others_are_served(
    serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture
) -> None:
    lost = pki.authority.issue_client("lost laptop", "operator")
    tls = with_list(pki, pki.server, lost)
    async with serve(CONTROL_MAP, tls=tls, client=pki.client("operator")) as running:
        client = client_of(running, pki.keep("lost", lost))
        with pytest.raises(PeerUnreachableError, match="that it accepts our certificate"):
            await client.connect(0.0)
        client.close()
        assert await (await running.connect()).ask(READ_MAGIC) == MAGIC
        assert running.server.statistics().tls_refused == 1
        assert "its certificate is invalid: certificate revoked" in caplog.messages[0]


async def test_our_client_does_not_talk_to_a_server_whose_certificate_is_revoked(serve: "Serve", pki: "Pki") -> None:
    pair = pki.authority.issue_server("stolen", ["127.0.0.1"])
    ours = pki.keep("operator", pki.authority.issue_client("operator", "operator"))
    async with serve(CONTROL_MAP, tls=pki.keep("stolen", pair)) as running:
        good = client_of(running, with_list(pki, ours, name="empty"))
        await good.connect(1.0)
        good.close()
        wary = client_of(running, with_list(pki, ours, pair, name="stolen"))
        with pytest.raises(UntrustedPeerError, match="cannot be trusted: certificate revoked"):
            await wary.connect(60.0)


async def test_a_list_that_has_expired_is_told_at_the_start_and_refuses_everybody(
    serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture
) -> None:
    tls = with_list(pki, pki.server, days=-0.5, name="old")
    async with serve(CONTROL_MAP, tls=tls) as running:
        (line,) = caplog.messages
        assert line.startswith(f"control_plc.server.tls: crl {pki.folder / 'old.crl'} expired on 20")
        client = client_of(running, pki.keep("operator", pki.authority.issue_client("operator", "operator")))
        with pytest.raises(PeerUnreachableError):
            await client.connect(0.0)
        client.close()
        assert "CRL has expired" in caplog.messages[1]


def bad_list(pki: "Pki", case: str) -> Path:
    file = pki.folder / f"{case}.crl"
    if case == "junk":
        file.write_text("-----BEGIN X509 CRL-----\nnot base64!\n-----END X509 CRL-----\n")
    if case == "certificate":
        file.write_bytes(pki.authority.pair.certificate.public_bytes(Encoding.PEM))
    if case == "foreign":
        file.write_bytes(Authority.new("site", 1).revocation_list([], 1))
    return file


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("missing", "No such file or directory; name a readable file"),
        ("junk", "no PEM revocation list in it; name a file that has one"),
        ("certificate", "no PEM revocation list in it; name a file that has one"),
        ("foreign", "not issued by an authority in ca; name the list of one of them"),
    ],
)
def test_a_list_that_cannot_be_used_is_told_in_one_line(pki: "Pki", case: str, message: str) -> None:
    tls = pki.server.model_copy(update={"crl": bad_list(pki, case)})
    with pytest.raises(ConfigurationError, match=rf"^plant.server.tls: crl .*{case}.crl: {message}") as refusal:
        tls_context(tls, "plant.server.tls", ssl.PROTOCOL_TLS_SERVER)
    assert "\n" not in str(refusal.value)
