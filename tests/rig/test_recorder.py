"""What a recorder passes on when ticks are missing, or come again after a restart."""

import math

import pytest

from coldloop.errors import LinkError
from coldloop.registers.plant import PlantSample
from coldloop_rig.results.recording import BLOCK_TICKS, KEPT_TICKS, Recorder


def sample(tick: int, load: float = 1.0) -> PlantSample:
    return PlantSample(tick, load, (0.0,) * 3, (0.0,) * 22, (0.0,) * 28)


def recorder_after(*ticks: int) -> Recorder:
    recorder = Recorder(10_000)
    for tick in ticks:
        recorder.sample(sample(tick))
    return recorder


def test_ticks_that_nobody_saw_are_nan_and_counted() -> None:
    recorder = recorder_after(0, 1, 4)
    assert (recorder.next_tick, recorder.missing_ticks) == (5, 2)
    load = recorder.recording().load
    assert load[[0, 1, 4]].tolist() == [1.0, 1.0, 1.0]
    assert [math.isnan(value) for value in load[[2, 3]]] == [True, True]


def test_a_tick_that_comes_again_replaces_what_was_there() -> None:
    recorder = recorder_after(0, 1, 2, 3)
    recorder.sample(sample(2, 7.0))
    recorder.sample(sample(3, 8.0))
    recorder.sample(sample(4, 9.0))
    assert recorder.recording().load.tolist() == [1.0, 1.0, 7.0, 8.0, 9.0]


def test_a_tick_that_was_missed_may_be_seen_later() -> None:
    recorder = recorder_after(0, 3)
    recorder.sample(sample(1))
    assert recorder.missing_ticks == 1


def test_a_gap_longer_than_a_block_is_passed_on_whole() -> None:
    length = 3 * BLOCK_TICKS
    recorder = recorder_after(0, length - 1)
    load = recorder.recording().load
    assert len(load) == length
    assert int(sum(map(math.isnan, load))) == recorder.missing_ticks == length - 2


def test_a_tick_that_was_passed_on_already_cannot_come_again() -> None:
    recorder = recorder_after(*range(BLOCK_TICKS + KEPT_TICKS))
    recorder.sample(sample(BLOCK_TICKS, 5.0))
    with pytest.raises(LinkError, match="was set back too far"):
        recorder.sample(sample(BLOCK_TICKS - 1))
