"""What the registers of the rack show of compression station and nitrogen, and what operators give."""

from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.common import EventKind
from coldloop.registers.plant import (
    STATION_ROWS,
    PlantSession,
    StationAlarm,
    StationMode,
    StationSample,
    StationStatus,
    Surroundings,
)
from coldloop.service.journal import describe

if TYPE_CHECKING:
    from conftest import RackOnTheBus

REST = (43.0, 75.0, 36.0)


@pytest.fixture
def rack(switch_on: "type[RackOnTheBus]") -> "RackOnTheBus":
    return switch_on(kind="refrigerator")


def test_the_station_is_shown_now_and_over_the_last_ticks(rack: "RackOnTheBus") -> None:
    control = rack.client("control")
    for _ in range(3):
        control.send(*REST)
    now = rack.operator.read(StationStatus)
    assert now.tick == 3
    assert now.signals[:3] == pytest.approx((1.05, 16.0, 6.0), abs=1e-4)
    assert now.commands[0] == pytest.approx(26.94, abs=0.01)
    assert (now.mode, now.alarms) == (StationMode.AUTOMATIC, 0)
    assert [rack.operator.read(StationSample, row).tick for row in range(3)] == [0, 1, 2]


def test_a_compressor_that_an_operator_trips_is_told_in_alarms_mode_and_journal(rack: "RackOnTheBus") -> None:
    control = rack.client("control")
    control.send(*REST)
    assert rack.operator.write(Surroundings(nc2=0)) is None
    for _ in range(4):
        control.send(*REST)
    now = rack.operator.read(StationStatus)
    assert now.mode == StationMode.ONE_COMPRESSOR
    assert now.alarms & StationAlarm.NC2_TRIPPED
    told = [describe(event, COLD_BOX).sentence for kind in STATION_EVENTS for event in rack.events(kind)]
    assert any("nc2" in sentence and "operator" in sentence for sentence in told), told
    assert any("nc2 tripped (raised)" in sentence for sentence in told), told
    assert any("one compressor" in sentence for sentence in told), told


STATION_EVENTS = (EventKind.SURROUNDINGS, EventKind.STATION_ALARM, EventKind.STATION_MODE)


def test_a_new_session_has_its_configured_surroundings_again(rack: "RackOnTheBus") -> None:
    rack.client("control").send(*REST)
    rack.operator.write(Surroundings(leak=3.0))
    rack.operator.write(PlantSession(2, 0, 1.0, 1, 1))
    assert rack.operator.read(Surroundings) == Surroundings()
    assert rack.operator.read(StationStatus).tick == 0


@pytest.mark.parametrize("bad", [{"nc1": 2}, {"leak": -1.0}, {"ambient": 20.0}])
def test_surroundings_that_cannot_be_are_refused(rack: "RackOnTheBus", bad: dict[str, float]) -> None:
    assert rack.operator.write(Surroundings()._replace(**bad)) is not None
    assert rack.operator.read(Surroundings) == Surroundings()


def test_a_cold_box_alone_has_no_station_and_refuses_surroundings(switch_on: "type[RackOnTheBus]") -> None:
    rack = switch_on()
    rack.client("control").send(*REST)
    assert rack.operator.write(Surroundings(nc1=0)) is not None
    assert rack.operator.read(StationStatus) == StationStatus()
    assert not any(any(rack.operator.read(StationSample, row).signals) for row in (0, 1, STATION_ROWS - 1))
