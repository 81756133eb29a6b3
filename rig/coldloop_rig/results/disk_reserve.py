"""Space on the disk that is kept for ending a run in good order."""

import errno
import os
import tempfile
from pathlib import Path
from typing import BinaryIO, Final

from coldloop.errors import UsageError

RESERVED_BYTES: Final = 24 * 1024**2
"""A row group of the trace (9 MB), the index of 1,000 h (4 MB), the summary and the figures."""
FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class DiskReserve:
    """An invisible file of `RESERVED_BYTES`, which the system frees at the latest when the program ends.

    Raises:
        UsageError: There is less free space than that.
    """

    def __init__(self, folder: Path) -> None:
        self._file: BinaryIO | None = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self.released = False
        try:
            os.posix_fallocate(self._file.fileno(), 0, RESERVED_BYTES)
        except AttributeError:  # not on every platform
            self.close()
        except OSError as error:
            self.close()
            if error.errno in FULL:
                raise UsageError(f"{folder}: less than {RESERVED_BYTES >> 20} MB free; choose another --out") from None

    def release(self) -> None:
        """Release the space: the disk is full otherwise."""
        self.released = True
        self.close()

    def close(self) -> None:
        """Release the space at the end of a run."""
        if self._file is not None:
            self._file.close()
            self._file = None


class ReservedFile:
    """A file for writing that draws on a reserve when the disk is full."""

    def __init__(self, path: Path, reserve: DiskReserve) -> None:
        self._file = path.open("wb", buffering=0)
        self._reserve = reserve

    def write(self, data: bytes) -> int:
        """Write all of `data`.

        Raises:
            OSError: It cannot be written, not even with the reserve.
        """
        rest = memoryview(data).cast("B")
        while rest:
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                if error.errno not in FULL or self._reserve.released:
                    raise
                self._reserve.release()
        return len(data)

    def tell(self) -> int:
        """Return the position."""
        return self._file.tell()

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._file.closed
