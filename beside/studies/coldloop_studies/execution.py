"""A study done: its runs by Dask workers, each once; its table, figures and section of the report; or its shards.

Results do not depend on the number of workers: a run is a function of its request. A worker that dies costs only the
runs it had in hand, which others do again; a stopped study resumes where it was: results that exist are read back.
Workers write outcomes to the store themselves, a file each, named by the digest of its request: only requests go
through the scheduler.

Shard i of n has every n-th run of the study, from the i-th on, as by jobs of an array. Its folder gets a record of what
it is a part of, so that shards of different options or versions are not mistaken for parts of one study.
"""

import contextlib
import csv
import hashlib
import io
import json
import logging
import os
import platform
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from signal import default_int_handler
from typing import Any, Final, Self

from distributed import Client, LocalCluster, as_completed
from pydantic import BaseModel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from coldloop import __version__
from coldloop.errors import ColdloopError, ResultsError, StudyError, UsageError
from coldloop.text import parsed_json, whole_text
from coldloop_optimizer_plc.computing_settings import BudgetSettings, PlcBudget
from coldloop_optimizer_plc.solvers import make_solver
from coldloop_rig import interruption, progress, text_tables
from coldloop_rig.figures.plot import save_figure
from coldloop_rig.results.run_folder import installed_version, prepare_folder, write_json, writing
from coldloop_studies import request as requested
from coldloop_studies.request import Outcome, Procedure, RunRequest, decisive_digest, programs_digest
from coldloop_studies.settings import outside_digests, settings_of
from coldloop_studies.study import RUNS, Study, StudyOptions, StudyResult

REMEMBERED: Final = 64
"""Outcomes kept in memory: some MB each when they have a trace."""


