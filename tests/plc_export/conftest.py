"""Problems that the tests of the export have in common."""

import pytest

from rig.plc_export.kernels.recorded_problems import GoldenVectors, record


@pytest.fixture(scope="package")
def recorded() -> GoldenVectors:
    """The most telling problems of a short run."""
    found = record()
    return found._replace(vectors=found.telling())
