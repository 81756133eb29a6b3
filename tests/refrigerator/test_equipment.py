"""Machinery of the refrigerator: starts in their order, the turbine's protection, what is stuck, what blocks up."""

from collections.abc import Sequence

import numpy as np
import pytest

from coldloop.process.cold_box import OUTPUT_NAMES
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.plant import StationAlarm, StationMode, Surroundings
from coldloop_plant.settings import RefrigeratorEvent, StationSettings
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_refrigerator.program import SHIPPED, EventSchedule, RefrigeratorProgram, read_refrigerator_file
from coldloop_refrigerator.station_control import station_law
from coldloop_refrigerator.tick import (
    ADMISSION,
    BLOCKED,
    GIVEN_NAMES,
    MOST_BLOCKED,
    act,
    further_drop,
    loaded_compressors,
    resting_equipment,
    start_compressors,
    throttled,
)

FILE = read_refrigerator_file(SHIPPED)
V1, T3 = OUTPUT_NAMES.index("V1"), OUTPUT_NAMES.index("T3")
NC1_SPEED, NC2_SPEED = -5, -4
CV956 = -3


AT_REST = LoadProfile((0,), (FILE.w0,))


def make(
    events: Sequence[tuple[float, str, float]],
    load: LoadProfile = AT_REST,
    protection: dict[str, list[float]] | None = None,
    **turbine: float,
) -> RefrigeratorProgram:
    listed = [RefrigeratorEvent.model_validate({"at_s": at, "target": what, "value": to}) for at, what, to in events]
    return RefrigeratorProgram(
        file=FILE,
        u0=FILE.u0,
        load=load,
        station=StationSettings.model_validate({"turbine": turbine, "protection": protection or {}}),
        events=EventSchedule(listed, 300.0, 0.0),
    )


def run(program: RefrigeratorProgram, seconds: float) -> None:
    for _ in range(round(4 * seconds)):
        program.advance()


def given(**changed: float) -> np.ndarray:
    """Return what is given in a tick with all in order but for this."""
    values = dict.fromkeys(GIVEN_NAMES, 0.0) | dict.fromkeys(
        ("nitrogen", "NC1", "NC2", "turbine", "cv155", "cv156", "heater"), 1.0
    )
    return np.array(list((values | changed).values()))


def test_with_all_in_order_what_is_asked_acts_to_the_bit() -> None:
    memory, u, d = resting_equipment(np.array(FILE.u0)), np.array([41.3, 77.7, 35.1]), given(T_ambient=300.0)
    law = station_law(StationSettings(), FILE.gains, FILE.v0, REFERENCE_REFRIGERATOR.station).equipment
    acting = act(law, memory, u, d, 1.05, 0.9, 2400.0, REFERENCE_REFRIGERATOR)
    assert acting.u.tolist() == u.tolist()
    assert acting.d.tolist() == d.tolist()
    assert acting.plant == REFERENCE_REFRIGERATOR


def test_compressors_start_one_after_the_other_idle_first_with_the_cold_box_isolated() -> None:
    """Both are switched on at 60 s: NC1 idles until 70 s and is loaded until 120 s, NC2 after it."""
    program = make([(10.0, "nc1", 0), (10.0, "nc2", 0), (60.0, "nc1", 1), (60.0, "nc2", 1)])
    run(program, 69.0)
    assert program.station.mode == StationMode.STARTING
    assert program.memory.x[NC1_SPEED] == pytest.approx(0.25 * (1.0 - np.exp(-9.0 / 6.0)), abs=0.01)
    assert program.memory.x[NC2_SPEED] == pytest.approx(0.0, abs=1e-6)
    run(program, 40.0)
    assert 10.0 < program.memory.x[CV956] < 90.0, "as far as the low-pressure line has room"
    assert program.station_status.acting == (0.0, 0.0, 0.0)
    assert program.memory.x[NC2_SPEED] == pytest.approx(0.0, abs=1e-6)
    run(program, 16.0)
    assert program.station.mode == StationMode.ONE_COMPRESSOR
    assert program.station_status.acting[0] == FILE.u0[0]
    run(program, 120.0)
    assert program.station.mode not in {StationMode.ONE_COMPRESSOR, StationMode.STARTING, StationMode.STOPPED}
    assert program.memory.x[NC2_SPEED] > 0.9