class Store:
    """Outcomes by the digest of their request."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, request: RunRequest) -> Path:
        """Return where an outcome is kept."""
        return self.folder / f"{request.digest}.json"

    def text(self, request: RunRequest) -> str | None:
        """Return the file of a request if it is there and whole."""
        try:
            text = self.path(request).read_text(encoding="utf-8")
            Outcome.from_json(text)
        except (OSError, ValueError):
            return None
        return text

    def find(self, request: RunRequest) -> Outcome | None:
        """Return the outcome of a request if it is there and whole."""
        text = self.text(request)
        return None if text is None else Outcome.from_json(text)

    def keep(self, request: RunRequest, outcome: str) -> None:
        """Keep an outcome. Raises ResultsError if it cannot be written."""
        path = self.path(request)
        with writing(path, "what was done before is kept: make room, or choose another --out"):
            whole_text(path, outcome)


class StoredOutcomes(Mapping[RunRequest, Outcome]):
    """The outcomes of some requests, read when they are wanted: a large study has more than memory holds."""

    def __init__(self, store: Store, requests: Sequence[RunRequest]) -> None:
        self._requests = dict.fromkeys(requests)
        self._store, self._read = store, lru_cache(REMEMBERED)(self._found)

    def __getitem__(self, request: RunRequest) -> Outcome:
        """Return an outcome. Raises ResultsError if its file is gone, or is not whole any more."""
        if request not in self._requests:
            raise KeyError(request)
        return self._read(request)

    def _found(self, request: RunRequest) -> Outcome:
        if (outcome := self._store.find(request)) is None:
            raise ResultsError(f"{self._store.path(request)}: gone or damaged since it was written; do it again")
        return outcome

    def __iter__(self) -> Iterator[RunRequest]:
        """Go through the requests, in the order in which they were given."""
        return iter(self._requests)

    def __len__(self) -> int:
        """Return how many requests there are."""
        return len(self._requests)


def iteration_limit(request: RunRequest) -> int | None:
    """Return the iterations that fit into the updating period of a run, if power enters it by that number alone.

    In a networked run the time of an answer counts as well, with an adaptive period the number is the rule's, and a
    period that a load step cuts off leaves no record of its iterations.
    """
    program = settings_of(request.assignments).optimizer_plc.program
    in_one_process = request.procedure is Procedure.CONFIGURED and not request.networked
    if not in_one_process or not request.updating_period_s or program.interrupting_load_step_w:
        return None
    budget = PlcBudget(program.budget, make_solver(program).tau_1_s)
    return budget.iterations(round(request.updating_period_s / program.process.tick_s))


def never_cut_off(outcome: Outcome, limit: int) -> bool:
    """Return whether each solve of a run ended by itself before `limit` iterations."""
    return max(outcome.updates["iterations"], default=limit) < limit


def families(requests: Iterable[RunRequest]) -> list[list[RunRequest]]:
    """Return the requests in groups that differ by their limit of iterations only, the largest limit first."""
    groups: dict[str, list[tuple[int, RunRequest]]] = {}
    for request in dict.fromkeys(requests):
        limit = iteration_limit(request)
        key = request.digest
        if limit is not None:
            settings = settings_of(request.assignments).with_program(budget=BudgetSettings())
            key = decisive_digest(request, settings)
        groups.setdefault(key, []).append((limit or 0, request))
    return [
        [request for _, request in sorted(group, key=lambda one: one[0], reverse=True)] for group in groups.values()
    ]


def same_run(
    request: RunRequest, done: Sequence[RunRequest], outcomes: Mapping[RunRequest, Outcome]
) -> RunRequest | None:
    """Return which of the requests `done` of its family had the outcome that `request` would have, if one is known."""
    limit = iteration_limit(request)
    if limit is None:
        return None
    for other in done:
        if iteration_limit(other) == limit or never_cut_off(outcomes[other], limit):
            return other
    return None


CONNECT_PATIENCE_S: Final = 10
FINISHED: Final = "finished"
"""State of a future whose task has ended well; one without a scheduler is cancelled, and has no exception either."""
FILE_PATIENCE_S: Final = 60.0
"""Time after which a file that a worker has written on a file system that is shared is seen here too."""


@dataclass(frozen=True)
class Workers:
    """Workers that do the runs: a local cluster, or those of a Dask scheduler."""

    count: int
    """Workers of a local cluster; its runs share nothing."""
    scheduler: str | None = None
    """Address of a Dask scheduler that exists, instead."""

    @contextlib.contextmanager
    def connected(self) -> Iterator[Client]:
        """Connect to the workers for a while. Raises UsageError if the scheduler does not answer."""
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # their import has set them to less
        # an end at once, by a signal, leaves semaphores to a process that removes them, and need not warn of it
        os.environ.setdefault("PYTHONWARNINGS", "ignore::UserWarning:multiprocessing.resource_tracker")
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


def checked_requests(study: Study, options: StudyOptions, folder: Path) -> Sequence[RunRequest]:
    """Return the runs of a study, all of which can be done, and make its folders.

    Raises UsageError if a run is too short, a solver is not there, or the folders cannot be written to.
    """
    requests = study.requests(options)
    for request in requests:
        requested.check(request)
    for name in (study.name, RUNS):
        prepare_folder(folder / name)
    return requests


def perform_all(requests: Sequence[RunRequest], store: Store, workers: Workers, title: str) -> StoredOutcomes:
    """Do the runs that are missing; return the outcome of every request.

    Raises:
        StudyError: A run failed, or a worker runs other programs than we do, or writes to another folder.
        ResultsError: An outcome cannot be written.
    """
    outcomes = StoredOutcomes(store, requests)
    agenda = _Agenda(store, outcomes)
    first = agenda.next()
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=32), MofNCompleteColumn(), TextColumn("runs"),
        TimeElapsedColumn(), TimeRemainingColumn(), console=progress.make_console(), refresh_per_second=2,
    )  # fmt: skip
    if first:  # a signal unwinds here, so that the workers of a local cluster end: this thread only waits for them
        with (
            workers.connected() as client,
            interruption.INTERRUPTION.passed_to(lambda by: default_int_handler(by, None)),
            bar,
        ):
            task = bar.add_task(title, total=len(outcomes), completed=len(agenda.done))
            for request in _done(client, store, agenda, first):
                agenda.done.add(request)
                bar.update(task, completed=len(agenda.done))
    return outcomes


class _Agenda:
    """Remaining runs: of each family the run with the largest limit, then those that it does not determine."""

    def __init__(self, store: Store, outcomes: StoredOutcomes) -> None:
        self._store, self._outcomes, self._families = store, outcomes, families(outcomes)
        self._family = {request: family for family in self._families for request in family}
        self._begun: set[RunRequest] = set()
        self.done = {request for request in outcomes if store.find(request) is not None}
        """Requests whose outcome is there."""

    def next(self, after: RunRequest | None = None) -> list[RunRequest]:
        """Return what may be begun now that `after` was done, or at all; outcomes that are known are copied."""
        found = self._families if after is None else [self._family[after]]
        wanted: list[RunRequest] = []
        for family in found:
            known = [request for request in family if request in self.done]
            missing = [request for request in family if request not in self.done | self._begun]
            if known[:1] == family[:1]:
                wanted += [request for request in missing if not self._copied(request, known)]
            else:
                wanted += [request for request in missing if request is family[0]]
        self._begun.update(wanted)
        return wanted

    def _copied(self, request: RunRequest, known: list[RunRequest]) -> bool:
        """Keep the outcome of the same run as this one's too, if there is one; or it has the same name already."""
        if self._store.find(request) is None:
            other = same_run(request, known, self._outcomes)
            text = self._store.text(other) if other is not None else None
            if text is None:
                return False
            self._store.keep(request, text)
        self.done.add(request)
        return True


