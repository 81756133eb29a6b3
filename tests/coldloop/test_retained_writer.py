"""Retained states are written off the scan's way: the newest one, in order, whatever the disk does."""

import logging
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from coldloop.safety.retained import RetainedFile, RetainedStateError, RetainedStateWriter

LONG_S = 120.0
"""Longer than anything here takes."""


class FakeFile(RetainedFile):
    """A file on a disk that is as slow, and as full, as a test wants it."""

    def __init__(self) -> None:
        super().__init__(Path("state"), "control_plc/1", 0)
        self.saved: list[int] = []
        self.full = False
        self.tries = threading.Semaphore(0)
        self.free = threading.Event()
        self.free.set()

    def save(self, state: Mapping[str, Any]) -> None:
        self.tries.release()
        self.free.wait(LONG_S)
        if self.full:
            raise RetainedStateError("state: No space left on device")
        self.saved.append(state["tick"])

    def wait_for_try(self) -> None:
        assert self.tries.acquire(timeout=LONG_S)


@pytest.fixture
def file() -> FakeFile:
    return FakeFile()


@pytest.fixture
def writer(file: FakeFile) -> Iterator[RetainedStateWriter]:
    one = RetainedStateWriter(file, pause_s=0.0, retry_s=0.001)
    yield one
    file.free.set()
    file.full = False
    one.close()


def test_of_the_states_that_come_while_the_disk_is_busy_the_newest_is_written(
    file: FakeFile, writer: RetainedStateWriter
) -> None:
    file.free.clear()
    writer.keep({"tick": 0})
    file.wait_for_try()
    for tick in range(1, 1000):
        writer.keep({"tick": tick})
    assert not writer.flush(0.0)
    file.free.set()
    assert writer.flush(LONG_S)
    assert file.saved == [0, 999]


def test_states_are_written_in_their_order_and_each_at_most_once(file: FakeFile, writer: RetainedStateWriter) -> None:
    for tick in range(3000):
        writer.keep({"tick": tick})
    assert writer.flush(LONG_S)
    assert file.saved == sorted(set(file.saved))
    assert file.saved[-1] == 2999


def test_a_full_disk_fails_nobody_is_told_once_and_recovers(
    file: FakeFile, writer: RetainedStateWriter, caplog: pytest.LogCaptureFixture
) -> None:
    file.full = True
    writer.keep({"tick": 1})
    for _ in range(3):  # tried again without a new state
        file.wait_for_try()
    assert writer.failed == "state: No space left on device"
    file.full = False
    assert writer.flush(LONG_S)
    assert writer.failed is None
    told = [(record.levelno, record.message) for record in caplog.records]
    assert told == [(logging.ERROR, "the state is not retained"), (logging.WARNING, "the state is retained again")]


def test_a_state_that_is_no_json_is_a_failure_and_the_next_one_is_written(tmp_path: Path) -> None:
    file = RetainedFile(tmp_path / "state", "control_plc/1", 0)
    writer = RetainedStateWriter(file, pause_s=0.0, retry_s=0.001)
    writer.keep({"tick": object()})
    while writer.failed is None:
        assert not writer.flush(0.01)
    assert "not JSON serializable" in writer.failed
    writer.keep({"tick": 2})
    assert writer.close(LONG_S)
    assert file.load() == {"tick": 2}


def test_the_newest_state_is_written_at_the_end(tmp_path: Path) -> None:
    file = RetainedFile(tmp_path / "state", "control_plc/1", 0)
    writer = RetainedStateWriter(file, pause_s=LONG_S)
    for tick in range(10):
        writer.keep({"tick": tick})
    assert writer.close(LONG_S)
    assert file.load() == {"tick": 9}


def test_the_end_waits_for_the_disk_for_a_bounded_time(file: FakeFile, writer: RetainedStateWriter) -> None:
    file.free.clear()
    writer.keep({"tick": 1})
    file.wait_for_try()
    assert not writer.close(0.05)


class Unread(Mapping[str, Any]):
    """A state whose content costs the scan nothing: nobody looks at it before the disk is free."""

    def __getitem__(self, key: str) -> Any:  # noqa: ANN401
        raise AssertionError(f"{key} is read")

    def __iter__(self) -> Iterator[str]:
        raise AssertionError("the state is gone through")

    def __len__(self) -> int:
        raise AssertionError("the state is measured")


def test_keeping_neither_waits_for_a_busy_disk_nor_looks_at_the_state(
    file: FakeFile, writer: RetainedStateWriter
) -> None:
    file.free.clear()
    writer.keep({"tick": 0})
    file.wait_for_try()
    for _ in range(1000):
        writer.keep(Unread())
    writer.keep({"tick": 1})
    assert file.saved == [], "the disk has been busy all the time"
    file.free.set()
    assert writer.flush(LONG_S)
    assert file.saved == [0, 1]
