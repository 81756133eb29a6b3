"""What operators write to the rack is taken whole, or refused and nothing has happened; and it is known who did it."""

import math
import struct
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.codec import from_words
from coldloop.registers.common import EventKind, JournalAnswer, JournalPage, JournalQuery
from coldloop.registers.plant import (
    LOAD_ROWS,
    LoadStep,
    Measurement,
    OutputVerdict,
    PlantSession,
    SensorFault,
    SensorFaultKind,
)
from coldloop.service.journal import ANY_SUBJECT

if TYPE_CHECKING:
    from tests.plant.conftest import RackOnTheBus

    SwitchOn = type[RackOnTheBus]

U = (43.0, 80.0, 36.0)
SESSION_ADDRESS, LOAD_ADDRESS = 400, 1000


def float_write(address: int, value: float) -> bytes:
    return struct.pack(">BHHBf", 16, address, 2, 4, value)


@pytest.fixture
def under_way(switch_on: "SwitchOn") -> "RackOnTheBus":
    """A rack in the middle of a session in real time, with a load table of two steps."""
    rack = switch_on(session={"mode": "realtime"})
    for row, step in enumerate((LoadStep(0, 385.0), LoadStep(40, 300.0))):
        rack.operator.write(step, row)
    rack.operator.write(PlantSession(5, 1, 1.0, 1, 2))
    rack.client("control PLC", 77).send(*U)
    rack.passes(10)
    return rack


@pytest.mark.parametrize(
    ("session", "reason"),
    [
        (PlantSession(6, 1, 1.0, 1, 0), "no load"),
        (PlantSession(6, 1, 1.0, 1, 3), "rows that were never written"),
        (PlantSession(6, 1, 1.0, 1, LOAD_ROWS), "a table that is not there"),
        (PlantSession(6, 1, 1.0, 1, LOAD_ROWS + 1), "more rows than there are"),
        (PlantSession(0, 1, 1.0, 1, 1), "no number"),
        (PlantSession(6, 2, 1.0, 1, 1), "neither lock-step nor real time"),
        (PlantSession(6, 1, 0.0, 1, 1), "no factor"),
        (PlantSession(6, 1, math.nan, 1, 1), "a factor that is no number"),
        (PlantSession(6, 1, math.inf, 1, 1), "a factor that is not finite"),
    ],
)
def test_a_session_that_cannot_begin_is_refused_and_the_plant_goes_on(
    under_way: "RackOnTheBus", session: PlantSession, reason: str
) -> None:
    operator, before = under_way.operator, under_way.shown()
    sessions = len(under_way.events(EventKind.SESSION))
    assert operator.write(session) == (3,), reason
    assert under_way.shown() == before
    assert operator.read(PlantSession) == PlantSession(5, 1, 1.0, 1, 2)
    under_way.passes(2)
    assert under_way.shown().tick == 12
    assert len(under_way.events(EventKind.SESSION)) == sessions


def test_a_part_of_a_session_is_judged_as_the_session_that_results(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    realtime = struct.pack(">BHH", 6, SESSION_ADDRESS + 2, 1)
    load_steps = struct.pack(">BHH", 6, SESSION_ADDRESS + 7, 2)
    for request in (realtime, load_steps, float_write(SESSION_ADDRESS + 3, 2.0)):
        assert rack.operator.request(request) == (3,), "at boot there is no session to be changed"
    rack.operator.write(PlantSession(2, 0, 1.0, 1, 1))
    assert rack.operator.request(load_steps) == (3,), "the second row is not in use"
    assert rack.shown().session == 2
    assert not isinstance(rack.operator.request(realtime), tuple)
    assert rack.operator.read(PlantSession) == PlantSession(2, 1, 1.0, 1, 1)


@pytest.mark.parametrize(
    "steps",
    [
        [LoadStep(1, 385.0)],
        [LoadStep(0, 1.0), LoadStep(0, 2.0)],
        [LoadStep(0, 1.0), LoadStep(9, 2.0), LoadStep(8, 1.0)],
    ],
)
def test_a_load_that_does_not_begin_at_tick_0_and_go_on_is_refused(
    switch_on: "SwitchOn", steps: list[LoadStep]
) -> None:
    rack = switch_on()
    for row, step in enumerate(steps):
        assert rack.operator.write(step, row) is None
    assert rack.operator.write(PlantSession(2, 0, 1.0, 1, len(steps))) == (3,)
    assert rack.shown().session == 1


@pytest.mark.parametrize("watts", [math.nan, math.inf, -math.inf, -1.0, 1e30, COLD_BOX.load.stored_span[1] * 1.001])
def test_a_load_that_is_none_is_refused(under_way: "RackOnTheBus", watts: float) -> None:
    assert under_way.operator.write(LoadStep(40, watts), 1) == (3,)
    assert under_way.operator.request(float_write(LOAD_ADDRESS + 6, watts)) == (3,)
    assert under_way.operator.read(LoadStep, 1) == LoadStep(40, 300.0)


@pytest.mark.parametrize("fault", [SensorFault(4, 0.0), SensorFault(3, math.nan), SensorFault(3, math.inf)])
def test_a_sensor_fault_that_is_none_is_refused(under_way: "RackOnTheBus", fault: SensorFault) -> None:
    before = under_way.shown()
    assert under_way.operator.write(fault, 2) == (3,)
    assert under_way.shown() == before


def test_what_was_done_and_who_did_it_can_be_looked_up(under_way: "RackOnTheBus") -> None:
    operator = under_way.operator
    operator.write(SensorFault(SensorFaultKind.VALUE, 4.5), 3)
    operator.write(JournalQuery(0, 0, ANY_SUBJECT))
    found: list[JournalAnswer] = []
    while True:
        page = operator.read(JournalPage)
        found += [operator.read(JournalAnswer, row) for row in range(page.found)]
        if not page.next_first:
            break
        operator.write(JournalQuery(page.next_first, 0, ANY_SUBJECT))
    told = [(EventKind(event.kind).name, event.subject, event.value, from_words(event.who)) for event in found]
    assert told == [
        ("BOOT", 0, 0.0, ""),
        ("LOAD", 0, 385.0, "operator"),
        ("LOAD", 1, 300.0, "operator"),
        ("SESSION", 1, 1.0, "operator"),
        ("LOAD", 0, 385.0, "operator"),
        ("LEASE", 1, 0.0, "control PLC"),
        ("SENSOR_FAULT", 3, 4.5, "operator"),
    ]
    assert [event.number for event in found] == list(range(1, 8))


def test_a_load_table_that_is_written_is_one_event_a_request(switch_on: "SwitchOn") -> None:
    rack = switch_on()
    rows = b"".join(struct.pack(">If", tick, 300.0 + tick) for tick in range(30))
    rack.operator.request(struct.pack(">BHHB", 16, LOAD_ADDRESS, 120, 240) + rows)
    assert [(event.subject, event.value) for event in rack.events(EventKind.LOAD)] == [(29, 329.0)]


def test_operators_do_not_write_outputs(under_way: "RackOnTheBus") -> None:
    operator = under_way.operator
    assert operator.exchange(operator.outputs(*U)) == (1,)
    assert operator.read(Measurement).verdict == OutputVerdict.ACCEPTED
