"""The folder of the cache, and what is kept there beside compiled kernels."""

import os
import shutil
import stat
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.kernels import compiled
from coldloop.kernels.cache import DAY_S, KEPT_DAYS, LOCKS, TIDIED, CacheFolder
from coldloop.kernels.compiled import kept

if TYPE_CHECKING:
    from tests.harness.processes import Ended, Processes

    Where = Callable[..., Ended]

PATIENCE_S: Final = 120.0
GAINS = np.arange(6.0).reshape(2, 3)

computed: list[float] = []


def gains(weight: float) -> NDArray[np.float64]:
    computed.append(weight)
    return weight * GAINS


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(compiled, "cache_folder", CacheFolder(tmp_path))
    computed.clear()
    return tmp_path


def files(cache: Path) -> list[Path]:
    return [file for file in cache.iterdir() if file.name not in {LOCKS, TIDIED}]


def test_what_was_computed_once_is_read_back_to_the_bit(cache: Path) -> None:
    for _ in range(2):
        assert np.array_equal(kept("gains", gains, 1.0), GAINS)
        assert np.array_equal(kept("gains", gains, 2.0), 2.0 * GAINS)
    assert computed == [1.0, 2.0]
    assert len(files(cache)) == 2


@pytest.mark.usefixtures("cache")
def test_what_another_function_computes_is_kept_apart() -> None:
    assert np.array_equal(kept("gains", gains, 1.0), GAINS)
    assert np.array_equal(kept("gains", lambda weight: weight + GAINS, 1.0), 1.0 + GAINS)


def test_another_user_reads_it_for_images_are_made_by_root(cache: Path) -> None:
    kept("gains", gains, 1.0)
    (file,) = files(cache)
    assert stat.S_IMODE(file.stat().st_mode) == 0o644


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"not an array"])
def test_a_damaged_file_is_computed_anew(cache: Path, content: bytes) -> None:
    kept("gains", gains, 1.0)
    (file,) = files(cache)
    whole = file.read_bytes()
    file.write_bytes(content)
    assert np.array_equal(kept("gains", gains, 1.0), GAINS)
    assert len(computed) == 2
    assert file.read_bytes() == whole


def test_a_file_with_a_bit_that_has_changed_is_computed_anew(cache: Path) -> None:
    kept("gains", gains, 1.0)
    (file,) = files(cache)
    whole = bytearray(file.read_bytes())
    whole[-1] ^= 1
    file.write_bytes(whole)
    assert np.array_equal(kept("gains", gains, 1.0), GAINS)


def test_without_a_cache_it_is_computed_each_time(cache: Path) -> None:
    shutil.rmtree(cache)
    for _ in range(2):
        assert np.array_equal(kept("gains", gains, 1.0), GAINS)
    assert len(computed) == 2


def age(path: Path, days: float) -> None:
    then = time.time() - days * DAY_S
    os.utime(path, (then, then))


def test_what_nobody_has_used_for_long_is_deleted_once_a_day(cache: Path) -> None:
    folder, root = CacheFolder(cache / "kernels"), cache
    folder.path.mkdir()
    of_older_version = root / "kernels-0123456789abcdef"
    (of_older_version / "module").mkdir(parents=True)
    (root / "kernels-of-mine").mkdir()
    folder.write("used", b"1")
    folder.write("unused", b"2")
    for path in (folder.path / "used", folder.path / "unused", of_older_version, root / "kernels-of-mine"):
        age(path, KEPT_DAYS + 1)
    assert folder.read("used") == b"1"
    folder.write("another", b"3")
    assert folder.read("unused") == b"2", "not on the same day"
    age(folder.path / "unused", KEPT_DAYS + 1)
    age(folder.path / TIDIED, 2)
    folder.write("another", b"3")
    assert {path.name for path in files(folder.path)} == {"used", "another"}
    assert not of_older_version.exists()
    assert (root / "kernels-of-mine").exists()


# -- where it is: kernels are loaded as code ---------------------------------------------------------------------------

WHERE = "from coldloop.kernels.compiled import cache_folder; print(cache_folder.path)"


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
