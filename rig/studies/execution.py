"""How the runs of a study are done: by Dask workers, each run once, what is done already being read back.

Results do not depend on the number of workers: a run is a function of its request. A worker that dies costs only the
runs it had in hand, which others do again; a study that is stopped goes on where it was.
"""

import contextlib
import logging
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from distributed import Client, LocalCluster, as_completed
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from coldloop.errors import ColdloopError, ResultsError, StudyError, UsageError
from rig.interruption import INTERRUPTION
from rig.progress import make_console
from rig.results import whole_file
from rig.studies.request import Outcome, RunRequest, perform, programs_digest

CONNECT_PATIENCE_S = 10


@dataclass(frozen=True)
class Workers:
    """Who does the runs."""

    count: int
    """Workers of a local cluster; its runs share nothing."""
    scheduler: str | None = None
    """Address of a Dask scheduler that exists, instead."""

    @contextlib.contextmanager
    def connected(self) -> Iterator[Client]:
        """Connect to the workers for a while.

        Raises:
            UsageError: The scheduler does not answer.
        """
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # its import has set it to INFO
        with contextlib.ExitStack() as stack:
            address: str | LocalCluster
            if self.scheduler is None:
                address = stack.enter_context(
                    LocalCluster(  # type: ignore[no-untyped-call]
                        n_workers=self.count, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0",
                        memory_limit=0, silence_logs=50,
                    )
                )  # fmt: skip
            else:
                address = self.scheduler
            try:
                client = stack.enter_context(Client(address, timeout=CONNECT_PATIENCE_S))  # type: ignore[no-untyped-call]
            except (OSError, ValueError) as error:
                reason = _first_line(error)
                raise UsageError(f"--scheduler {self.scheduler}: {reason}; name one that is up") from None
            yield client


class Store:
    """Outcomes by the digest of their request, a file each, whole or not at all."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def path(self, request: RunRequest) -> Path:
        """Return where an outcome is kept."""
        return self._folder / f"{request.digest}.json"

    def find(self, request: RunRequest) -> Outcome | None:
        """Return the outcome of a request if it is there and sound."""
        try:
            return Outcome.from_json(self.path(request).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def keep(self, request: RunRequest, outcome: str) -> None:
        """Keep an outcome."""
        path = self.path(request)
        try:
            whole_file(path, lambda draft: draft.write_text(outcome, encoding="utf-8"))
        except OSError as error:
            raise ResultsError(f"{path}: {error.strerror}; choose another --out") from None


def perform_all(
    requests: Sequence[RunRequest], store: Store, workers: Workers, title: str
) -> dict[RunRequest, Outcome]:
    """Return the outcome of every request.

    Raises:
        StudyError: A run failed, or a worker runs other programs than we do.
    """
    known = {request: store.find(request) for request in dict.fromkeys(requests)}
    missing = [request for request, outcome in known.items() if outcome is None]
    if missing:
        with workers.connected() as client, INTERRUPTION.passed_to(_end_workers), _bar(title, len(known)) as bar:
            bar.advance(bar.task_ids[0], len(known) - len(missing))
            for request, text in _done(client, missing):
                outcome = known[request] = Outcome.from_json(text)
                if outcome.programs != programs_digest():
                    raise StudyError("a worker runs another version of Coldloop: install the same on all workers")
                store.keep(request, text)
                bar.advance(bar.task_ids[0])
    return {request: outcome for request, outcome in known.items() if outcome is not None}


def _end_workers(_: signal.Signals) -> None:
    """Unwind, so that the workers of a local cluster end; this thread only waits for them."""
    raise KeyboardInterrupt


def _done(client: Client, requests: Sequence[RunRequest]) -> Iterator[tuple[RunRequest, str]]:
    """Yield each request with its outcome as it is done."""
    futures = {client.submit(perform, request, key=f"run-{request.digest}"): request for request in requests}
    for future in as_completed(futures):  # type: ignore[no-untyped-call]
        request = futures[future]
        error = future.exception()
        if isinstance(error, ColdloopError):
            raise error
        if error is not None:
            reason = _first_line(error)
            raise StudyError(f"a run under load {request.load} failed: {reason}; what was done before is kept")
        yield request, future.result()
        future.release()


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


@contextlib.contextmanager
def _bar(title: str, total: int) -> Iterator[Progress]:
    columns = (
        TextColumn("{task.description}"), BarColumn(bar_width=32), MofNCompleteColumn(), TextColumn("runs"),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=make_console(), refresh_per_second=2) as bar:
        bar.add_task(title, total=total)
        yield bar
