"""`coldloop certificates`: what it makes fits together, and it overwrites nothing."""

import ssl
import stat
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from coldloop.config import load_configuration
from coldloop.modbus.connection import Caller, caller_with
from coldloop.modbus.tls import tls_context
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from tests.conftest import Coldloop

USAGE = 2
CLIENTS = {"control", "optimizer", "operator", "reader"}
SERVERS = {"plant", "control_plc", "optimizer_plc"}


def certificate(file: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(file.read_bytes())


def caller(file: Path) -> Caller:
    return caller_with(certificate(file).public_bytes(Encoding.DER), "")


def test_keys_are_private_and_certificates_name_hosts_and_roles(coldloop: "Coldloop", tmp_path: Path) -> None:
    out = tmp_path / "new" / "site"
    outcome = coldloop("certificates", "--out", out, "--host", "plant", "--host", "192.168.7.2", "--days", "30")
    assert outcome.code == 0
    assert str(out / "tls.toml") in outcome.out
    keys = list(out.glob("*.key"))
    assert {key.stem for key in keys} == SERVERS | CLIENTS | {"ca"}
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}
    for service in SERVERS:
        names = certificate(out / f"{service}.crt").extensions.get_extension_for_class(x509.SubjectAlternativeName)
        assert names.value.get_values_for_type(x509.DNSName) == ["localhost", "plant"]
        assert [str(one) for one in names.value.get_values_for_type(x509.IPAddress)] == ["127.0.0.1", "192.168.7.2"]
    roles = {client: caller(out / f"{client}.crt").roles for client in CLIENTS}
    assert roles == {client: set() if client == "reader" else {client} for client in CLIENTS}


def test_the_configuration_that_comes_with_them_is_whole_and_its_files_can_be_used(
    coldloop: "Coldloop", tmp_path: Path
) -> None:
    out = tmp_path / 'a "quoted" site'
    assert coldloop("certificates", "--out", out).code == 0
    settings = load_configuration(Settings, file=out / "tls.toml", environment={}).settings
    for section in (settings.plant, settings.control_plc, settings.optimizer_plc):
        assert section.server.tls is not None
        tls_context(section.server.tls, "server", ssl.PROTOCOL_TLS_SERVER)
    for tls in (settings.control_plc.plant.tls, settings.optimizer_plc.control_plc.tls, settings.rig.tls):
        assert tls is not None
        tls_context(tls, "client")
    assert tomllib.loads((out / "tls.toml").read_text())["rig"]["tls"]["key"] == str(out / "operator.key")


def test_what_is_revoked_is_in_the_list_that_the_configuration_names_and_stays_in_it(
    coldloop: "Coldloop", tmp_path: Path
) -> None:
    out = tmp_path / "site"
    coldloop("certificates", "--out", out)
    for name, number in (("operator", 1), ("reader", 2), ("operator", 2)):
        outcome = coldloop("certificates", "--out", out, "--revoke", name, "--days", "9")
        assert outcome.code == 0
        assert outcome.out.startswith(f"{number} revoked in {out / 'ca.crl'}; restart the services")
    assert coldloop("certificates", "--out", out, "--renew-list", "--days", "99").code == 0
    revoked = x509.load_pem_x509_crl((out / "ca.crl").read_bytes())
    assert {each.serial_number for each in revoked} == {
        certificate(out / f"{name}.crt").serial_number for name in ("operator", "reader")
    }
    settings = load_configuration(Settings, file=out / "tls.toml", environment={}).settings
    assert settings.plant.server.tls is not None
    assert settings.plant.server.tls.crl == out / "ca.crl"
    tls_context(settings.plant.server.tls, "server", ssl.PROTOCOL_TLS_SERVER)
    assert not (out / "ca.crl.new").exists()


@pytest.mark.parametrize(("missing", "message"), [("ca.key", "is needed to revoke"), ("operator.crt", "has made")])
def test_revoking_needs_the_authority_and_the_certificate(
    coldloop: "Coldloop", tmp_path: Path, missing: str, message: str
) -> None:
    coldloop("certificates", "--out", tmp_path)
    (tmp_path / missing).unlink()
    outcome = coldloop("certificates", "--out", tmp_path, "--revoke", "operator")
    assert outcome.code == USAGE
    (complaint,) = outcome.complaints
    assert message in complaint


@pytest.mark.parametrize("present", ["ca.key", "plant.crt", "ca.crl", "tls.toml"])
def test_nothing_is_written_where_one_of_the_files_exists(coldloop: "Coldloop", tmp_path: Path, present: str) -> None:
    (tmp_path / present).write_text("precious")
    outcome = coldloop("certificates", "--out", tmp_path)
    assert outcome.code == USAGE
    (complaint,) = outcome.complaints
    assert f"{tmp_path / present} exists: name another folder" in complaint
    assert [path.name for path in tmp_path.iterdir()] == [present]
    assert (tmp_path / present).read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ([], USAGE, "--out"),
        (["--out", "{}/site", "--host", "not a host"], USAGE, "'not a host' is not a host name or an address"),
        (["--out", "{}/site", "--host", "café"], USAGE, "'café' is not a host name or an address"),
        (["--out", "{}/site", "--days", "0"], USAGE, "'0' is not a number of days from 1 to 3650"),
        (["--out", "{}/site", "--days", "-3"], USAGE, "days"),
        (["--out", "{}/file"], USAGE, "{}/file: File exists; choose a folder"),
        (["--out", "{}/file/site"], USAGE, "Not a directory; choose a folder"),
    ],
)
def test_what_is_asked_for_wrongly_is_told_in_one_line(
    coldloop: "Coldloop", tmp_path: Path, arguments: list[str], code: int, message: str
) -> None:
    (tmp_path / "file").write_text("")
    outcome = coldloop("certificates", *[argument.format(tmp_path) for argument in arguments])
    assert outcome.code == code
    (complaint,) = outcome.complaints
    assert message.format(tmp_path) in complaint
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize(
    ("client", "server"),
    [("rig", "plant"), ("control_plc.plant", "plant"), ("optimizer_plc.control_plc", "control_plc")],
)
def test_a_run_whose_client_has_no_certificate_for_its_server_is_refused_at_once(
    coldloop: "Coldloop", tmp_path: Path, client: str, server: str
) -> None:
    coldloop("certificates", "--out", tmp_path / "site")
    sections = (tmp_path / "site" / "tls.toml").read_text().split("\n\n")
    file = tmp_path / "partial.toml"
    file.write_text("\n\n".join(section for section in sections if not section.startswith(f"[{client}.tls]")))
    outcome = coldloop("run", "--config", file, "--duration", "2s", "--out", tmp_path / "run")
    assert outcome.code == USAGE
    (complaint,) = outcome.complaints
    assert f"{client}.tls is not set, and {server}.server.tls is" in complaint
