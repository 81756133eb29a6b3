"""Runs are done once, by whatever workers there are, and what happens to a worker changes no result."""

import os
import signal
import threading
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from distributed import Future

from coldloop.errors import StudyError, UsageError
from coldloop_studies.execution import Store, Workers, perform_all
from coldloop_studies.request import perform

if TYPE_CHECKING:
    from distributed import Client

    from tests.studies.conftest import Requests


def test_workers_give_what_the_run_gives(requests: "Requests", store: Store, running: Workers) -> None:
    asked = requests(4)
    outcomes = perform_all(asked, store, running, "test")
    assert list(outcomes) == asked
    assert [outcome.to_json() for outcome in outcomes.values()] == [perform(request) for request in asked]


def test_what_is_done_is_read_back(requests: "Requests", store: Store, running: Workers) -> None:
    asked = requests(3)
    first = perform_all(asked, store, running, "test")
    nobody = Workers(1, scheduler="tcp://127.0.0.1:1")
    assert perform_all(asked, store, nobody, "test") == first


def test_a_damaged_file_is_done_again(requests: "Requests", store: Store, running: Workers) -> None:
    (request,) = requests(1)
    first = perform_all([request], store, running, "test")
    store.path(request).write_text(store.path(request).read_text()[:100])
    assert perform_all([request], store, running, "test") == first


@pytest.mark.usefixtures("programs", "realtime")
def test_a_worker_that_dies_costs_only_its_own_runs(requests: "Requests", store: Store) -> None:
    asked = [replace(request, ticks=1200) for request in requests(6)]
    with Workers(2).connected() as client:
        victim = next(iter(client.run(os.getpid).values()))
        killed = threading.Event()

        def kill_after_the_first() -> None:
            while not any(store.path(request).exists() for request in asked):
                killed.wait(0.01)
            os.kill(victim, signal.SIGKILL)
            killed.set()

        killer = threading.Thread(target=kill_after_the_first)
        killer.start()
        outcomes = perform_all(asked, store, Workers(1, scheduler=client.scheduler.address), "test")
        killer.join()
        assert killed.is_set()
        assert victim not in client.run(os.getpid).values()
    assert [outcome.to_json() for outcome in outcomes.values()] == [perform(request) for request in asked]


def test_a_run_that_fails_is_one_line_and_loses_nothing(requests: "Requests", store: Store, running: Workers) -> None:
    good = requests(2)
    bad = replace(good[0], assignments=("optimizer_plc.program.solver=none",))
    with pytest.raises((StudyError, UsageError)) as caught:
        perform_all([*good, bad], store, running, "test")
    assert "\n" not in str(caught.value)
    again = perform_all(good, store, running, "test")
    assert len(again) == 2


def test_a_scheduler_that_is_not_there_is_one_line(
    requests: "Requests", store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coldloop_studies.execution.CONNECT_PATIENCE_S", 0.1)
    with pytest.raises(UsageError, match=r"--scheduler tcp://127\.0\.0\.1:1: .*; name one that is up"):
        perform_all(requests(1), store, Workers(1, scheduler="tcp://127.0.0.1:1"), "test")


@pytest.mark.usefixtures("realtime")
def test_a_run_that_the_scheduler_gives_up_is_one_line(requests: "Requests", store: Store, client: "Client") -> None:
    asked = [replace(request, ticks=2400) for request in requests(12)]  # the last is not under way for long
    last = Future(f"run-{asked[-1].digest}", client=client)  # type: ignore[no-untyped-call]

    def give_up() -> None:
        while not any(store.path(request).exists() for request in asked):
            threading.Event().wait(0.01)
        client.cancel([last], force=True)  # type: ignore[no-untyped-call]

    canceller = threading.Thread(target=give_up)
    canceller.start()
    with pytest.raises(StudyError, match="the scheduler is gone, or has given up a run; what was done before is kept"):
        perform_all(asked, store, Workers(1, scheduler=client.scheduler.address), "test")
    canceller.join()


def test_the_workers_of_a_client_are_two(client: "Client") -> None:
    assert len(client.run(os.getpid)) == 2
