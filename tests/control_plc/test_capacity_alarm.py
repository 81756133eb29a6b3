"""A load that cannot be held is one alarm, however the shortage moves, and stands as long as MPC drives and says so."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from coldloop.registers.common import Alarm, AlarmKind, CapacityCause, EventKind
from coldloop.registers.control_plc import Mode, Operator, OperatorMode
from tests.harness.records import Row

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

At = Callable[..., Row]


def after(bench: "Bench", at: At, shortages: list[float]) -> Alarm:
    """Return the alarm after an updating period of 2.5 s with each shortage."""
    for bench.shortage in shortages:
        bench.play([at()] * 20, ticks=10)
        bench.scan()
    return bench.program.alarms.rows[AlarmKind.CAPACITY]


def raised(bench: "Bench") -> list[float]:
    """Return the watts of each time that it was raised."""
    what = (EventKind.ALARM_RAISED, AlarmKind.CAPACITY)
    return [event.value for event in bench.program.journal.since(0) if (event.kind, event.subject) == what]


@pytest.mark.parametrize(
    ("sign", "cause"), [(1.0, CapacityCause.TOO_MUCH), (-1.0, CapacityCause.TOO_LITTLE)], ids=["too much", "too little"]
)
def test_it_is_raised_once_after_twenty_seconds_with_the_watts_of_then(
    sign: float, cause: CapacityCause, bench: "Bench", at: At
) -> None:
    bench.steady = bench.moving = True
    assert not after(bench, at, [sign * (1.0 + i) for i in range(8)]).active
    alarm = after(bench, at, [sign * 30.5] * 2)
    assert (alarm.active, alarm.times, alarm.cause) == (1, 1, cause)
    assert raised(bench) == [30.5]
    alarm = after(bench, at, [sign * watts for watts in (60.0, 2.0, 90.0)])
    assert (alarm.active, alarm.times, alarm.cause) == (1, 1, cause)
    assert after(bench, at, [0.0] * 12).active
    assert not after(bench, at, [0.0] * 2).active


def test_too_little_after_too_much_is_another_alarm(bench: "Bench", at: At) -> None:
    bench.steady = bench.moving = True
    assert after(bench, at, [20.0] * 14).cause == CapacityCause.TOO_MUCH
    alarm = after(bench, at, [-40.0] * 2)
    assert (alarm.active, alarm.times, alarm.cause) == (1, 2, CapacityCause.TOO_LITTLE)
    assert raised(bench) == [20.0, 40.0]


def test_a_shortage_that_does_not_last_is_none(bench: "Bench", at: At) -> None:
    bench.steady = bench.moving = True
    assert after(bench, at, [40.0] * 7 + [0.0] + [40.0] * 7).times == 0


def test_it_returns_when_others_drive(bench: "Bench", at: At) -> None:
    bench.steady = bench.moving = True
    assert after(bench, at, [40.0] * 14).active
    bench.program.operate(Operator(OperatorMode.CLASSICAL, tuple(bench.program.applied)))
    bench.scans(2 + 4 * 30)
    assert bench.program.mode is Mode.CLASSICAL
    assert not bench.program.alarms.rows[AlarmKind.CAPACITY].active
