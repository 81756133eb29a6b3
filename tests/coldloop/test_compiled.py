"""What is kept in the cache beside compiled kernels."""

import stat
from pathlib import Path

import numba
import numpy as np
import pytest

from coldloop.kernels.compiled import kept

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