def _done(client: Client, store: Store, agenda: _Agenda, first: Sequence[RunRequest]) -> Iterator[RunRequest]:
    """Yield each request whose outcome a worker has written."""
    folder, programs = str(store.folder.resolve()), programs_digest()
    futures = {}

    def submit(requests: Sequence[RunRequest]) -> list[object]:
        new = {
            client.submit(perform_and_keep, request, folder, programs, key=f"run-{request.digest}"): request
            for request in requests
        }
        futures.update(new)
        return list(new)

    under_way = as_completed(submit(first))  # type: ignore[no-untyped-call]
    for future in under_way:
        request = futures.pop(future)
        error = future.exception()
        if isinstance(error, ColdloopError):
            raise error
        if error is not None:
            reason = _first_line(error)
            raise StudyError(f"a run under load {request.load} failed: {reason}; what was done before is kept")
        if future.status != FINISHED:
            raise StudyError("the scheduler is gone, or has given up a run; what was done before is kept: do it again")
        deadline = time.monotonic() + FILE_PATIENCE_S
        while store.find(request) is None:
            if time.monotonic() >= deadline:
                raise StudyError(f"{store.path(request)}: a worker has written it, and it is not here; {_SHARED}")
            time.sleep(0.5)
        yield request
        under_way.update(submit(agenda.next(request)))  # type: ignore[no-untyped-call]
        future.release()


def perform_and_keep(request: RunRequest, folder: str, programs: str) -> None:
    """Do a run and write its outcome, in a worker.

    Raises:
        StudyError: This is not the version of Coldloop that asks.
        ResultsError: The folder is not there, or cannot be written.
    """
    if programs != programs_digest() or replace(request).digest != request.digest:
        raise StudyError("a worker runs another version of Coldloop, or of a package of yours: install the same on all")
    store = Store(Path(folder))
    if not store.folder.is_dir():
        raise ResultsError(f"{folder}: a worker has no such folder; {_SHARED}")
    store.keep(request, requested.perform(request))


