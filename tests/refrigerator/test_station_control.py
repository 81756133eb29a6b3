"""The station's controller: both pressures are held, valves stay in their ranges, integrals do not wind up."""

from collections.abc import Sequence

import numpy as np
import pytest

from coldloop.errors import ConfigurationError, ModelFileError
from coldloop.process.cold_box import STATION_SIGNAL_NAMES
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, SHIPPED_MODELS
from coldloop.registers.plant import StationAlarm, StationMode, Surroundings
from coldloop_plant.kinds import plant_maker
from coldloop_plant.settings import PlantSection, RefrigeratorEvent, StationSettings
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_refrigerator.program import SHIPPED, EventSchedule, RefrigeratorProgram, read_refrigerator_file
from coldloop_refrigerator.station_control import (
    MEMORY_SIZE,
    SHUT,
    Commands,
    StationMeasurement,
    beyond,
    control_station,
    overridden,
    station_law,
)

FILE = read_refrigerator_file(SHIPPED)
HP, LP, LEVEL, LOST = (STATION_SIGNAL_NAMES.index(name) for name in ("P12", "P11", "L_N2", "lost"))
BOTH = pytest.mark.parametrize("control", ["lq", "pi"])
AT_REST = StationMeasurement(
    16.0, 1.05, 6.0, FILE.v0[0], 0.0, 0.0, 60.0, 0.0, 1.23, nc1=True, nc2=True,
    loaded=2, turbine=True, overspeed=False, deviating=False, suction=False,
)  # fmt: skip


class Controller:
    """The station's controller without a plant."""

    def __init__(self, settings: StationSettings) -> None:
        self.law = station_law(settings, FILE.gains, FILE.v0, REFERENCE_REFRIGERATOR.station)
        self.memory, self.mode = np.zeros(MEMORY_SIZE), StationMode.AUTOMATIC

    def step(self, measured: StationMeasurement) -> Commands:
        commands, mode = control_station(self.law, self.memory, measured)
        self.mode = StationMode(mode)
        return commands


def make(
    control: str = "lq", *, load: LoadProfile | None = None, events: Sequence[RefrigeratorEvent] = ()
) -> RefrigeratorProgram:
    return RefrigeratorProgram(
        file=FILE,
        u0=FILE.u0,
        load=load or LoadProfile((0,), (FILE.w0,)),
        station=StationSettings.model_validate({"control": control}),
        events=EventSchedule(events, 300.0, 0.0),
    )


def noisy(control: str, **station: float) -> RefrigeratorProgram:
    """Return one whose gauges scatter by 5 mbar, 60 W more from 5 min on and 60 W less from 10 min on."""
    return RefrigeratorProgram(
        file=FILE,
        u0=FILE.u0,
        load=LoadProfile((0, 1200, 2400), (FILE.w0, FILE.w0 + 60.0, FILE.w0 - 60.0)),
        station=StationSettings.model_validate({"control": control, "noise_bar": 0.005, **station}),
        events=EventSchedule((), 300.0, 0.0),
        seed=3,
    )


def event(at_s: float, target: str, value: float) -> RefrigeratorEvent:
    return RefrigeratorEvent.model_validate({"at_s": at_s, "target": target, "value": value})


def run(program: RefrigeratorProgram, seconds: float) -> np.ndarray:
    """Return the station's signals of each tick."""
    rows = []
    for _ in range(round(seconds / 0.25)):
        rows.append(program.station.signals)
        program.advance()
    return np.array(rows)


@BOTH
def test_at_the_operating_point_nothing_moves(control: str) -> None:
    signals = run(make(control), 600.0)
    assert np.ptp(signals[:, HP]) < 1e-6
    assert np.ptp(signals[:, LP]) < 1e-8


