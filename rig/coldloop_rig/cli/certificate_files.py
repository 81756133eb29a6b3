"""The files of a test site with Modbus/TCP Security: certificates, keys, revocations, configuration that names them."""

import json
import os
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from coldloop.errors import ResultsError, UsageError
from coldloop.registers.declaration import Role
from coldloop.text_file import read_bytes
from coldloop.whole_file import whole_file
from coldloop_rig.cli.certificates import Authority, Pair, revoked_now
from coldloop_rig.cosim.wiring import SERVICES
from coldloop_rig.results.folders import prepare_folder, writing

CLIENTS = {**{role.value: role.value for role in Role}, "reader": None}
"""Clients and their roles."""
CONFIGURATION = "tls.toml"
REVOCATIONS = "ca.crl"
OURS = "name the folder of `coldloop certificates`"
MADE = "name a certificate that `coldloop certificates` has made"
KEY = "the key of the authority is needed to revoke"
LOCAL = ("localhost", "127.0.0.1")
OWNERS = {
    "plant.server.tls": "plant",
    "control_plc.server.tls": "control_plc",
    "optimizer_plc.server.tls": "optimizer_plc",
    "control_plc.plant.tls": "control",
    "optimizer_plc.control_plc.tls": "optimizer",
    "rig.tls": "operator",
}
"""Sections of the configuration, and whose certificate goes there."""


def write_site(out: Path, hosts: Sequence[str], days: int) -> tuple[int, Path]:
    """Write all files, or none where one of them exists; return the number of certificates and the configuration file.

    Raises:
        UsageError: A file exists, or the folder cannot be written to.
        ResultsError: A file cannot be written.
    """
    authority = Authority.new("Coldloop test CA", days)
    pairs = {"ca": authority.pair}
    pairs |= {name: authority.issue_server(name, [*LOCAL, *hosts]) for name in SERVICES}
    pairs |= {name: authority.issue_client(name, role) for name, role in CLIENTS.items()}
    present = [name for name in _names(pairs) if (out / name).exists()]
    if present:
        raise UsageError(f"{out / present[0]} exists: name another folder with --out, or remove the old files")
    prepare_folder(out)
    try:
        for name, pair in pairs.items():
            _write(out / f"{name}.crt", pair.certificate_pem, 0o644)
            _write(out / f"{name}.key", pair.key_pem, 0o600)
        _write(out / REVOCATIONS, authority.revocation_list([], days), 0o644)
        _write(out / CONFIGURATION, _configuration(out.resolve()).encode(), 0o644)
    except OSError as error:
        raise ResultsError(f"{error.filename or out}: {error.strerror}; choose another --out") from None
    return len(pairs), out / CONFIGURATION


def revoke(out: Path, names: Sequence[str], days: int) -> tuple[int, Path]:
    """Rewrite the list of revoked certificates with these added; return how many it has, and its file.

    Raises:
        UsageError: The folder has no such certificate, list or key of the authority.
        ResultsError: The list cannot be written.
    """
    authority = Authority(Pair(_certificate(out / "ca.crt"), _key(out / "ca.key")))
    try:
        revoked = list(x509.load_pem_x509_crl(read_bytes(out / REVOCATIONS, OURS)))
    except ValueError as error:
        raise UsageError(f"{out / REVOCATIONS}: {error}; {OURS}") from None
    present = {each.serial_number for each in revoked}
    certificates = [_certificate(out / f"{name}.crt") for name in names]
    revoked += [revoked_now(each) for each in certificates if each.serial_number not in present]
    with writing(out / REVOCATIONS):
        fresh = authority.revocation_list(revoked, days)
        whole_file(out / REVOCATIONS, lambda draft: draft.write_bytes(fresh))
    return len(revoked), out / REVOCATIONS


def _certificate(file: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(read_bytes(file, MADE))
    except ValueError as error:
        raise UsageError(f"{file}: {error}; {MADE}") from None


def _key(file: Path) -> ec.EllipticCurvePrivateKey:
    try:
        key = load_pem_private_key(read_bytes(file, KEY), password=None)
    except (ValueError, TypeError) as error:
        raise UsageError(f"{file}: {error}; {KEY}") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UsageError(f"{file}: not a key that `coldloop certificates` has made")
    return key


def _names(pairs: dict[str, Pair]) -> list[str]:
    return [*[f"{name}.{kind}" for name in pairs for kind in ("crt", "key")], REVOCATIONS, CONFIGURATION]


def _write(file: Path, data: bytes, mode: int) -> None:
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)  # a key is private from the start
    with os.fdopen(descriptor, "wb") as stream:
        stream.write(data)


def _configuration(folder: Path) -> str:
    lines = ["# Made by `coldloop certificates`: Modbus/TCP Security on all three servers."]
    for section, owner in OWNERS.items():
        files = {"certificate": f"{owner}.crt", "key": f"{owner}.key", "ca": "ca.crt", "crl": REVOCATIONS}
        lines += ["", f"[{section}]"]
        lines += [f"{key} = {json.dumps(str(folder / name), ensure_ascii=False)}" for key, name in files.items()]
    return "\n".join(lines) + "\n"
