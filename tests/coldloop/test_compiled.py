"""What is kept in the cache beside compiled kernels."""

import os
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numba
import numpy as np
import pytest

from coldloop.kernels.compiled import kept

if TYPE_CHECKING:
    from tests.harness.processes import Ended, Processes

    Where = Callable[..., Ended]

PATIENCE_S: Final = 120.0
GAINS = np.arange(6.0).reshape(2, 3)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def test_what_was_computed_once_is_read_back_to_the_bit(cache: Path) -> None:
    kept("gains", b"weights", lambda: GAINS)
    found = kept("gains", b"weights", lambda: pytest.fail("it is in the cache"))
    assert np.array_equal(found, GAINS)
    assert np.array_equal(kept("gains", b"other weights", lambda: 2 * GAINS), 2 * GAINS)
    assert len(list(cache.iterdir())) == 2


def test_another_user_reads_it_for_images_are_made_by_root(cache: Path) -> None:
    kept("gains", b"weights", lambda: GAINS)
    (file,) = cache.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o644


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"not an array"])
def test_a_damaged_file_is_computed_anew(cache: Path, content: bytes) -> None:
    kept("gains", b"weights", lambda: GAINS)
    (file,) = cache.iterdir()
    file.write_bytes(content)
    assert np.array_equal(kept("gains", b"weights", lambda: GAINS), GAINS)
    assert np.array_equal(np.load(file), GAINS)


def test_without_a_cache_it_is_computed_each_time(cache: Path) -> None:
    cache.rmdir()
    assert np.array_equal(kept("gains", b"weights", lambda: GAINS), GAINS)


# -- where it is: kernels are loaded as code ---------------------------------------------------------------------------

WHERE = "import numba, coldloop.kernels.compiled; print(numba.config.CACHE_DIR)"


@pytest.fixture
def where(processes: "Processes", tmp_path: Path) -> "Where":
    """Where a process keeps its kernels that has nothing but a folder for temporary files, and these variables."""

    def asked(**variables: str) -> "Ended":
        nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "", "COLDLOOP_CACHE_DIR": "", "TMPDIR": str(tmp_path)}
        pipe = subprocess.PIPE
        return processes.python("-c", WHERE, stdout=pipe, stderr=pipe, more=nowhere | variables).ended(PATIENCE_S)

    return asked


def test_without_a_home_kernels_are_kept_among_the_temporary_files_in_a_folder_of_ones_own(
    where: "Where", tmp_path: Path
) -> None:
    tmp_path.chmod(0o1777)
    folder = Path(where().out.strip())
    assert folder.parent == tmp_path / f"coldloop-cache-{os.getuid()}"
    assert folder == Path(where().out.strip()), "and found again"


@pytest.mark.parametrize("which", ["root", "folder"])
def test_a_folder_that_others_can_write_to_is_not_loaded_from(which: str, where: "Where") -> None:
    folder = Path(where().out.strip())
    open_to_all = folder if which == "folder" else folder.parent
    open_to_all.chmod(0o777)
    other = Path(where().out.strip())
    assert folder.parent not in other.parents
    assert stat.S_IMODE(other.stat().st_mode) == 0o700
    chosen = where(COLDLOOP_CACHE_DIR=str(folder.parent))
    assert chosen.code != 0
    assert "others can write to" in chosen.err


def test_a_folder_of_somebody_else_is_not_loaded_from(where: "Where") -> None:
    if os.getuid() != 0:
        pytest.skip("only an administrator can give folders away")
    folder = Path(where().out.strip())
    os.chown(folder, 12345, 12345)
    assert folder.parent not in Path(where().out.strip()).parents