@BOTH
@pytest.mark.parametrize("watts", [60.0, -60.0])
def test_pressures_are_held_when_the_load_of_the_bath_changes_by_60_w(control: str, watts: float) -> None:
    signals = run(make(control, load=LoadProfile((0, 40), (FILE.w0, FILE.w0 + watts))), 900.0)
    assert np.max(np.abs(signals[:, HP] - 16.0)) < 0.2
    assert np.max(np.abs(signals[:, LP] - 1.05)) < 0.02
    assert signals[-1, HP] == pytest.approx(16.0, abs=0.01)


def opened(program: RefrigeratorProgram, seconds: float) -> np.ndarray:
    """Return of each tick which of CV952 and CV953 is open, shape (N, 2)."""
    rows = []
    for _ in range(round(seconds / 0.25)):
        program.advance()
        rows.append(program.memory.x[-2:] > SHUT)
    return np.array(rows)


@BOTH
def test_noise_on_the_gauges_does_not_work_the_valves_of_the_buffer(control: str) -> None:
    program = noisy(control)
    valves = opened(program, 900.0)
    assert valves.any(axis=0).all(), "both were needed, one after the other"
    assert not valves.all(axis=1).any()
    assert np.sum(valves[1:] != valves[:-1]) < 40
    assert program.station.signals[HP] == pytest.approx(16.0, abs=0.25)
    assert program.station.signals[LP] == pytest.approx(1.05, abs=0.01)


def test_without_a_dead_band_noise_opens_both_valves_of_the_buffer_at_once() -> None:
    valves = opened(noisy("lq", dead_band=0.0), 300.0)
    assert valves.all(axis=1).mean() > 0.5


def test_the_noise_of_a_tick_does_not_depend_on_where_a_program_was_resumed() -> None:
    first, second = noisy("lq"), noisy("lq")
    run(first, 330.0)
    second.resume(**first.retained())
    assert np.array_equal(run(first, 60.0), run(second, 60.0))


@BOTH
def test_a_trip_raises_its_alarms_and_pressures_come_back_after_it(control: str) -> None:
    program = make(control, events=[event(60.0, "nc1", 0), event(180.0, "nc1", 1)])
    run(program, 130.0)
    assert program.station.mode == StationMode.ONE_COMPRESSOR
    assert program.station.alarms & StationAlarm.NC1_TRIPPED
    low = bool(program.station.alarms & StationAlarm.HP_LOW)
    assert low == (control == "lq"), "with PI the helium of line and passes keeps the high pressure up"
    assert program.station.alarms & StationAlarm.LP_HIGH
    assert not program.station.alarms & StationAlarm.NC2_TRIPPED
    signals = run(program, 1100.0)
    assert signals[-1, HP] == pytest.approx(16.0, abs=0.05)
    assert signals[-1, LP] == pytest.approx(1.05, abs=2e-3)
    assert program.station.alarms == 0


def test_the_lq_controller_loses_no_helium_in_a_trip_and_the_pi_does() -> None:
    """It takes gas out of both lines into the buffer, where the PI, which sees one line a valve, lets it blow off."""
    lost = {}
    for control in ("lq", "pi"):
        program = make(control, events=[event(60.0, "nc1", 0), event(180.0, "nc1", 1)])
        lost[control] = run(program, 600.0)[-1, LOST]
    assert lost["lq"] == 0.0
    assert lost["pi"] > 0.1


def test_without_compressors_the_high_pressure_line_empties_into_the_buffer_and_lifts_the_low_one_a_little() -> None:
    program = make(events=[event(10.0, "nc1", 0), event(10.0, "nc2", 0)])
    run(program, 12.0)
    assert program.station.mode == StationMode.STOPPED
    assert program.station_status.commands[0] > 50.0
    assert program.station_status.commands[1:3] == (100.0, 0.0)
    signals = run(program, 20.0)
    bypass, discharge, charge = program.station_status.commands[:3]
    assert bypass < 10.0
    assert (discharge, charge) == (100.0, 0.0)
    assert max(signals[:, LP]) == pytest.approx(1.30, abs=0.01)
    later = run(program, 40.0)
    assert program.station_status.commands[0] == 0.0, "what lifts the low pressure further is what the load evaporates"
    assert signals[-1, LP] < later[-1, LP] < 1.5


