"""Short runs that studies are made of, and workers to do them."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import pytest
from distributed import Client

from coldloop_rig.results.recording import Indicators
from coldloop_studies.execution import Store, Workers, conduct
from coldloop_studies.request import UPDATE_COLUMNS, Outcome, RunRequest, perform
from coldloop_studies.study import RUNS, Load, Study, StudyOptions, StudyResult, draw_of

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


@pytest.fixture(scope="session")
def client(programs: None) -> Iterator[Client]:  # noqa: ARG001 a mark
    """Two workers, in processes of their own; they are the same ones for all tests.

    Dask silences the handlers of its loggers as long as they are there: pytest's are among them, and of all loggers.
    """
    levels = {handler: handler.level for handler in logging.getLogger().handlers}
    with Workers(2).connected() as client:
        for handler, level in levels.items():
            handler.setLevel(level)
        yield client


@pytest.fixture(scope="session")
def running(client: Client) -> Workers:
    """The same two workers, for whoever names their scheduler."""
    return Workers(1, scheduler=client.scheduler.address)


NOBODY = Workers(1, scheduler="tcp://127.0.0.1:1")
"""No run is left for them."""
Conducted = Callable[[Study, StudyOptions], StudyResult]


@pytest.fixture
def conducted(tmp_path: Path) -> Conducted:
    """Conduct a study whose runs were done in this process; its files are in `tmp_path`."""

    def conduct_here(study: Study, options: StudyOptions) -> StudyResult:
        (tmp_path / RUNS).mkdir()
        store = Store(tmp_path / RUNS)
        for request in study.requests(options):
            store.keep(request, perform(request))
        return conduct(study, options, NOBODY, tmp_path)

    return conduct_here


# -- outcomes that no run has given, to judge by hand ----------------------------------------------------------------

MakeOutcome = Callable[..., Outcome]


NOTHING: Final = Indicators(*[0.0] * 8, 0, {"L1": 0.0, "T5": 0.0})


@pytest.fixture(scope="session")
def made_up() -> MakeOutcome:
    """Return an outcome with these columns of updates and of the trace; all indicators are 0 but those named."""

    def make(
        updates: Mapping[str, Sequence[float]] | None = None,
        trace: Mapping[str, Sequence[float]] | None = None,
        sha: str = "",
        **named: object,
    ) -> Outcome:
        indicators = NOTHING._replace(**named)  # type: ignore[arg-type]
        columns = {name: [float(value) for value in values] for name, values in (updates or {}).items()}
        length = len(next(iter(columns.values()), ()))
        columns = {name: columns.get(name, [0.0] * length) for name in UPDATE_COLUMNS} | columns
        series = {name: [float(value) for value in values] for name, values in (trace or {}).items()}
        return Outcome("", indicators, sha, 0, columns, series)

    return make


@pytest.fixture
def stepped(tmp_path: Path) -> Load:
    """A load of ten minutes that steps up at 100 s and down at 400 s, ticks 400 and 1600."""
    file = tmp_path / "stepped.csv"
    file.write_text("time_s,load_w\n0,385\n100,445\n400,385\n")
    return draw_of(str(file), 1, StudyOptions(seeds=1, ticks=2400))


@pytest.fixture
def under(stepped: Load) -> StudyOptions:
    """A quick study under that load alone."""
    return StudyOptions(loads=(stepped.name,), ticks=2400, quick=True)
