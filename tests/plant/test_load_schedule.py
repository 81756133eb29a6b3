"""The heat load of a session under way: what is known of it, what may be written, what is forgotten."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.plant import LoadStep
from coldloop_plant.load import MOST_UPCOMING, LoadSchedule


def schedule(*steps: tuple[int, float]) -> LoadSchedule:
    times, watts = zip(*(steps or ((0, 385.0),)), strict=True)
    return LoadSchedule(LoadProfile(times, watts), COLD_BOX.load)


def write(load: LoadSchedule, now: int, *steps: tuple[int, float]) -> None:
    taken = [LoadStep(*step) for step in steps]
    load.check(taken, now)
    load.put(taken, now)


def test_a_load_takes_effect_from_the_tick_it_names() -> None:
    load = schedule()
    write(load, 5, (8, 420.0))
    assert [load.value(tick) for tick in (5, 7, 8, 100)] == [385.0, 385.0, 420.0, 420.0]


def test_what_was_known_of_later_ticks_is_dropped() -> None:
    load = schedule((0, 385.0), (10, 300.0), (20, 500.0))
    write(load, 12, (15, 420.0))
    assert [load.value(tick) for tick in (12, 15, 20, 99)] == [300.0, 420.0, 420.0, 420.0]
    assert load.status(12) == (300.0, 15, 420.0, 15, 1, MOST_UPCOMING - 1)


@pytest.mark.parametrize(
    ("steps", "reason"),
    [
        ([], "no steps"),
        ([(5, 1.0)], "tick 5 is past"),
        ([(6, 1.0), (6, 2.0)], "does not come after"),
        ([(6, -1.0)], "outside"),
        ([(6, COLD_BOX.load.stored_span[1] + 1)], "outside"),
        ([(6 + step, 1.0) for step in range(MOST_UPCOMING + 1)], "write these later"),
    ],
)
def test_a_load_that_cannot_be_taken_is_refused_with_its_reason(steps: list[tuple[int, float]], reason: str) -> None:
    load = schedule()
    with pytest.raises(ValueError, match=reason):
        load.check([LoadStep(*step) for step in steps], 5)


def test_a_load_of_any_length_passes_through() -> None:
    load = schedule()
    for now in range(0, 40_000, 20):
        write(load, now, *((now + ahead, float((now + ahead) % 900)) for ahead in range(1, 25)))
        assert load.value(now + 10) == (now + 10) % 900
        assert load.status(now).upcoming == 24
    assert len(load._times) < 1000  # noqa: SLF001 memory stays flat


def test_what_is_retained_goes_on_with_the_same_load() -> None:
    load = schedule((0, 385.0), (10, 300.0), (20, 500.0))
    kept = LoadSchedule(load.from_tick(12), COLD_BOX.load)
    assert [kept.value(tick) for tick in range(12, 25)] == [load.value(tick) for tick in range(12, 25)]


@given(st.lists(st.tuples(st.integers(1, 60), st.integers(1, 30), st.floats(0, 1000)), max_size=30))
def test_the_load_at_a_tick_is_the_last_one_written_for_it(writes: list[tuple[int, int, float]]) -> None:
    load, expected = schedule(), dict.fromkeys(range(2000), 385.0)
    now = 0
    for later, ahead, watts in writes:
        now += later
        write(load, now, (now + ahead, watts))
        expected |= dict.fromkeys(range(now + ahead, 2000), watts)
        assert [load.value(tick) for tick in range(now, now + 40)] == [expected[t] for t in range(now, now + 40)]
