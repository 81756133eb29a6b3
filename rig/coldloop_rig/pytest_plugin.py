"""The pytest fixture `coldloop_rigs`, for test suites that say `pytest_plugins = ["coldloop_rig.pytest_plugin"]`."""

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest

from coldloop.kernels.cache import Kernels, announce_with, write_line
from coldloop_rig.testing import Rigs


@pytest.fixture
def coldloop_rigs(tmp_path: Path, pytestconfig: pytest.Config) -> Iterator[Rigs]:
    """Starts rigs of three services on localhost with `coldloop_rigs.up()`; they are stopped when the test ends.

    Example:
        def test_plant_time(coldloop_rigs):
            rig = coldloop_rigs.up(load="a", updating_period=2.5)
            assert rig.advance(15) == 15
    """
    capture = pytestconfig.pluginmanager.getplugin("capturemanager")

    def shown(*kernels: Kernels) -> None:
        with capture.global_and_fixture_disabled() if capture else nullcontext():
            write_line(*kernels)  # compiling takes minutes without other output

    announce_with(shown)
    with Rigs(tmp_path) as rigs:
        yield rigs
