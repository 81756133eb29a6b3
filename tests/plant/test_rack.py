"""The rack's outputs: taken from one writer that knows what is applied, or not at all; and sensors that fail."""

import math
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import L1, T5
from coldloop.process.declaration import LAST_TICK
from coldloop.registers.common import EventKind, SessionPace, WatchdogState, WatchdogStatus, WatchdogTime
from coldloop.registers.plant import (
    Actuators,
    LiveLoad,
    LoadAhead,
    LoadStatus,
    LoadStep,
    Measurement,
    OutputVerdict,
    PlantSample,
    PlantSession,
    SensorFault,
    SensorFaultKind,
)
from tests.harness.records import sealed

if TYPE_CHECKING:
    from tests.plant.conftest import RackOnTheBus

    SwitchOn = type[RackOnTheBus]

U = (43.0, 80.0, 36.0)
SAFE = (30.0, 50.0, 40.0)
SAFE_AFTER_5_S = {"timeout_s": 5.0, "action": "safe", "safe_state": SAFE}
REALTIME = {"mode": "realtime"}


# -- what is applied, and by whom --------------------------------------------------------------------------------------


def test_a_measurement_shows_what_is_applied_whose_it_is_and_that_it_was_taken(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    plc = rack.client("control PLC", 77)
    begun = rack.shown()
    assert (begun.tick, begun.session, begun.holder, begun.generation) == (0, 1, 0, 1)
    assert (begun.verdict, begun.age) == (OutputVerdict.NONE, 0.0)
    answer = plc.send(*U, generation=1)
    assert (answer.tick, answer.u, answer.holder, answer.generation) == (0, U, 77, 1)
    assert answer.verdict == OutputVerdict.ACCEPTED
    assert rack.shown() == sealed(plc.read(Measurement))
    assert (rack.shown().tick, rack.shown().u) == (1, U), "a reader sees the present tick"


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [
        ({"tick": 0}, OutputVerdict.STALE),
        ({"tick": 7}, OutputVerdict.STALE),
        ({"session": 9}, OutputVerdict.WRONG_SESSION),
        ({"session": 0}, OutputVerdict.WRONG_SESSION),
        ({"generation": 2}, OutputVerdict.CHANGED),
    ],
)
def test_outputs_that_are_not_for_now_are_not_taken_and_the_answer_says_why(
    switch_on: "SwitchOn", changed: dict[str, int], verdict: OutputVerdict
) -> None:
    rack = switch_on()
    plc = rack.client("control PLC", 77)
    plc.send(*U)
    answer = plc.send(44.0, 70.0, 37.0, **changed)
    assert (answer.verdict, answer.u, answer.generation) == (verdict, U, 1)
    assert rack.tick == 1
    applied = plc.read(Actuators)
    assert applied.u == U, "what is applied is read back, not what was refused"
    assert plc.send(44.0, 70.0, 37.0).verdict == OutputVerdict.ACCEPTED


