"""Modbus/TCP Security: certificates on both sides, the role in the client's."""

import asyncio
import ssl
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, PrivateFormat

from coldloop.errors import ConfigurationError, PeerUnreachableError, RequestRefusedError, UntrustedPeerError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.connection import decoded_role, encoded_role
from coldloop.modbus.settings import Endpoint, TlsSettings
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import AwaitUpdate, Grant, SequenceRow
from coldloop_rig.cli.certificates import Authority
from tests.harness.records import CONTROL_MAP

if TYPE_CHECKING:
    from tests.modbus.conftest import Pki, Running, Serve

READ_MAGIC = bytes.fromhex("03 0000 0002")
MAGIC = bytes.fromhex("03 04 42f6e979")
WRITE_GRANT = bytes.fromhex("10 01cc 0002 04 00000009")
WRITE_ROW = bytes.fromhex("10 01f4 0006 0c 41200000 41200000 41200000")


def client_of(running: "Running", tls: TlsSettings | None) -> RegisterClient:
    return RegisterClient.at(CONTROL_MAP, Endpoint(port=running.server.port, timeout_s=60.0, tls=tls))


def bare_context(pki: "Pki") -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(pki.folder / "ca.crt")
    return context


@pytest.mark.parametrize(("role", "grant", "row"), [("operator", 16, 0x90), ("optimizer", 0x90, 16)])
async def test_the_role_in_the_certificate_counts_and_not_the_address(
    serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture, role: str, grant: int, row: int
) -> None:
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client(role)) as running:
        wire = await running.connect()
        assert (await wire.ask(WRITE_GRANT))[0] == grant
        assert (await wire.ask(WRITE_ROW))[0] == row
        assert running.bank.get(Grant) == Grant(9 if grant == 16 else 0)
        assert running.bank.get(SequenceRow).u[0] == (10.0 if row == 16 else 0.0)
        assert running.server.statistics().access_refused == 1
        assert f"CN=client-{role}" in caplog.messages[0]
        assert f'role="{role}"' in caplog.messages[0]
        assert "block '" in caplog.messages[0]


@pytest.mark.parametrize("role", [None, "", "Operator", "janitor", "optimizer,operator", "x" * 127])
async def test_without_a_role_that_is_known_a_certificate_lets_read_and_no_more(
    serve: "Serve", pki: "Pki", role: str | None
) -> None:
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client(role)) as running:
        wire = await running.connect()
        assert await wire.ask(READ_MAGIC) == MAGIC
        assert await wire.ask(WRITE_GRANT) == b"\x90\x01"
        assert await wire.ask(WRITE_ROW) == b"\x90\x01"
        assert running.written == []


async def turned_away(running: "Running", context: ssl.SSLContext) -> None:
    """Connect and ask: with TLS 1.3 a client may send before it learns that it was refused."""
    try:
        wire = await running.connect(tls=context)
        wire.send(bytes.fromhex("0001 0000 0006 01") + READ_MAGIC)
        assert await wire.closed() == b""
    except OSError:
        return


async def refused_for(running: "Running", caplog: pytest.LogCaptureFixture) -> str:
    """Return why the last client was refused; others are still served."""
    while not running.server.statistics().tls_refused:
        assert await (await running.connect()).ask(READ_MAGIC) == MAGIC
    assert running.server.statistics().tls_refused == 1
    assert running.server.statistics().server_failure == 0
    return next(line for line in caplog.messages if "kind=tls_refused" in line)


async def test_no_certificate(serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture) -> None:
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client(None)) as running:
        await turned_away(running, bare_context(pki))
        assert "peer did not return a certificate" in await refused_for(running, caplog)


async def test_a_certificate_of_another_authority(serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture) -> None:
    files = pki.keep("foreign", Authority.new("site", 1).issue_client("foreign", "operator"))
    context = bare_context(pki)
    context.load_cert_chain(files.certificate, files.key)
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client(None)) as running:
        await turned_away(running, context)
        assert "its certificate is invalid" in await refused_for(running, caplog)


async def test_a_server_certificate_does_not_make_a_client(
    serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture
) -> None:
    context = bare_context(pki)
    context.load_cert_chain(pki.server.certificate, pki.server.key)
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client(None)) as running:
        await turned_away(running, context)
        assert "certificate purpose" in await refused_for(running, caplog)


async def test_tls_before_1_3(serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture) -> None:
    context = bare_context(pki)
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client(None)) as running:
        await turned_away(running, context)
        assert "unsupported protocol" in await refused_for(running, caplog)


async def test_plain_modbus_where_tls_is_spoken(serve: "Serve", pki: "Pki", caplog: pytest.LogCaptureFixture) -> None:
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client(None)) as running:
        client = client_of(running, None)
        with pytest.raises(PeerUnreachableError, match="closed the connection"):
            await client.connect(0.0)
        client.close()
        assert "kind=tls_refused" in await refused_for(running, caplog)


async def test_tls_where_plain_modbus_is_spoken(serve: "Serve", pki: "Pki") -> None:
    files = pki.keep("operator", pki.authority.issue_client("operator", "operator"))
    async with serve(CONTROL_MAP) as running:
        client = client_of(running, files)
        with pytest.raises(PeerUnreachableError, match=r"does not speak TLS 1\.3: check server.tls there"):
            await client.connect(0.0)
        assert running.server.statistics().malformed_frame == 1


