"""The archive of an FMU, unpacked within bounds: a small file may hold gigabytes of zeros."""

import shutil
import tempfile
import weakref
import zipfile
from pathlib import Path
from typing import Final

from coldloop.errors import ModelFileError
from coldloop.foreign import foreign

MOST_UNPACKED: Final = 512 * 1024 * 1024
"""Bytes of all members."""
CHUNK: Final = 1 << 20


def unpacked(path: Path, owner: object, most: int = MOST_UNPACKED) -> str:
    """Return a temporary folder with the members of an archive, which is deleted with its owner.

    Raises:
        ModelFileError: It is no archive, a member is damaged, it holds too much, or there is no space for it.
    """
    with foreign(f"{path}: not a readable FMU", "get it anew from where it comes from"):
        try:
            folder = tempfile.mkdtemp(prefix="coldloop-fmu-")
            weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
            with zipfile.ZipFile(path) as archive:
                left = most - sum(one.file_size for one in archive.infolist())
                for one in archive.infolist() if left >= 0 else ():
                    left = _unpack(archive, one, Path(folder), left + one.file_size)
        except OSError as error:
            raise ModelFileError(
                f"{path}: cannot be unpacked into {tempfile.gettempdir()}: {error.strerror or error}; free space "
                "there, or set TMPDIR to another folder"
            ) from error
    if left < 0:
        raise ModelFileError(f"{path}: unpacks to more than {most // 2**20} MiB; get one without its documentation")
    return folder


def _unpack(archive: zipfile.ZipFile, member: zipfile.ZipInfo, folder: Path, left: int) -> int:
    """Write a member; return what is left of as many bytes as it and others may have, less than 0 beyond them."""
    name = Path(member.filename.replace("\\", "/"))
    if name.is_absolute() or ".." in name.parts or ":" in member.filename:
        raise ValueError(f"the member {member.filename!r} is outside the archive")
    if member.is_dir():
        (folder / name).mkdir(parents=True, exist_ok=True)
        return left
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    with archive.open(member) as source, (folder / name).open("wb") as target:
        while left >= 0 and (data := source.read(CHUNK)):
            left -= len(data)
            target.write(data)
    return left
