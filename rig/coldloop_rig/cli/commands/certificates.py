"""`coldloop certificates`: certificates for Modbus/TCP Security on a test site, and configuration for them.

It also revokes certificates that it has made, by the list of revocations that the configuration names.
"""

import argparse
import re
import sys

from coldloop.errors import UsageError


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", type="into", required=True, metavar="DIR", help="folder for the files")
    parser.add_argument("--host", dest="hosts", action="append", default=[], type=_host, metavar="NAME",
                        help="another name or address of the servers, besides localhost; may be repeated")  # fmt: skip
    parser.add_argument("--days", type=_days, default=365, help="days until they expire (default: 365)")
    parser.add_argument("--revoke", action="append", default=[], metavar="NAME",
                        help="revoke a certificate in the folder, such as operator; may be repeated")  # fmt: skip
    parser.add_argument("--renew-list", action="store_true", help="renew the list of revoked certificates")


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
    from coldloop_rig.cli.certificate_files import revoke, write_site

    if options.revoke or options.renew_list:
        if options.hosts:
            raise UsageError(
                f"--host {options.hosts[0]}: has no effect on a list of revoked certificates; for another host make "
                "certificates in another folder"
            )
        count, file = revoke(options.out, options.revoke, options.days)
        sys.stdout.write(f"{count} revoked in {file}; restart the services that use it\n")
        return 0
    count, file = write_site(options.out, options.hosts, options.days)
    sys.stdout.write(f"{count} certificates and their keys in {options.out}; use them with --config {file}\n")
    return 0