def test_nitrogen_that_runs_out_raises_its_alarm_and_comes_back() -> None:
    program = make(events=[event(10.0, "nitrogen", 0), event(1800.0, "nitrogen", 1)])
    run(program, 1700.0)
    assert program.station.alarms & StationAlarm.NITROGEN_LOW
    signals = run(program, 5500.0)
    assert signals[-1, LEVEL] == pytest.approx(60.0, abs=3.0)
    assert not program.station.alarms & StationAlarm.NITROGEN_LOW


def test_a_leak_is_made_up_from_the_buffer() -> None:
    signals = run(make(events=[event(10.0, "leak", 1.0)]), 900.0)
    assert signals[-1, HP] == pytest.approx(16.0, abs=0.02)
    assert signals[-1, LOST] == pytest.approx(0.89, abs=0.01)


@pytest.mark.usefixtures("compiles")
@BOTH
@pytest.mark.parametrize("hp", [0.0, 4.0, 30.0])
@pytest.mark.parametrize("lp", [0.0, 0.5, 3.0])
def test_openings_stay_between_shut_and_open_whatever_is_measured(control: str, hp: float, lp: float) -> None:
    settings = StationSettings.model_validate({"control": control})
    controller = Controller(settings)
    for _ in range(400):
        commands = controller.step(AT_REST._replace(hp=hp, lp=lp))
        assert all(0.0 <= opening <= 100.0 for opening in commands)


@pytest.mark.usefixtures("compiles")
@BOTH
def test_integrals_do_not_wind_up_while_a_valve_is_at_its_end(control: str) -> None:
    """After ten minutes of a pressure that no valve could mend, one that is 5 mbar too low opens the bypass soon."""
    settings = StationSettings.model_validate({"control": control})
    controller = Controller(settings)
    for _ in range(2400):
        controller.step(AT_REST._replace(lp=1.3, bypass=0.0))
    assert controller.mode != StationMode.AUTOMATIC
    for _ in range(4 * 20):
        commands = controller.step(AT_REST._replace(lp=1.045, bypass=0.0))
    assert commands.cv956 > 0.0


@pytest.mark.usefixtures("compiles")
def test_charging_stops_when_the_low_pressure_is_too_high() -> None:
    controller = Controller(StationSettings())
    for _ in range(40):
        commands = controller.step(AT_REST._replace(hp=9.0, lp=1.05 + 0.081))
    assert commands.cv953 == 0.0


@pytest.mark.parametrize(
    ("pressure", "limit", "full", "share"),
    [(17.0, 17.0, 17.6, 0.0), (17.3, 17.0, 17.6, 0.5), (18.0, 17.0, 17.6, 1.0), (0.94, 0.99, 0.89, 0.5)],
)
def test_a_limit_acts_in_proportion(pressure: float, limit: float, full: float, share: float) -> None:
    assert beyond(pressure, (limit, full)) == pytest.approx(share)


@pytest.mark.parametrize(
    ("asked", "high", "low", "moved"),
    [
        ((5.0, 40.0), 0.25, 0.0, (50.0, 40.0)),
        ((5.0, 40.0), 0.9, 0.0, (100.0, 20.0)),
        ((60.0, 0.0), 0.0, 0.25, (60.0, 50.0)),
        ((60.0, 0.0), 0.0, 1.0, (0.0, 100.0)),
        ((0.0, 70.0), 0.25, 0.25, (50.0, 70.0)),
        ((5.0, 40.0), 1.0, 1.0, (100.0, 100.0)),
    ],
)
def test_a_pressure_beyond_its_limit_first_opens_a_valve_then_shuts_the_other(
    asked: tuple[float, float], high: float, low: float, moved: tuple[float, float]
) -> None:
    assert overridden((30.0, *asked), high, low)[1] == pytest.approx((30.0, *moved))


