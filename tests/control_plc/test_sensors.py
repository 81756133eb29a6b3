"""What the sensors' checks make of a plant that stands still, as a simulated one with exact sensors does."""

import pytest

from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES
from coldloop.process.settings import settings_of
from coldloop_control_plc.sensors import MOVES, SensorCheckSettings, SensorMonitor, check

REST = tuple(10.0 + place for place in range(22))
INPUTS = (43.0, 75.0, 36.0)
assert COLD_BOX.bath is not None
TURBINE_SPEED, BEFORE, BEHIND = map(OUTPUT_NAMES.index, (COLD_BOX.bath.turbine_speed, *COLD_BOX.bath.turbine_pressures))


def checked(
    monitor: SensorMonitor, tick: int, y: tuple[float, ...], inputs: tuple[float, ...] = ()
) -> tuple[float, ...]:  # fmt: skip
    """Return the outputs after a check."""
    check(monitor.constants, monitor, tick, y, (), 0.0, inputs)
    return tuple(monitor.good)


def others_moved(tick: int) -> tuple[float, ...]:
    """Return measurements of which only the first is as it was at the beginning."""
    return (REST[0], *(value + 1e-3 * tick for value in REST[1:]))


@pytest.fixture
def monitor() -> SensorMonitor:
    """The checks of another process than the cold box."""
    with settings_of(COLD_BOX.model_copy(update={"moves_as_one": False})):
        return SensorMonitor(SensorCheckSettings(), REST, moves=(0.1, 0.1, 0.1))


def test_an_output_that_never_moved_is_not_frozen_while_the_inputs_rest(monitor: SensorMonitor) -> None:
    """Once, the first scans after a long silence ended the service: nothing was known of the inputs before."""
    assert checked(monitor, 1, others_moved(1), INPUTS) == others_moved(1)
    assert checked(monitor, 1000, others_moved(1000), INPUTS) == others_moved(1000)
    assert not monitor.bad


def test_an_output_is_frozen_when_it_has_not_moved_for_long_since_the_inputs_have(monitor: SensorMonitor) -> None:
    """Once it was at once, if it had rested for long before: what it shows of the inputs takes its time."""
    for tick in (1, 2, 1000):
        checked(monitor, tick, others_moved(tick), INPUTS)
    for tick in (1001, 1000 + monitor.constants.frozen_ticks):
        checked(monitor, tick, others_moved(tick), (43.0, 75.0, 36.2))
        assert not monitor.bad
    tick = 1001 + monitor.constants.frozen_ticks
    checked(monitor, tick, others_moved(tick), (43.0, 75.0, 36.2))
    assert list(monitor.bad) == [0]


SPEED = 2350.0


def turning(tick: int, speed: float, before: float) -> tuple[float, ...]:
    """Return measurements, all of which move but perhaps the speed of the turbine, with so much (bar) before it."""
    y = list(others_moved(tick))
    y[0], y[TURBINE_SPEED], y[BEHIND], y[BEFORE] = y[0] + 1e-3 * tick, speed, 1.1 + 1e-5 * tick, before + 1e-5 * tick
    return tuple(y)


@pytest.mark.parametrize(
    ("shown", "before", "bad"),
    [(0.0, 1.1, []), (0.0, 11.0, [TURBINE_SPEED]), (SPEED, 1.1, [TURBINE_SPEED])],
    ids=["it stands", "dead", "frozen while it stands"],
)
def test_a_speed_of_none_is_believed_of_a_turbine_without_a_pressure_difference(
    shown: float, before: float, bad: list[int]
) -> None:
    """Once a turbine that had tripped gave the alarm `sensor bad`."""
    monitor = SensorMonitor(SensorCheckSettings(), REST)
    for tick in range(MOVES + 1):
        checked(monitor, tick, turning(tick, SPEED + tick / 512, 11.0))
    assert monitor.rests[TURBINE_SPEED] == 0
    for tick in range(MOVES + 1, 10 * MOVES):
        checked(monitor, tick, turning(tick, shown, before))
    assert list(monitor.bad) == bad
    checked(monitor, 10 * MOVES, turning(10 * MOVES, shown, 11.0))
    assert list(monitor.bad) == [TURBINE_SPEED], "it is to turn again, and shows nothing"