def test_a_low_suction_pressure_stops_one_compressor_then_the_other_until_they_are_switched_off() -> None:
    law = station_law(StationSettings(), FILE.gains, FILE.v0, REFERENCE_REFRIGERATOR.station).equipment
    memory = resting_equipment(np.array(FILE.u0))
    for lp, state in ((0.81, (1.0, 1.0)), (0.79, (1.0, -1.0)), (0.74, (-1.0, -1.0)), (1.05, (-1.0, -1.0))):
        d = given()
        start_compressors(law, memory, d, lp, 0.9)
        assert tuple(memory[:2]) == state
        assert loaded_compressors(memory, given()) == state.count(1.0)
        assert list(d[[GIVEN_NAMES.index("NC1"), GIVEN_NAMES.index("NC2")]]) == [max(one, 0.0) for one in state]
    start_compressors(law, memory, given(NC1=0.0), 1.05, 0.9)
    start_compressors(law, memory, given(), 1.05, 0.9)
    assert 0.0 < memory[0] < 1.0
    assert memory[1] == -1.0


def test_a_suction_trip_is_alarmed_and_ends_when_it_is_switched_off() -> None:
    protection = {"trip_lp_bar": [0.0, 0.94], "lp_bar": [0.96, 0.95]}
    program = make([(5, "turbine", 0), (10, "turbine", 1), (60, "nc2", 0), (61, "nc2", 1)], protection=protection)
    run(program, 20)
    tripped = StationAlarm.SUCTION_TRIP | StationAlarm.NC2_TRIPPED
    assert program.station.alarms & (tripped | StationAlarm.NC1_TRIPPED) == tripped
    run(program, 120)
    assert not program.station.alarms & tripped


def test_a_turbine_that_trips_stops_at_once_and_runs_up_in_a_minute() -> None:
    program = make([(10.0, "turbine", 0), (70.0, "turbine", 1)])
    run(program, 11.0)
    assert program.measure()[V1] == 0.0
    assert program.station.alarms & StationAlarm.TURBINE_TRIPPED
    assert program.station_status.acting == (43.0, 75.0, 0.0)
    run(program, 89.0)
    assert 0.0 < program.station_status.acting[2] < 36.0 * 0.5, "30 s after it was switched on"
    assert not program.station.alarms & StationAlarm.TURBINE_TRIPPED
    run(program, 90.0)
    assert program.station_status.acting[2] == 36.0


def test_the_governor_holds_the_speed_of_a_warm_turbine_below_its_trip() -> None:
    program = make([(10.0, "turbine", 0), (310.0, "turbine", 1)], governed_hz=2200.0, overspeed_hz=2420.0)
    run(program, 309.0)
    fastest = 0.0
    for _ in range(4 * 120):
        program.advance()
        fastest = max(fastest, program.measure()[V1])
    assert 2000.0 < fastest < 2300.0
    assert not program.station.alarms & StationAlarm.OVERSPEED


def test_a_valve_that_is_stuck_open_leaves_it_to_the_trip_which_holds_until_it_is_switched_off() -> None:
    program = make(
        [(5.0, "cv156", 0), (10.0, "turbine", 0), (310.0, "turbine", 1)], governed_hz=2200, overspeed_hz=2420
    )
    run(program, 330.0)
    assert program.station.alarms & StationAlarm.OVERSPEED
    assert program.station.alarms & StationAlarm.TURBINE_TRIPPED
    assert program.measure()[V1] == 0.0
    program.give(Surroundings(turbine=0))
    run(program, 1.0)
    program.give(Surroundings())
    run(program, 120.0)
    assert program.station.alarms & (StationAlarm.OVERSPEED | StationAlarm.TURBINE_TRIPPED) == 0
    assert program.measure()[V1] > 1500.0


