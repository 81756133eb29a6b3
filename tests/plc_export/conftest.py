"""Problems that the tests of the export have in common."""

import pytest

from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_export.golden import GoldenVectors, paper_settings, record


@pytest.fixture(scope="package")
def recorded() -> GoldenVectors:
    """The most telling problems of a short run."""
    found = record(paper_settings(DEFAULT_MODEL_FILE))
    return found._replace(vectors=found.telling())
