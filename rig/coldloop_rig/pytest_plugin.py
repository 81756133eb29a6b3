"""The pytest fixture `coldloop_rigs`, for test suites that say `pytest_plugins = ["coldloop_rig.pytest_plugin"]`."""

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest

from coldloop.kernels.first_use import Kernels, announce_with, write_line
from coldloop_rig.testing import Rigs


@pytest.fixture
def coldloop_rigs(tmp_path: Path, pytestconfig: pytest.Config) -> Iterator[Rigs]:
    """Starts rigs of three services on localhost with `coldloop_rigs.up()`; they are stopped when the test ends."""
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")

    def shown(*kernels: Kernels) -> None:
        with capture.global_and_fixture_disabled() if capture else nullcontext():
            write_line(*kernels)  # of minutes in which nothing else is seen

    announce_with(shown)
    with Rigs(tmp_path) as rigs:
        yield rigs
