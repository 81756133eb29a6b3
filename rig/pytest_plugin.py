"""The pytest fixture `coldloop_rigs`, for test suites that say `pytest_plugins = ["rig.pytest_plugin"]`."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from rig.testing import Rigs


@pytest.fixture
def coldloop_rigs(tmp_path: Path) -> Iterator[Rigs]:
    """Starts rigs of three services on localhost with `coldloop_rigs.up()`; they are stopped when the test ends."""
    with Rigs(tmp_path) as rigs:
        yield rigs