_SHARED: Final = "name an --out that all machines share, or do shards and merge them (`coldloop docs studies`)"


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def conduct(study: Study, options: StudyOptions, workers: Workers, folder: Path) -> StudyResult:
    """Do the missing runs of a study and write its files to `folder / study.name`.

    Raises ColdloopError if a run failed, or a file cannot be written.
    """
    requests = checked_requests(study, options, folder)
    outcomes = perform_all(requests, Store(folder / RUNS), workers, study.name)
    result = study.evaluate(options, outcomes)
    result.failed_runs = sum(outcome.failed_updates > 0 for outcome in outcomes.values())
    outside: dict[str, str] = {}
    for assignments in {request.assignments for request in requests}:
        outside |= outside_digests(settings_of(assignments).optimizer_plc.program.outside)
    runs = [
        {
            "load": request.load, "draw": request.draw, "duration_s": request.ticks * options.process.tick_s,
            "updating_period_s": request.updating_period_s or "adaptive", "settings": request.assignments,
            "outcome": f"{request.digest}.json",
        }
        for request in requests
    ]  # fmt: skip
    manifest = {
        "study": study.name, "coldloop": __version__, "python": platform.python_version(),
        "dependencies": {name: installed_version(name) for name in requested.LIBRARIES}, "programs": programs_digest(),
        "outside": outside, "options": asdict(options), "runs": runs,
    }  # fmt: skip
    table, own = io.StringIO(), folder / study.name
    csv.writer(table, lineterminator="\n").writerows([result.columns, *result.rows])
    with writing(own):
        whole_text(own / "results.csv", table.getvalue())
        for name, figure in result.figures.items():
            for suffix in (".png", ".pdf"):
                save_figure(figure, (own / figure_file(name)).with_suffix(suffix))
        whole_text(own / "section.md", f"# {study.title}\n\n{section(result)}")
        write_json(own / "manifest.json", manifest)
    return result


def figure_file(name: str) -> str:
    """Return the file name of a figure; LaTeX takes `%` for a comment."""
    return re.sub(r"[^\w.-]+", "-", name) + ".png"


def section(result: StudyResult, folder: str = "") -> str:
    """Return figures, remarks and a table of up to 24 rows as Markdown; figures are looked for in `folder`."""
    parts = [f"![{name}]({folder}{figure_file(name)})" for name in result.figures]
    parts += result.remarks
    if result.rows and (result.always_shown or len(result.rows) <= 24):
        parts.append(text_tables.markdown_table(result.columns, result.rows))
    return "\n\n".join(parts) + "\n"


