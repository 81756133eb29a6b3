"""Users of the page, their roles and the hashes of their passwords.

`python -m coldloop_hmi.users FILE NAME view|operate` asks for a password, or reads it from standard input, and writes
a line.
"""

import argparse
import base64
import getpass
import hashlib
import hmac
import secrets
import stat
import sys
from enum import StrEnum
from pathlib import Path
from typing import Final, NamedTuple

from coldloop.errors import ColdloopError, ConfigurationError, UsageError
from coldloop.text_file import read_text

COST: Final = 2**14
BLOCK_SIZE: Final = 8
SALT_BYTES: Final = 16
DIGEST_BYTES: Final = 32
SHORTEST_PASSWORD: Final = 8
HASH_FIELDS: Final = 5
MOST_MEMORY: Final = 64 * 1024 * 1024
COSTS: Final = range(10, 17)
BLOCK_SIZES: Final = range(1, 17)
"""Of hashes: cost as a power of 2, and block size. The largest take the memory above and half a second."""
COMMENT: Final = "#"


class PageRole(StrEnum):
    """What a user may do."""

    VIEW = "view"
    OPERATE = "operate"


class User(NamedTuple):
    """One line of the file."""

    name: str
    role: PageRole
    hash: str


def hash_password(password: str) -> str:
    """Return `scrypt$cost$block size$salt$hash` of a password."""
    salt = secrets.token_bytes(SALT_BYTES)
    digest = _scrypt(password, salt, COST, BLOCK_SIZE)
    return f"scrypt${COST}${BLOCK_SIZE}${_text(salt)}${_text(digest)}"


def is_password(password: str, stored: str) -> bool:
    """Return whether a password has this hash."""
    _, cost, block_size, salt, digest = stored.split("$")
    found = _scrypt(password, base64.b64decode(salt), int(cost), int(block_size))
    return hmac.compare_digest(found, base64.b64decode(digest))


def _scrypt(password: str, salt: bytes, cost: int, block_size: int) -> bytes:
    return hashlib.scrypt(
        password.encode(errors="surrogatepass"),
        salt=salt,
        n=cost,
        r=block_size,
        p=1,
        maxmem=MOST_MEMORY,
        dklen=DIGEST_BYTES,
    )


def _text(raw: bytes) -> str:
    return base64.b64encode(raw).decode("ascii")


NOBODYS_HASH: Final = hash_password(secrets.token_urlsafe())
"""Checked for a name that does not exist, so that the answer takes as long."""


class Users:
    """The users of a file; without a file there are none.

    Raises:
        ConfigurationError: The file cannot be read, everybody may write to it, or a line is wrong.
    """

    def __init__(self, file: Path | None) -> None:
        self._users: dict[str, User] = {}
        if file is None:
            return
        try:
            lines = _lines(file)
            mode, folder = file.stat().st_mode, file.resolve().parent.stat().st_mode
        except (OSError, UsageError) as error:
            raise ConfigurationError(f"hmi.login.users: {error}") from None
        for path, bits in ((file, mode), (file.parent, folder)):
            if bits & (stat.S_IWOTH | stat.S_IWGRP) and not bits & stat.S_ISVTX:
                raise ConfigurationError(f"hmi.login.users: {path}: others can write to it; `chmod go-w {path}`")
        for number, line in enumerate(lines, 1):
            if line.strip() and not line.startswith(COMMENT):
                user = _user(line, f"{file}:{number}")
                if user.name in self._users:
                    raise ConfigurationError(
                        f"hmi.login.users: {file}:{number}: a second line of {user.name}; keep one"
                    )
                self._users[user.name] = user

    def __len__(self) -> int:
        return len(self._users)

    def check(self, name: str, password: str) -> User | None:
        """Return the user with this password; None when there is none. Takes a twentieth of a second."""
        user = self._users.get(name)
        right = is_password(password, user.hash if user else NOBODYS_HASH)
        return user if right else None


def _lines(file: Path) -> list[str]:
    return read_text(file, f"`python -m coldloop_hmi.users {file} NAME operate` writes it").splitlines()


def _user(line: str, place: str) -> User:
    name, _, rest = line.partition(":")
    role, _, stored = rest.partition(":")
    if not name or role not in set(PageRole) or not _is_hash(stored.strip()):
        raise ConfigurationError(
            f"hmi.login.users: {place}: not name:role:hash; "
            "`python -m coldloop_hmi.users FILE NAME view|operate` writes such lines"
        )
    return User(name, PageRole(role), stored.strip())


def _is_hash(stored: str) -> bool:
    """Return whether a password can be compared with this hash: it is whole, and of a usual cost."""
    fields = stored.split("$")
    if len(fields) != HASH_FIELDS or fields[0] != "scrypt" or not (fields[1] + fields[2]).isdecimal():
        return False
    try:
        salt, digest = (base64.b64decode(field, validate=True) for field in fields[3:])
        cost, block_size = int(fields[1]), int(fields[2])
    except ValueError:
        return False
    costs = [2**power for power in COSTS if 128 * 2**power * block_size < MOST_MEMORY]
    return cost in costs and block_size in BLOCK_SIZES and len(salt) > 0 and len(digest) == DIGEST_BYTES


def write_user(file: Path, name: str, role: PageRole, password: str) -> None:
    """Write a user's line, in the place of an earlier one of the same name; the file is readable by its owner only.

    Raises:
        UsageError: The name or the password cannot be used, or the file cannot be written.
    """
    if not name or name.startswith(COMMENT) or ":" in name or not name.isprintable():
        raise UsageError(f"user '{name}': a name is printable text without a colon, and does not begin with #")
    if len(password) < SHORTEST_PASSWORD:
        raise UsageError(f"user '{name}': a password has {SHORTEST_PASSWORD} characters or more")
    try:
        lines = _lines(file) if file.exists() else []
        kept = [line for line in lines if line.partition(":")[0] != name]
        file.touch(mode=0o600)
        file.chmod(0o600)
        file.write_text("\n".join([*kept, f"{name}:{role.value}:{hash_password(password)}"]) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror}") from None


def main() -> int:
    """Write a user's line; return the exit code."""
    parser = argparse.ArgumentParser(
        "python -m coldloop_hmi.users", description="Add a user of the page.", allow_abbrev=False
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("name")
    parser.add_argument("role", choices=[role.value for role in PageRole])
    options = parser.parse_args()
    try:
        if sys.stdin.isatty():
            password = getpass.getpass(f"password of {options.name}: ")
        else:
            password = sys.stdin.readline().removeprefix("\ufeff").rstrip("\r\n")
        write_user(options.file, options.name, PageRole(options.role), password)
    except ColdloopError as error:
        sys.stderr.write(f"hmi.users: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{options.file}: user {options.name} may {options.role}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
