"""The exported Structured Text compiled by MATIEC, where that is installed: its self-test passes in native code."""

from pathlib import Path

import pytest

from coldloop_export.golden import GoldenVectors
from coldloop_export.st_files import StructuredTextExport
from tests.plc_export.matiec import NEEDS_MATIEC, self_test


@NEEDS_MATIEC
@pytest.mark.parametrize("level", ["-O0", "-O2"])
def test_the_self_test_passes_in_native_code(recorded: GoldenVectors, tmp_path: Path, level: str) -> None:
    texts = StructuredTextExport(recorded.method, recorded.vectors).files()
    assert self_test(tmp_path, texts.values(), level) == "1 1 0"