@BOTH
@pytest.mark.usefixtures("compiles")
def test_both_limits_at_once_make_the_buffer_a_bypass(control: str) -> None:
    controller = Controller(StationSettings.model_validate({"control": control}))
    commands = controller.step(AT_REST._replace(hp=17.7, lp=0.85))
    assert (commands.cv952, commands.cv953, controller.mode) == (100.0, 100.0, StationMode.OVERRIDE)
    controller.step(AT_REST)
    assert controller.mode != StationMode.OVERRIDE


def test_limits_that_cannot_be_are_refused() -> None:
    for bad, says in (
        ({"protection": {"hp_bar": [17.0, 17.0]}}, "then a higher one"),
        ({"protection": {"lp_bar": [0.99, 0.8]}}, "above both of trip_lp_bar"),
        ({"hp_bar": 17.1}, "hp_bar below 17 bar"),
    ):
        with pytest.raises(ValueError, match=says):
            StationSettings.model_validate(bad)


def test_a_program_that_is_resumed_goes_on_to_the_bit() -> None:
    first = make(load=LoadProfile((0, 40), (FILE.w0, FILE.w0 + 60.0)))
    first.give(Surroundings(leak=0.5))
    run(first, 60.0)
    second = make(load=LoadProfile((0, 40), (FILE.w0, FILE.w0 + 60.0)))
    second.resume(**first.retained())
    assert np.array_equal(run(first, 60.0), run(second, 60.0))
    assert first.state == second.state


def test_the_retained_state_of_a_cold_box_is_refused() -> None:
    retained = {name: value for name, value in make().retained().items() if name != "warm"}
    with pytest.raises(ValueError, match="that of a cold box"):
        make().resume(**retained)


def test_what_an_operator_gives_holds_until_a_later_event() -> None:
    schedule = EventSchedule([event(10.0, "leak", 2.0), event(30.0, "nc1", 0)], 295.0, 0.0)
    schedule.put.append((60, Surroundings(leak=5.0, nitrogen=0)))
    assert schedule.at(39).leak == 0.0
    assert schedule.at(40) == Surroundings(leak=2.0, ambient=295.0)
    assert schedule.at(60) == Surroundings(leak=5.0, nitrogen=0)
    assert schedule.at(120) == Surroundings(leak=5.0, nitrogen=0, nc1=0)


def test_a_day_is_warmer_in_its_first_half() -> None:
    schedule = EventSchedule([], 300.0, 8.0)
    assert schedule.ambient(0) == 300.0
    assert schedule.ambient(4 * 6 * 3600) == pytest.approx(308.0)
    assert schedule.ambient(4 * 18 * 3600) == pytest.approx(292.0)


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        ({"at_s": 1.1, "target": "nc1", "value": 0}, "multiple of 0.25"),
        ({"at_s": 1.0, "target": "nc1", "value": 0.5}, "write 0 or 1"),
        ({"at_s": 1.0, "target": "ambient", "value": 20.0}, "outside 270 to 320"),
        ({"at_s": 1.0, "target": "pump", "value": 1.0}, "nc1"),
    ],
)
def test_an_event_that_cannot_be_is_refused(bad: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        RefrigeratorEvent.model_validate(bad)


def test_gains_of_other_weights_are_refused() -> None:
    section = PlantSection.model_validate({"kind": "refrigerator", "station": {"weights": {"lp_bar": 0.02}}})
    with pytest.raises(ConfigurationError, match="the gains of this refrigerator"):
        plant_maker(read_header(DEFAULT_MODEL_FILE), section)


def test_a_cold_box_refuses_the_model_of_the_refrigerator() -> None:
    with pytest.raises(ModelFileError, match="a model of the refrigerator"):
        plant_maker(read_header(SHIPPED_MODELS["refrigerator"]), PlantSection())


def test_the_file_of_another_plant_is_refused() -> None:
    with pytest.raises(ModelFileError, match="not the file of a refrigerator"):
        read_refrigerator_file(DEFAULT_MODEL_FILE)