@dataclass(frozen=True)
class Shard:
    """One of several parts of a study."""

    number: int
    """Number of the shard, from 1 to `of`."""
    of: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the shard that is written as `2/7`. Raises UsageError if it is none."""
        number, _, of = text.partition("/")
        if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
            raise UsageError(f"--shard {text}: write i/n with i from 1 to n, such as 2/7")
        return cls(int(number), int(of))

    def __str__(self) -> str:
        """Write it as it is read."""
        return f"{self.number}/{self.of}"

    def part(self, requests: Sequence[RunRequest]) -> list[RunRequest]:
        """Return the runs of this shard."""
        return unique(requests)[self.number - 1 :: self.of]


class ShardRecord(BaseModel, frozen=True, extra="forbid"):
    """Study, options and programs that a shard is a part of."""

    study: str
    shard: int
    of: int
    options: dict[str, Any]
    """Options of the study."""
    programs: str
    """Digest of the programs that do its runs."""
    runs: str
    """Digest of all runs of the study."""

    @classmethod
    def of_study(cls, study: Study, options: StudyOptions, shard: Shard) -> Self:
        """Return the record of a shard that is about to be done."""
        digests = [request.digest for request in unique(study.requests(options))]
        runs = hashlib.sha256("\n".join(digests).encode()).hexdigest()[:20]
        plain = parsed_json(json.dumps(asdict(options)))
        return cls(
            study=study.name, shard=shard.number, of=shard.of, options=plain, programs=programs_digest(), runs=runs
        )


def unique(requests: Sequence[RunRequest]) -> list[RunRequest]:
    """Return one request for each run, in their order: the same run may be asked for in several ways."""
    found: dict[str, RunRequest] = {}
    for request in requests:
        found.setdefault(request.digest, request)
    return list(found.values())


def conduct_shard(study: Study, options: StudyOptions, workers: Workers, folder: Path, shard: Shard) -> int:
    """Do the missing runs of a shard; return how many runs it has.

    Raises ColdloopError if a run failed, or a file cannot be written.
    """
    requests = checked_requests(study, options, folder)
    path = folder / study.name / f"shard-{shard.number}-of-{shard.of}.json"
    with writing(path):
        write_json(path, ShardRecord.of_study(study, options, shard).model_dump())
    mine = shard.part(requests)
    perform_all(mine, Store(folder / RUNS), workers, f"{study.name} {shard}")
    return len(mine)


def merge(study: Study, options: StudyOptions, sources: Sequence[Path], folder: Path) -> None:
    """Gather the runs of all shards in one store.

    Raises:
        UsageError: A folder has no shard of this study with these options, done by these programs.
        StudyError: Runs are missing.
        ResultsError: A file cannot be written.
    """
    of = _common_number(study, options, sources)
    prepare_folder(folder / RUNS)
    target = Store(folder / RUNS)
    requests = unique(study.requests(options))
    missing = []
    for place, request in enumerate(requests):
        if target.find(request) is not None:
            continue
        found = (Store(source / RUNS).text(request) for source in sources)
        text = next((text for text in found if text is not None), None)
        if text is None:
            missing.append(f"{place % of + 1}/{of}")
        else:
            target.keep(request, text)
    if missing:
        shards = ", ".join(sorted(set(missing), key=lambda shard: int(shard.partition("/")[0])))
        raise StudyError(
            f"study {study.name}: {len(missing)} of {len(requests)} runs are missing or damaged, of shards {shards}; "
            "do these with --shard, then merge again"
        )


def _common_number(study: Study, options: StudyOptions, sources: Sequence[Path]) -> int:
    """Return in how many shards the study was cut; all records must agree, with each other and with what is asked."""
    cuts = {}
    for source in sources:
        paths = sorted((source / study.name).glob("shard-*-of-*.json"))
        if not paths:
            raise UsageError(f"{source}: no shard of study {study.name}; name the --out folders of the shards")
        for path in paths:
            try:
                record = ShardRecord.model_validate_json(path.read_text(encoding="utf-8"))
            except OSError as error:
                raise UsageError(f"{path}: {error.strerror}; do this shard again") from None
            except ValueError:
                raise UsageError(f"{path}: not the record of a shard; do this shard again") from None
            _compare(path, record, ShardRecord.of_study(study, options, Shard(record.shard, record.of)))
            cuts[record.of] = path
    if len(cuts) > 1:
        (of, path), (other, other_path) = list(cuts.items())[:2]
        raise UsageError(f"{other_path}: one of {other} shards, while {path} is one of {of}; merge shards of one set")
    return next(iter(cuts))


def _compare(path: Path, record: ShardRecord, wanted: ShardRecord) -> None:
    if record.programs != wanted.programs:
        raise UsageError(f"{path}: done by another version of Coldloop; do all shards and the merge with the same one")
    names = {**record.options, **wanted.options}
    different = [
        f"{name} {record.options.get(name)} there, {wanted.options.get(name)} here"
        for name in names if record.options.get(name) != wanted.options.get(name)
    ]  # fmt: skip
    if different or record.runs != wanted.runs:
        reason = "; ".join(different) or "load files differ"
        raise UsageError(f"{path}: of another configuration ({reason}); give all shards and the merge the same options")
