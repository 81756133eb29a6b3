"""Short runs that studies are made of, and workers to do them."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from distributed import Client

from rig.studies.execution import Store, Workers
from rig.studies.request import RunRequest
from rig.studies.study import StudyOptions, draw_of

Requests = Callable[[int], list[RunRequest]]

TICKS = 120


@pytest.fixture(scope="session")
def requests() -> Requests:
    """Return so many different runs of half a minute."""

    def make(number: int) -> list[RunRequest]:
        load = draw_of("e", 1, StudyOptions(ticks=TICKS))
        return [load.request(0.5 + 0.25 * i) for i in range(number)]

    return make


@pytest.fixture
def store(tmp_path: Path) -> Store:
    (tmp_path / "runs").mkdir()
    return Store(tmp_path / "runs")


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """Two workers."""
    with Workers(2).connected() as client:
        yield client


@pytest.fixture(scope="module")
def running(client: Client) -> Workers:
    """The same two workers, for whoever names their scheduler."""
    return Workers(1, scheduler=client.scheduler.address)
