"""A study done in parts is the study; what cannot be put together is one line."""

import errno
import json
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import coldloop_studies.execution
from coldloop.errors import ResultsError, StudyError, UsageError
from coldloop_studies.execution import Shard, Store, StoredOutcomes, Workers, conduct, conduct_shard, merge, perform_all
from coldloop_studies.reproduction import STUDIES
from coldloop_studies.request import RunRequest, perform
from coldloop_studies.study import RUNS, StudyOptions

if TYPE_CHECKING:
    from distributed import Client

    from tests.conftest import Coldloop
    from tests.studies.conftest import Requests

STUDY = STUDIES["trade-off"]
OPTIONS = StudyOptions(seeds=1, ticks=120, loads=("e",), quick=True)
"""Twelve runs of half a minute: four solvers, three periods."""
ARGUMENTS = ("trade-off", "--load", "e", "--duration", "30s", "--quick")


def results(folder: Path) -> bytes:
    return (folder / STUDY.name / "results.csv").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, running: Workers) -> Path:
    """The study done at once, as one shard of one."""
    folder = tmp_path_factory.mktemp("whole")
    assert conduct_shard(STUDY, OPTIONS, running, folder, Shard(1, 1)) == 12
    merge(STUDY, OPTIONS, [folder], folder)
    conduct(STUDY, OPTIONS, running, folder)
    return folder


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory, running: Workers) -> list[Path]:
    """The study in seven shards, a folder each."""
    folders = [tmp_path_factory.mktemp(f"part{number}") for number in range(1, 8)]
    counts = [
        conduct_shard(STUDY, OPTIONS, running, folder, Shard(number, 7)) for number, folder in enumerate(folders, 1)
    ]
    assert counts == [2, 2, 2, 2, 2, 1, 1]
    return folders


@pytest.mark.usefixtures("realtime")
def test_seven_shards_merged_are_the_study_byte_for_byte(whole: Path, parts: list[Path], tmp_path: Path) -> None:
    merge(STUDY, OPTIONS, parts, tmp_path)
    conduct(STUDY, OPTIONS, Workers(1, scheduler="tcp://127.0.0.1:1"), tmp_path)
    assert results(tmp_path) == results(whole)
    theirs = {path.name: path.read_bytes() for path in (tmp_path / RUNS).iterdir()}
    assert theirs == {path.name: path.read_bytes() for path in (whole / RUNS).iterdir()}


@pytest.mark.night
def test_shards_may_share_a_folder_and_be_done_at_once(whole: Path, client: "Client", tmp_path: Path) -> None:
    """Two of the three are the same one: both do its runs, or find them done."""
    workers = Workers(1, scheduler=client.scheduler.address)
    failures: list[BaseException] = []

    def do(shard: Shard) -> None:
        try:
            conduct_shard(STUDY, OPTIONS, workers, tmp_path, shard)
        except BaseException as error:  # noqa: BLE001 the main thread fails with it
            failures.append(error)

    threads = [threading.Thread(target=do, args=(shard,)) for shard in (Shard(1, 2), Shard(2, 2), Shard(2, 2))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    merge(STUDY, OPTIONS, [tmp_path], tmp_path)
    conduct(STUDY, OPTIONS, workers, tmp_path)
    assert results(tmp_path) == results(whole)


@pytest.mark.night  # what a dead worker costs is shown for single runs in test_execution.py
def test_a_third_of_the_workers_killed_changes_no_byte(whole: Path, tmp_path: Path) -> None:
    with Workers(3).connected() as client:
        victim = next(iter(client.run(os.getpid).values()))
        store = tmp_path / RUNS

        def kill_after_the_first() -> None:
            while not (store.is_dir() and any(store.glob("*.json"))):
                threading.Event().wait(0.01)
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill_after_the_first)
        killer.start()
        conduct(STUDY, OPTIONS, Workers(1, scheduler=client.scheduler.address), tmp_path)
        killer.join()
        assert victim not in client.run(os.getpid).values()
    assert results(tmp_path) == results(whole)


def one_gone(part: Path) -> None:
    next((part / RUNS).glob("*.json")).unlink()


