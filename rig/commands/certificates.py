"""`coldloop certificates`: certificates for Modbus/TCP Security on a test site, and configuration for them.

It also revokes certificates that it has made, by the list of revocations that the configuration names.
"""

import argparse
import json
import os
import re
import sys
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from coldloop.errors import ResultsError, UsageError
from coldloop.registers.declaration import Role
from rig.certificates import Authority, Pair, revoked_now
from rig.wiring import SERVICES

CLIENTS = {**{role.value: role.value for role in Role}, "reader": None}
"""Clients and their roles."""
CONFIGURATION = "tls.toml"
REVOCATIONS = "ca.crl"
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


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    parser.add_argument("--host", dest="hosts", action="append", default=[], type=_host, metavar="NAME",
                        help="another name or address of the servers, besides localhost; may be repeated")  # fmt: skip
    parser.add_argument("--days", type=_days, default=365, help="days until they expire (default: 365)")
    parser.add_argument("--revoke", action="append", default=[], metavar="NAME",
                        help="revoke a certificate in the folder, such as operator; may be repeated")  # fmt: skip
    parser.add_argument("--renew-list", action="store_true", help="make the list of revoked certificates anew")
    parser.set_defaults(execute=execute)


def _host(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.:_-]{0,251}[A-Za-z0-9])?|::1?", text):
        raise argparse.ArgumentTypeError(f"'{text}' is not a host name or an address")
    return text


def _days(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 3650:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of days from 1 to 3650")
    return int(text)


def execute(options: argparse.Namespace) -> int:
    """Make certificates, or revoke some that have been made."""
    if options.revoke or options.renew_list:
        return _revoke(options.out, options.revoke, options.days)
    return _make(options)


def _make(options: argparse.Namespace) -> int:
    """Write all files, or none where one of them exists."""
    out: Path = options.out
    authority = Authority.new("Coldloop test CA", options.days)
    pairs = {"ca": authority.pair}
    pairs |= {name: authority.issue_server(name, [*LOCAL, *options.hosts]) for name in SERVICES}
    pairs |= {name: authority.issue_client(name, role) for name, role in CLIENTS.items()}
    present = [name for name in _names(pairs) if (out / name).exists()]
    if present:
        raise UsageError(f"{out / present[0]} exists: name another folder with --out, or remove the old files")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, pair in pairs.items():
            _write(out / f"{name}.crt", pair.certificate_pem, 0o644)
            _write(out / f"{name}.key", pair.key_pem, 0o600)
        _write(out / REVOCATIONS, authority.revocation_list([], options.days), 0o644)
        _write(out / CONFIGURATION, _configuration(out.resolve()).encode(), 0o644)
    except OSError as error:
        raise ResultsError(f"{error.filename or out}: {error.strerror}; choose another --out") from None
    sys.stdout.write(
        f"{len(pairs)} certificates and their keys in {out}; use them with --config {out / CONFIGURATION}\n"
    )
    return 0


def _revoke(out: Path, names: list[str], days: int) -> int:
    """Write the list of revoked certificates anew, with these added."""
    authority = Authority(Pair(_certificate(out / "ca.crt"), _key(out / "ca.key")))
    try:
        revoked = list(x509.load_pem_x509_crl((out / REVOCATIONS).read_bytes()))
    except (OSError, ValueError) as error:
        raise UsageError(f"{out / REVOCATIONS}: {error}; name the folder of `coldloop certificates`") from None
    present = {each.serial_number for each in revoked}
    certificates = [_certificate(out / f"{name}.crt") for name in names]
    revoked += [revoked_now(each) for each in certificates if each.serial_number not in present]
    fresh = out / f"{REVOCATIONS}.new"
    try:
        fresh.write_bytes(authority.revocation_list(revoked, days))
        fresh.replace(out / REVOCATIONS)
    except OSError as error:
        raise ResultsError(f"{error.filename or out}: {error.strerror}; choose another --out") from None
    sys.stdout.write(f"{len(revoked)} revoked in {out / REVOCATIONS}; restart the services that use it\n")
    return 0


def _certificate(file: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except (OSError, ValueError) as error:
        raise UsageError(f"{file}: {error}; name a certificate that `coldloop certificates` has made") from None


def _key(file: Path) -> ec.EllipticCurvePrivateKey:
    try:
        key = load_pem_private_key(file.read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"{file}: {error}; the key of the authority is needed to revoke") from None
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
