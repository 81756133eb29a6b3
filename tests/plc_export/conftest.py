"""Problems that the tests of the export have in common."""

import pytest

from rig.plc_export.recorded_problems import GoldenVectors, record

MINUTE = 240


@pytest.fixture(scope="package")
def minute() -> GoldenVectors:
    """The problems of a minute of load a."""
    return record(MINUTE)