def test_a_stuck_valve_holds_its_opening_whatever_is_asked_until_it_is_free() -> None:
    program = make([(10.0, "cv155", 0), (20.0, "cv155", 1)])
    run(program, 11.0)
    program.apply((50.0, 75.0, 36.0))
    run(program, 2.0)
    assert program.station_status.acting == (43.0, 75.0, 36.0)
    assert program.station.alarms == StationAlarm.ACTUATOR
    run(program, 8.0)
    assert program.station_status.acting == (50.0, 75.0, 36.0)
    assert program.station.alarms == 0


@pytest.mark.parametrize(("state", "watts"), [(0, 0.0), (1, 75.0), (2, 150.0)])
def test_a_heater_is_off_as_asked_or_fully_on(state: int, watts: float) -> None:
    program = make([(0.0, "heater", state)])
    run(program, 1.0)
    assert program.station_status.acting == (43.0, watts, 36.0)
    assert bool(program.station.alarms & StationAlarm.ACTUATOR) == (watts != 75.0)


def test_an_exchanger_blocks_up_as_fast_as_it_is_given_and_no_further() -> None:
    program = make([(0.0, "blocked_nef2", 1.0), (1800.0, "blocked_nef2", -10.0)])
    warm = program.measure()[T3]
    run(program, 1800.0)
    assert program.memory.equipment[BLOCKED + 1] == pytest.approx(0.5)
    assert program.measure()[T3] > warm + 0.3, "what reaches NEF1 is warmer"
    run(program, 600.0)
    assert program.memory.equipment[BLOCKED + 1] == 0.0
    program = make([(0.0, "blocked_nef34", 10.0)])
    run(program, 3600.0 * 0.098 + 60.0)
    assert program.memory.equipment[BLOCKED + 2] == MOST_BLOCKED


@pytest.mark.usefixtures("compiles")
def test_half_blocked_an_exchanger_adds_three_clean_pressure_drops() -> None:
    """1/0.5^2 - 1 = 3; CV155 alone, of 14.77 bar at 43 %, then is as one of 43/sqrt(1 + 3 0.05/14.77) = 42.78 %."""
    assert further_drop(0.5) == 3.0
    assert throttled(43.0, 0, 3.0) == pytest.approx(42.783, abs=1e-3)
    assert throttled(43.0, 0, 0.0) == 43.0


CHANGES = [
    (1.0, "leak", 0.5), (2.0, "ambient", 301.0), (3.0, "nitrogen", 0), (4.0, "nc1", 0), (5.0, "cv155", 0),
    (6.0, "turbine", 0), (7.0, "nc2", 0), (8.0, "blocked_nef34", 8.0), (14.0, "nc1", 1),
]  # fmt: skip


def test_a_tick_that_begins_with_what_the_last_one_read_is_the_same_to_the_bit() -> None:
    """A resumed program has read nothing: it evaluates its first stage anew, in every tick."""
    load = LoadProfile((0, 50), (FILE.w0, FILE.w0 + 60.0))
    going_on, anew = make(CHANGES, load), make(CHANGES, load)
    for tick in range(60):
        u = [value + tick // 12 % 2 for value in FILE.u0]
        going_on.apply(u)
        retained = anew.retained()
        anew = make(CHANGES, load)
        anew.resume(**retained)
        anew.apply(u)
        going_on.advance()
        anew.advance()
        assert going_on.memory.x.tolist() == anew.memory.x.tolist(), tick


def test_what_is_stuck_tripped_and_blocked_survives_a_restart_of_the_rack() -> None:
    events = [(5.0, "cv155", 0), (10.0, "turbine", 0), (20.0, "turbine", 1), (0.0, "blocked_nef1", 5.0)]
    first, second = make(events), make(events)
    run(first, 40.0)
    assert 0.0 < first.memory.equipment[ADMISSION] < 1.0
    first.apply((50.0, 60.0, 40.0))
    run(first, 5.0)
    second.resume(**first.retained())
    run(first, 60.0)
    run(second, 60.0)
    assert first.state == second.state
    assert first.station_status.acting == second.station_status.acting
    assert first.memory.equipment.tolist() == second.memory.equipment.tolist()
