"""The plugin that pytest finds where Coldloop is installed: the fixture `coldloop_rigs`.

It is imported by every run of pytest there, so it imports the rig only when a test wants one.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rig.testing import Rigs


@pytest.fixture
def coldloop_rigs(tmp_path: Path) -> "Iterator[Rigs]":
    """Starts rigs of three services on localhost with `coldloop_rigs.up()`; they are stopped when the test ends."""
    from rig.testing import Rigs  # noqa: PLC0415

    with Rigs(tmp_path) as rigs:
        yield rigs
