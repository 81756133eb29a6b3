"""One client writes the outputs: a second one is refused, counted and noted, until the first one is gone."""

from typing import TYPE_CHECKING

import pytest

from coldloop.registers.codec import from_words
from coldloop.registers.common import EventKind, LeaseEvent, LeaseState, LeaseStatus, WatchdogTime
from coldloop.registers.plant import OutputVerdict

if TYPE_CHECKING:
    from tests.plant.conftest import RackOnTheBus

    SwitchOn = type[RackOnTheBus]

U = (43.0, 80.0, 36.0)
OTHER = (30.0, 10.0, 30.0)
REALTIME = {"mode": "realtime"}


def lease_events(rack: "RackOnTheBus") -> list[tuple[LeaseEvent, str]]:
    return [(LeaseEvent(event.subject), from_words(event.who)) for event in rack.events(EventKind.LEASE)]


@pytest.mark.parametrize("number", [0, 78])
def test_a_second_writer_is_refused_counted_and_noted(switch_on: "SwitchOn", number: int) -> None:
    rack = switch_on()
    first, second = rack.client("first", 77), rack.client("second", number)
    first.send(*U)
    for _ in range(20):
        assert second.exchange(second.outputs(*OTHER)) == (6,)
        assert second.write(WatchdogTime(0)) == (6,)
    shown = rack.shown()
    assert (shown.u, shown.holder, shown.verdict, shown.tick) == (U, 77, OutputVerdict.ACCEPTED, 1)
    status = second.read(LeaseStatus)
    assert (status.state, status.holder, status.refused) == (LeaseState.HELD, 77, 40)
    assert from_words(status.who) == "first"
    assert lease_events(rack) == [(LeaseEvent.GRANTED, "first"), (LeaseEvent.REFUSED, "second")]
    rack.now += 9.9
    first.send(*U)
    rack.now += 0.2
    assert second.exchange(second.outputs(*OTHER)) == (6,)
    assert len(lease_events(rack)) == 3, "one that goes on is noted every 10 s"
    assert not rack.events(EventKind.WATCHDOG_TIME)


@pytest.mark.parametrize(
    ("session", "watchdog_s", "silence_s"),
    [
        ({"mode": "realtime", "factor": 1.0}, 10.0, 10.0),
        ({"mode": "realtime", "factor": 50.0}, 10.0, 0.2),
        ({"mode": "realtime", "factor": 50.0}, 0.0, 10.0),
        ({"mode": "lockstep", "factor": 50.0}, 4.0, 4.0),
        ({"mode": "lockstep"}, 0.0, 10.0),
    ],
)
def test_the_lease_ends_with_silence(
    switch_on: "SwitchOn", session: dict[str, object], watchdog_s: float, silence_s: float
) -> None:
    rack = switch_on(session=session, watchdog={"timeout_s": watchdog_s})
    first, second = rack.client("first", 77), rack.client("second", 78)
    first.send(*U)
    rack.now += 0.99 * silence_s
    assert second.exchange(second.outputs(*U)) == (6,)
    rack.now += 0.02 * silence_s
    assert second.read(LeaseStatus).state == LeaseState.FREE
    assert second.send(*U, generation=1).verdict == OutputVerdict.CHANGED, "the first one has written since"
    assert second.send(*U, generation=2).verdict == OutputVerdict.ACCEPTED
    assert first.exchange(first.outputs(*U)) == (6,)
    assert lease_events(rack)[2:] == [
        (LeaseEvent.ENDED, "first"),
        (LeaseEvent.GRANTED, "second"),
        (LeaseEvent.REFUSED, "first"),
    ]


def test_outputs_that_are_not_for_now_do_not_keep_the_lease(switch_on: "SwitchOn") -> None:
    """Who is in another session does not keep out who is in this one."""
    rack = switch_on(session=REALTIME)
    lost, plc = rack.client("lost", 77), rack.client("control PLC", 78)
    for changed in ({"session": 9}, {"tick": 5000}):
        lost.send(*OTHER, **changed)
    assert plc.send(*U, generation=1).verdict == OutputVerdict.ACCEPTED


def test_the_silent_holder_goes_on_when_nobody_else_has_written(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    plc = rack.client("control PLC", 77)
    plc.send(*U, generation=1)
    rack.now += 600.0
    assert plc.send(*U, generation=1).verdict == OutputVerdict.ACCEPTED


def test_a_simple_client_hands_over_by_closing(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    simple, plc = rack.client("simple"), rack.client("control PLC", 77)
    simple.send(*U)
    assert plc.exchange(plc.outputs(*U)) == (6,)
    simple.closes()
    assert plc.read(LeaseStatus) == LeaseStatus(refused=1)
    assert plc.send(*U, generation=1).verdict == OutputVerdict.CHANGED
    assert lease_events(rack)[2:] == [(LeaseEvent.ENDED, "simple"), (LeaseEvent.GRANTED, "control PLC")]


def test_a_control_plc_comes_back_over_another_connection(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME)
    plc, simple = rack.client("control PLC", 77), rack.client("simple")
    plc.send(*U)
    plc.closes()
    assert simple.exchange(simple.outputs(*OTHER)) == (6,), "for a moment only the same one may"
    again = rack.client("control PLC", 77)
    assert again.send(*U, generation=1).verdict == OutputVerdict.ACCEPTED
    plc.closes()
    assert again.read(LeaseStatus).state == LeaseState.HELD, "the old connection says nothing any more"
    again.closes()
    rack.passes(5)
    assert simple.send(*OTHER).u == OTHER
    kinds = [event for event, _ in lease_events(rack)]
    assert kinds == [LeaseEvent.GRANTED, LeaseEvent.REFUSED, LeaseEvent.ENDED, LeaseEvent.GRANTED]


def test_a_gateway_that_mixes_two_control_plcs_is_a_break_each_time(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    gateway = rack.client("gateway", 77)
    gateway.send(*U, generation=1)
    gateway.number = 78
    assert gateway.send(*U, generation=1).verdict == OutputVerdict.CHANGED
    assert gateway.send(*U, generation=2).verdict == OutputVerdict.ACCEPTED
    gateway.number = 77
    assert gateway.send(*U, generation=2).verdict == OutputVerdict.CHANGED


def test_the_watchdog_may_be_set_while_nobody_writes_outputs(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    assert rack.client("commissioning").write(WatchdogTime(8)) is None
    (event,) = rack.events(EventKind.WATCHDOG_TIME)
    assert (event.subject, event.cause, from_words(event.who)) == (8, 40, "commissioning")
    assert rack.client("control PLC", 77).send(*U).verdict == OutputVerdict.ACCEPTED, "that was no lease"