def test_damaged_outputs_are_refused_and_a_simple_client_need_not_seal(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    plc = rack.client("control PLC", 77)
    plc.send(*U)
    assert plc.exchange(plc.outputs(50.0, 80.0, 36.0)._replace(u=(50.5, 80.0, 36.0))) == (3,)
    shown = rack.shown()
    assert (shown.u, shown.verdict, shown.tick) == (U, OutputVerdict.ACCEPTED, 1), "nothing has happened"
    plc.closes()
    rack.now += 2.0
    simple = rack.client("simple client")
    assert simple.send(44.0, 80.0, 36.0).u == (44.0, 80.0, 36.0)


def test_outputs_are_written_whole(switch_on: "SwitchOn") -> None:
    """Who completes a part of the record with the rest of another's would write in its name."""
    rack = switch_on(session=REALTIME)
    rack.client("control PLC", 77).send(*U)
    meddler = rack.client("meddler")
    assert meddler.request(bytes.fromhex("10 0066 0002 04 42480000")) == (3,)
    assert rack.shown().u == U


def test_in_real_time_what_a_network_held_up_is_not_applied(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME)
    plc = rack.client("control PLC", 77)
    plc.send(*U)
    rack.passes(40)
    for tick, verdict in ((31, "STALE"), (49, "STALE"), (32, "ACCEPTED"), (48, "ACCEPTED")):
        assert plc.send(*U, tick=tick).verdict == OutputVerdict[verdict], tick


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_session_ends_at_its_last_tick_and_another_one_begins(switch_on: "SwitchOn", mode: str) -> None:
    rack = switch_on(session={"mode": mode})
    plc = rack.client("control PLC", 77)
    rack.registers.rack.program.tick = LAST_TICK - 1  # 34 years are too long
    assert plc.send(*U).verdict == OutputVerdict.ACCEPTED
    if mode == "realtime":
        rack.registers.advance()
    assert (rack.tick, rack.registers.rack.has_ended) == (LAST_TICK, True)
    assert plc.send(*U).verdict == OutputVerdict.STALE
    assert rack.tick == LAST_TICK
    assert plc.exchange(plc.outputs(*U, tick=LAST_TICK + 1)) == (3,)
    assert rack.operator.read(LoadStatus).watts > 0
    assert rack.operator.write(PlantSession(0xFFFF_FFFF, 0, 1.0, 1, 1)) is None
    assert plc.send(*U).verdict == OutputVerdict.ACCEPTED
    assert rack.operator.write(PlantSession(1, 0, 1.0, 1, 1)) is None


def test_no_load_is_taken_for_a_tick_that_never_comes(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    assert rack.operator.write(LoadStep(LAST_TICK + 1, 300.0), 1) == (3,)
    assert rack.operator.write(LiveLoad(0xFFFF_FFFF, 300.0)) == (3,)
    ahead = LoadAhead.first_of(1, [LAST_TICK - 1, LAST_TICK + 60_000], [300.0, 310.0])
    assert rack.operator.write(ahead) == (3,)
    assert rack.operator.write(LoadAhead.first_of(1, [LAST_TICK - 1, LAST_TICK], [300.0, 310.0])) is None
    assert rack.operator.read(LoadStatus).last_tick == LAST_TICK


def test_nobody_moves_an_output_by_more_than_its_rate_in_a_tick_however_often_it_is_written(
    switch_on: "SwitchOn",
) -> None:
    rack = switch_on(session=REALTIME, rate_limited=True)
    plc = rack.client("control PLC", 77)
    start = rack.shown().u
    plc.send(*start)
    rack.passes(1)
    first = plc.send(*map(float.__add__, start, (0.5, -10.0, 0.1)))
    assert first.verdict == OutputVerdict.ACCEPTED
    for _ in range(3):  # within the same tick
        again = plc.send(*map(float.__add__, first.u, (0.5, -10.0, 0.1)), generation=0)
        assert (again.verdict, again.u) == (OutputVerdict.LIMITED, pytest.approx(first.u, rel=1e-6))
    rack.passes(1)
    far = plc.send(0.0, 1000.0, 100.0)
    assert far.verdict == OutputVerdict.LIMITED
    assert far.u == pytest.approx([again.u[0] - 0.5, again.u[1] + 10.0, again.u[2] + 0.1], rel=1e-6)
    assert (far.holder, far.generation) == (77, first.generation + 4), "it is to be read back"
    assert plc.send(*far.u, generation=first.generation).verdict == OutputVerdict.CHANGED
    assert rack.operator.read(WatchdogStatus).lowest >= 38, "outputs that are limited are a sign of life"


def test_the_safe_state_is_applied_in_one_step_also_by_a_rack_that_limits(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME, watchdog=SAFE_AFTER_5_S, rate_limited=True)
    rack.client("control PLC", 77).send(*U)
    rack.passes(20)
    assert rack.shown().u == SAFE


# -- breaks ------------------------------------------------------------------------------------------------------------


def test_a_control_plc_that_slept_through_the_safe_state_makes_no_step(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME, watchdog=SAFE_AFTER_5_S)
    plc = rack.client("control PLC", 77)
    plc.send(*U, generation=1)
    rack.passes(20)
    assert rack.shown().u == SAFE
    woken = plc.send(43.1, 80.0, 36.0, generation=1)
    assert woken.verdict == OutputVerdict.CHANGED
    assert (woken.u, woken.holder, woken.generation) == (SAFE, 0, 2)
    assert plc.send(30.1, 50.0, 40.0, generation=2).u == pytest.approx((30.1, 50.0, 40.0))


def test_what_a_simple_client_has_moved_is_read_back_before_the_control_plc_moves_on(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    restarted = rack.client("control PLC", 77)
    restarted.send(*U, generation=1)
    restarted.closes()
    rack.now += 2.0
    simple = rack.client("simple client")
    moved = simple.send(25.0, 80.0, 36.0)
    assert (moved.u[0], moved.holder, moved.generation) == (25.0, 0, 2)
    simple.closes()
    again = rack.client("control PLC", 78)
    first = again.send(*U, generation=1)
    assert (first.verdict, first.u[0], first.generation) == (OutputVerdict.CHANGED, 25.0, 3)
    assert again.send(25.5, 80.0, 36.0, generation=3).verdict == OutputVerdict.ACCEPTED


def test_a_session_that_begins_again_at_tick_0_is_a_break(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME)
    plc = rack.client("control PLC", 77)
    rack.operator.write(SensorFault(SensorFaultKind.VALUE, 1.0), T5)
    assert rack.operator.write(PlantSession(3, 1, 1.0, 1, 1)) is None, "the load table is one of 0 W"
    plc.send(*U)
    rack.passes(3)
    assert rack.operator.write(PlantSession(3, 1, 1.0, 1, 1)) is None, "the same number again"
    begun = rack.shown()
    assert (begun.tick, begun.session, begun.generation, begun.verdict) == (0, 3, 3, OutputVerdict.NONE)
    assert (begun.holder, begun.age) == (0, 0.0), "it waits for the first outputs"
    assert begun.y[T5] != 1.0
    assert rack.operator.read(SensorFault, T5).kind == SensorFaultKind.NONE
    assert plc.send(*U, generation=2).verdict == OutputVerdict.CHANGED
    assert plc.send(*U, generation=3).verdict == OutputVerdict.ACCEPTED
    assert [event.value for event in rack.events(EventKind.SESSION)] == [1.0, 1.0]


def test_a_session_that_begins_by_itself_shows_its_pace(switch_on: "SwitchOn") -> None:
    rack = switch_on(session={"mode": "realtime", "factor": 2.0})
    assert rack.operator.read(SessionPace) == SessionPace(1, 1, 2.0, 0)


def test_without_a_session_no_outputs_are_taken(switch_on: "SwitchOn") -> None:
    rack = switch_on(session={"autostart": False})
    assert rack.client("simple client").send(*U).verdict == OutputVerdict.WRONG_SESSION
    assert rack.tick == 0


def test_an_answer_that_was_lost_can_be_read_again(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME)
    plc = rack.client("control PLC", 77)
    plc.send(*U)
    plc.exchange(plc.outputs(44.0, 80.0, 36.0, generation=1))  # nobody gets the answer
    shown = plc.read(Measurement)
    assert (shown.u[0], shown.holder, shown.verdict) == (44.0, 77, OutputVerdict.ACCEPTED)


# -- time --------------------------------------------------------------------------------------------------------------


def test_age_grows_between_ticks_and_is_fresh_at_each_read(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME)
    rack.client("control PLC", 77).send(*U)
    rack.passes(1)
    ages = []
    for _ in range(3):
        ages.append(rack.shown().age)
        rack.now += 0.05
    assert ages == pytest.approx([0.0, 0.2, 0.4])
    rack.passes(1)
    assert (rack.shown().age, rack.shown().tick) == (0.0, 2)


@pytest.mark.parametrize(("action", "expected"), [("hold", U), ("safe", SAFE)])
def test_outputs_hold_or_go_to_the_safe_state_when_the_control_plc_is_silent(
    switch_on: "SwitchOn", action: str, expected: tuple[float, ...]
) -> None:
    rack = switch_on(session=REALTIME, watchdog={**SAFE_AFTER_5_S, "action": action})
    plc = rack.client("control PLC", 77)
    plc.send(*U)
    rack.passes(18)
    assert rack.shown().u == U
    assert plc.read(WatchdogStatus).state == WatchdogState.RUNNING
    rack.passes(2)
    shown = rack.shown()
    assert (shown.u, shown.generation) == (expected, 1 + (expected == SAFE))
    status = plc.read(WatchdogStatus)
    assert (status.time, status.state, status.trips) == (20, WatchdogState.EXPIRED, 1)
    assert plc.read(Actuators).u == expected
    assert [event.tick for event in rack.events(EventKind.WATCHDOG_EXPIRED)] == [20]
    assert plc.send(*U).u == U
    assert plc.read(WatchdogStatus).state == WatchdogState.RUNNING


def test_the_watchdog_is_set_by_the_writer_of_outputs_and_it_is_known_who_did(switch_on: "SwitchOn") -> None:
    rack = switch_on(session=REALTIME)
    plc = rack.client("control PLC", 77)
    plc.send(*U)
    assert plc.write(WatchdogTime(4)) is None
    rack.passes(4)
    assert plc.read(WatchdogStatus).trips == 1
    assert plc.write(WatchdogTime(0)) is None
    rack.passes(100)
    assert plc.read(WatchdogStatus)[1:] == (WatchdogState.OFF, 0, 0, 1)
    changes = [(event.subject, event.cause) for event in rack.events(EventKind.WATCHDOG_TIME)]
    assert changes == [(4, 40), (0, 4)]


# -- sensors -----------------------------------------------------------------------------------------------------------


def test_sensors_fail_on_purpose_and_the_history_keeps_the_truth(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    plc, operator = rack.client("control PLC", 77), rack.operator
    plc.send(*U)
    operator.write(SensorFault(SensorFaultKind.NOT_A_NUMBER, 0.0), L1)
    operator.write(SensorFault(SensorFaultKind.FROZEN, 0.0), T5)
    operator.write(SensorFault(SensorFaultKind.VALUE, 12.5), 4)
    shown = plc.send(*U).y
    for _ in range(8):
        y = plc.send(*U).y
    assert math.isnan(y[L1])
    assert (y[T5], y[4]) == (shown[T5], 12.5)
    true = operator.read(PlantSample, rack.tick - 1).y
    assert true[T5] != shown[T5]
    assert math.isfinite(true[L1])
    published = list(rack.registers.rack.snapshot()["outputs"].values())  # type: ignore[attr-defined]
    faulty = [published[output] for output in (L1, T5, 4)]
    assert faulty == pytest.approx([y[L1], y[T5], y[4]], nan_ok=True), "telemetry has what the registers have"
    for output in (L1, T5, 4):
        operator.write(SensorFault(SensorFaultKind.NONE, 0.0), output)
    assert all(map(math.isfinite, plc.send(*U).y))
    faults = [(event.subject, event.cause, event.value) for event in rack.events(EventKind.SENSOR_FAULT)]
    assert faults == [(L1, 1, 0.0), (T5, 2, 0.0), (4, 3, 12.5), (L1, 0, 0.0), (T5, 0, 0.0), (4, 0, 0.0)]