async def test_handshakes_under_way_are_bounded_and_do_not_keep_others_out(serve: "Serve", pki: "Pki") -> None:
    async with serve(CONTROL_MAP, tls=pki.server, client=pki.client("operator"), connection_limit=3) as running:
        silent = [await asyncio.open_connection("127.0.0.1", running.server.port) for _ in range(5)]
        assert await silent[0][0].read() == b""
        assert await silent[1][0].read() == b""
        assert await (await running.connect()).ask(READ_MAGIC) == MAGIC
        assert running.server.connections == 1
        for _, writer in silent:
            writer.close()


async def test_our_client_reads_and_writes_by_its_role(serve: "Serve", pki: "Pki") -> None:
    files = pki.keep("optimizer", pki.authority.issue_client("optimizer", "optimizer"))
    async with serve(CONTROL_MAP, tls=pki.server) as running:
        client = client_of(running, files)
        await client.connect(1.0)
        await client.write_rows([SequenceRow((float(row), 0.0, 0.0)) for row in range(100)])
        assert (await client.exchange(AwaitUpdate(1, 2), Identity)).map_digest == CONTROL_MAP.digest
        with pytest.raises(RequestRefusedError, match=r"exception 1, .*not for the role of this client"):
            await client.write(Grant(1))
        assert [row.u[0] for row in await client.read_rows(SequenceRow, 0, 100)] == list(range(100))
        client.close()


async def test_our_client_trusts_no_server_of_another_authority_and_does_not_go_on_trying(
    serve: "Serve", pki: "Pki"
) -> None:
    foreign = Authority.new("other", 1)
    files = pki.keep("of-other", foreign.issue_client("operator", "operator"))
    (pki.folder / "other-ca.crt").write_bytes(foreign.pair.certificate_pem)
    async with serve(CONTROL_MAP, tls=pki.server) as running:
        client = client_of(running, files.model_copy(update={"ca": pki.folder / "other-ca.crt"}))
        with pytest.raises(UntrustedPeerError, match=r"cannot be trusted: .*: check the host name, and tls.ca here$"):
            await client.connect(60.0)


async def test_our_client_without_the_trust_of_the_server_is_told_what_to_check(serve: "Serve", pki: "Pki") -> None:
    files = pki.keep("of-other", Authority.new("other", 1).issue_client("operator", "operator"))
    async with serve(CONTROL_MAP, tls=pki.server) as running:
        client = client_of(running, files)
        with pytest.raises(PeerUnreachableError, match="that it accepts our certificate"):
            await client.connect(0.0)
        client.close()


def changed(pki: "Pki", name: str, **files: Path) -> TlsSettings:
    good = pki.keep(name, pki.authority.issue_client(name, "operator"))
    return good.model_copy(update=files)


def bad_files(pki: "Pki", case: str) -> TlsSettings:
    here = pki.folder
    if case == "missing":
        return changed(pki, "bad", certificate=here / "none.crt")
    if case == "a folder":
        return changed(pki, "bad", key=here)
    if case == "passphrase":
        pair = pki.authority.issue_client("secret", None)
        files = pki.keep("secret", pair)
        files.key.write_bytes(
            pair.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret"))
        )
        return files
    junk = here / "junk.pem"
    junk.write_bytes(b"-----BEGIN CERTIFICATE-----\nnot base64!\n-----END CERTIFICATE-----\n")
    return {
        "junk certificate": changed(pki, "bad", certificate=junk),
        "junk key": changed(pki, "bad", key=junk),
        "junk ca": changed(pki, "bad", ca=junk),
        "another key": changed(pki, "bad", key=pki.server.key),
    }[case]


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("missing", r"certificate .*none.crt: No such file or directory; name a readable file, or make some"),
        ("a folder", r"key .*: not a regular file; name a readable file"),
        ("passphrase", r"key .*: has a passphrase; name a key without one"),
        ("junk certificate", r"certificate .*: no PEM certificate in it; name a file that has one"),
        ("junk key", r"key .*: no PEM key in it; name a file that has one"),
        ("junk ca", r"ca .*: no PEM certificate in it; name a file that has one"),
        ("another key", r"key .* does not belong to certificate .*: name a pair"),
    ],
)
async def test_bad_files_are_told_in_one_line(serve: "Serve", pki: "Pki", case: str, message: str) -> None:
    files = bad_files(pki, case)
    with pytest.raises(ConfigurationError, match=rf"^control_plc.server.tls: {message}") as of_the_server:
        async with serve(CONTROL_MAP, tls=files):
            pass
    assert "\n" not in str(of_the_server.value)
    with pytest.raises(ConfigurationError, match=rf"^tls of the client of control_plc at 127.0.0.1:1: {message}"):
        RegisterClient.at(CONTROL_MAP, Endpoint(port=1, tls=files))


async def test_a_key_that_everyone_can_read_is_told(
    serve: "Serve", pki: "Pki", tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    key = tmp_path / "key.pem"
    key.write_bytes(pki.server.key.read_bytes())
    key.chmod(0o644)
    async with serve(CONTROL_MAP, tls=pki.server.model_copy(update={"key": key})):
        pass
    assert [record for record in caplog.records if f"key {key}: everyone can read it" in record.getMessage()]


def test_a_role_survives_its_encoding_and_nonsense_is_no_role() -> None:
    assert decoded_role(encoded_role("opérateur")) == "opérateur"
    for der in (b"", b"\x0c", b"\x0c\x05abc", b"\x13\x03abc", b"\x0c\x81\x80" + b"a" * 128):
        assert decoded_role(der) == ""
    assert decoded_role(b"\x0c\x02\xff\xfe") not in {"operator", "control", "optimizer"}
