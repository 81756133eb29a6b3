from hypothesis import given
from hypothesis import strategies as st

from coldloop.registers.common import WatchdogState
from coldloop.safety.watchdog import Watchdog


@given(time=st.integers(1, 50), triggers=st.sets(st.integers(1, 200)))
def test_it_expires_exactly_when_nobody_has_triggered_it_for_its_time(time: int, triggers: set[int]) -> None:
    watchdog = Watchdog(time)
    last = 0
    trips = 0
    for tick in range(1, 200):
        expires = tick - last == time
        assert watchdog.check(tick) is expires
        trips += expires
        state = WatchdogState.EXPIRED if tick - last >= time else WatchdogState.RUNNING
        shown = watchdog.registers(tick)
        assert (shown.state, shown.remaining, shown.trips) == (state, max(0, time - (tick - last)), trips)
        if tick in triggers:
            watchdog.trigger(tick)
            last = tick


def test_one_that_is_off_never_expires() -> None:
    watchdog = Watchdog(0)
    assert not any(watchdog.check(tick) for tick in range(1000))
    assert watchdog.registers(1000).state == WatchdogState.OFF


def test_setting_it_starts_it_anew_and_it_remembers_how_close_it_was() -> None:
    watchdog = Watchdog(10)
    watchdog.trigger(7)
    assert watchdog.registers(7).lowest == 3
    watchdog.set(20, 9)
    assert not watchdog.check(28)
    assert watchdog.check(29)
    assert watchdog.registers(29) == (20, WatchdogState.EXPIRED, 0, 0, 1)


def test_where_the_time_is_set_back_it_has_its_whole_time_from_there_and_no_more() -> None:
    watchdog = Watchdog(10)
    watchdog.trigger(100)
    watchdog.set_back(40)
    assert not watchdog.check(49)
    assert watchdog.check(50)