def one_half_written(part: Path) -> None:
    path = next((part / RUNS).glob("*.json"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def record(part: Path) -> Path:
    return next((part / STUDY.name).glob("shard-*.json"))


def changed(**fields: object) -> Callable[[Path], None]:
    def change(part: Path) -> None:
        path = record(part)
        path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))

    return change


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize(
    ("damage", "error", "part"),
    [
        (one_gone, StudyError, r"1 of 12 runs are missing or damaged, of shards 2/2; do these with --shard"),
        (one_half_written, StudyError, r"1 of 12 runs are missing or damaged, of shards 2/2"),
        (lambda part: record(part).unlink(), UsageError, r"no shard of study trade-off; name the --out folders"),
        (lambda part: record(part).write_text('{"study"'), UsageError, r"not the record of a shard"),
        (changed(programs="others"), UsageError, r"done by another version of Coldloop"),
        (changed(runs="others"), UsageError, r"of another configuration \(load files differ\)"),
        (
            changed(options={"seeds": 2, "ticks": 120, "loads": ["e"], "quick": True, "settings": [], "variants": []}),
            UsageError,
            r"of another configuration \(seeds 2 there, 1 here\); give all shards and the merge the same options",
        ),
        (changed(shard=3, of=3), UsageError, r"one of 3 shards, while .* is one of 2; merge shards of one set"),
    ],
)
def test_what_cannot_be_merged_is_one_line(
    damage: Callable[[Path], None], error: type[Exception], part: str, running: Workers, whole: Path, tmp_path: Path
) -> None:
    one, two = tmp_path / "1", tmp_path / "2"
    for number, folder in enumerate((one, two), 1):
        folder.mkdir()
        (folder / RUNS).mkdir()
        for request in Shard(number, 2).part(STUDY.requests(OPTIONS)):
            text = Store(whole / RUNS).text(request)
            assert text is not None
            Store(folder / RUNS).keep(request, text)
        assert conduct_shard(STUDY, OPTIONS, running, folder, Shard(number, 2)) == 6
    damage(two)
    with pytest.raises(error, match=part) as caught:
        merge(STUDY, OPTIONS, [one, two], tmp_path / "merged")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("realtime")
def test_the_command_does_shards_and_merges_them(
    whole: Path, coldloop: "Coldloop", running: Workers, tmp_path: Path
) -> None:
    for number in (1, 2):
        outcome = coldloop("study", *ARGUMENTS, "--shard", f"{number}/2", "--scheduler", running.scheduler, "--out",
                           tmp_path / str(number))  # fmt: skip
        assert outcome.code == 0, outcome.complaints
        assert outcome.out == f"shard {number}/2 of trade-off: 6 runs in {tmp_path / str(number) / RUNS}\n"
    outcome = coldloop("study", *ARGUMENTS, "--merge", tmp_path / "1", tmp_path / "2", "--out", tmp_path / "merged")
    assert outcome.code == 0, outcome.complaints
    assert results(tmp_path / "merged") == results(whole)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ((*ARGUMENTS, "--shard", "0/2"), "--shard 0/2: write i/n with i from 1 to n"),
        ((*ARGUMENTS, "--shard", "3/2"), "--shard 3/2: write i/n"),
        ((*ARGUMENTS, "--shard", "half"), "--shard half: write i/n"),
        ((*ARGUMENTS, "--merge", "nowhere"), "nowhere: no shard of study trade-off"),
        ((*ARGUMENTS, "--merge", "nowhere", "--workers", "2"), "--merge does no runs"),
        ((*ARGUMENTS, "--merge", "nowhere", "--shard", "1/2"), "not allowed with"),
        (("cholesky", "--shard", "1/2"), "--shard would have no effect"),
    ],
)
def test_shards_asked_for_wrongly_are_one_line(
    arguments: tuple[str, ...], part: str, coldloop: "Coldloop", tmp_path: Path
) -> None:
    outcome = coldloop("study", *arguments, "--out", tmp_path / "studies")
    assert outcome.code == 2
    assert part in outcome.complaints[-1]


def test_a_full_disk_is_one_line(requests: "Requests", store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    (request,) = requests(1)
    there = Path.open

    def full(path: Path, *arguments: Any, **options: Any) -> Any:  # noqa: ANN401 in the place of `Path.open`
        if path.parent == store.folder:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return there(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(ResultsError, match=r"No space left on device; what was done before is kept: make room"):
        store.keep(request, perform(request))
    assert list(store.folder.iterdir()) == []


@pytest.mark.usefixtures("realtime")
def test_a_folder_that_the_workers_do_not_have_is_one_line(
    requests: "Requests", running: Workers, tmp_path: Path
) -> None:
    with pytest.raises(ResultsError, match=r"a worker has no such folder; name an --out that all machines share"):
        perform_all(requests(1), Store(tmp_path / "not there"), running, "test")


@pytest.mark.usefixtures("realtime")
def test_a_file_that_a_worker_wrote_elsewhere_is_one_line(
    requests: "Requests", running: Workers, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coldloop_studies.execution, "FILE_PATIENCE_S", 0.0)
    monkeypatch.setattr(Store, "find", lambda *_: None)
    with pytest.raises(StudyError, match=r"a worker has written it, and it is not here; name an --out"):
        perform_all(requests(1), store, running, "test")


def test_outcomes_that_go_while_they_are_wanted_are_one_line(requests: "Requests", store: Store) -> None:
    one, other = requests(2)
    text = perform(one)
    store.keep(one, text)
    outcomes = StoredOutcomes(store, [one, other])
    assert list(outcomes) == [one, other]
    assert outcomes[one].to_json() == text
    with pytest.raises(ResultsError, match="gone or damaged since it was written"):
        outcomes[other]


def test_every_run_is_in_one_shard() -> None:
    asked: list[RunRequest] = STUDY.requests(OPTIONS)  # type: ignore[assignment]
    together = [request for number in range(1, 6) for request in Shard(number, 5).part([*asked, *asked])]
    assert sorted(request.digest for request in together) == sorted(request.digest for request in asked)
