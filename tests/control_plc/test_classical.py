"""The classical loops: two PI controllers that stand alone, and what the control PLC makes of them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import COLD_BOX, L1, T5, TICK_S
from coldloop.process.lti_model import load as load_model
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits, RateReference
from coldloop.registers.control_plc import Mode
from coldloop.registers.plant import Measurement
from coldloop_control_plc.program import ControlProgram, make_program
from coldloop_control_plc.scan import execute, move_loops, want
from coldloop_control_plc.settings import ClassicalSettings, ControlSection, ControlStrategy, LevelLoop
from coldloop_plant.kinds import make_program as make_plant
from coldloop_plant.load import find_load
from coldloop_plant.settings import SensorSettings
from tests.harness.records import Row, as_transmitted

NCR22, CV156 = 1, 2

HEADER = read_header(DEFAULT_MODEL_FILE)
REST = Row(*HEADER.u0)
PERIOD = 20


class PiController:
    """The loop of the level alone, with a setpoint of 60 and bounds of its own."""

    def __init__(self, gain: float = 2.0, integral_time_s: float = 50.0, reach: float = 10.0) -> None:
        program = make_program(HEADER, ControlSection(), InputLimits())
        c, self._ladder = program.scan_constants, program.ladder
        self._loop = c.loops.outputs.index(L1)
        loops = {"gains": gain, "integral_times_s": integral_time_s, "setpoints": 60.0, "reaches": reach}
        limits = c.limits._replace(low=(0.0,) * 3, high=(100.0,) * 3)
        alone = c.loops._replace(**{name: [value] * 2 for name, value in loops.items()})
        self._constants = c._replace(limits=limits, loops=alone)

    def execute(self, measured: float, applied: float) -> float:
        return execute(self._constants, self._ladder, self._loop, measured, applied, 5.0)


class ClassicalLoops:
    """The loops alone, at the operating point."""

    def __init__(self, tuning: ClassicalSettings | None = None) -> None:
        section = ControlSection(classical=tuning or ClassicalSettings())
        self._program = make_program(HEADER, section, InputLimits())

    def wanted(self, tick: int, y: tuple[float, ...], applied: Row) -> Row:
        c, s = self._program.scan_constants, self._program.scan
        s.sensors.good[:], s.guard.applied[:] = y, applied
        want(s.ladder, applied)
        move_loops(c, s, tick)
        return Row(*s.ladder.wanted)


def outputs(level: float = 0.0, temperature: float = 0.0) -> tuple[float, ...]:
    """Return the outputs of the operating point, moved."""
    y = list(HEADER.y0)
    y[L1] += level
    y[T5] += temperature
    return tuple(y)


def measured(tick: int, y: tuple[float, ...]) -> Measurement:
    return as_transmitted(Measurement(tick, HEADER.w0, y, HEADER.x0, 1, (0.0,) * 3))


def classical_program(limits: InputLimits | None = None, **section: object) -> ControlProgram:
    """Return a control program in its first session, driven by the loops."""
    asked = ControlSection.model_validate({"driver": ControlStrategy.CLASSICAL, **section})
    program = make_program(HEADER, asked, limits or InputLimits())
    program.restart(session=1)
    return program


# -- the controller ----------------------------------------------------------------------------------------------------


@given(applied=st.floats(10.0, 90.0), error=st.floats(-2.0, 2.0))
def test_a_start_is_bumpless_from_any_input(applied: float, error: float) -> None:
    start = PiController().execute(60.0 - error, applied)
    assert start - applied == pytest.approx(2.0 * error * 5.0 / 50.0), "one integral step and no proportional kick"


def test_it_is_the_textbook_pi_as_long_as_nothing_limits_it() -> None:
    pi, applied, integral = PiController(), 50.0, 50.0
    for k in range(30):
        error = math.sin(0.3 * k)
        applied = pi.execute(60.0 - error, applied)
        integral += 2.0 * 5.0 / 50.0 * error
        assert applied == pytest.approx(2.0 * error + integral)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_after_an_hour_at_a_bound_the_input_comes_back_as_soon_as_the_error_turns(direction: float) -> None:
    pi, applied = PiController(), 50.0
    for _ in range(720):
        applied = pi.execute(60.0 - 5.0 * direction, applied)
    assert applied == (100.0 if direction > 0 else 0.0)
    assert (applied - pi.execute(60.0 + 0.5 * direction, applied)) * direction > 0


def test_behind_a_rate_limit_nothing_winds_up() -> None:
    pi, applied = PiController(gain=50.0, reach=0.1), 50.0
    for _ in range(20):
        applied = pi.execute(59.0, applied)
    assert applied == pytest.approx(52.0)
    assert pi.execute(60.0, applied) == pytest.approx(applied - 0.1)


def test_it_goes_on_from_what_somebody_else_has_applied() -> None:
    pi = PiController()
    pi.execute(60.0, 50.0)
    assert pi.execute(60.0, 70.0) == 70.0


@pytest.mark.parametrize("fault", [math.nan, math.inf, -math.inf])
def test_a_sensor_that_tells_no_number_leaves_the_input_and_the_return_is_bumpless(fault: float) -> None:
    pi = PiController()
    applied = pi.execute(60.0, 50.0)
    assert pi.execute(fault, applied) == applied
    assert pi.execute(59.0, applied) == pytest.approx(applied + 2.0 * 5.0 / 50.0)


@given(
    gain=st.floats(-500.0, 500.0),
    integral_time_s=st.floats(0.01, 1e4),
    readings=st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=40),
)
def test_whatever_is_measured_it_asks_for_nothing_outside_bounds_and_reach(
    gain: float, integral_time_s: float, readings: list[float]
) -> None:
    pi, applied = PiController(gain, integral_time_s, reach=0.7), 50.0
    for reading in readings:
        wanted = pi.execute(reading, applied)
        assert 0.0 <= wanted <= 100.0
        assert applied - 0.7 <= wanted <= applied + 0.7
        applied = wanted


# -- the loops ---------------------------------------------------------------------------------------------------------


def test_at_the_operating_point_nothing_moves() -> None:
    assert all(ClassicalLoops().wanted(tick, outputs(), REST) == REST for tick in range(60))


def test_setpoints_may_be_moved_from_the_operating_point() -> None:
    tuning = ClassicalSettings(level=LevelLoop(setpoint_offset=0.5))
    assert ClassicalLoops(tuning).wanted(0, outputs(level=0.5), REST) == REST


def test_between_executions_the_loops_ask_for_what_is_applied() -> None:
    tuning = ClassicalSettings(period_s=2.5)
    both = ClassicalLoops(tuning)
    moved = [tick for tick in range(40) if both.wanted(tick, outputs(1.0, 1.0), REST) != REST]
    assert moved == [0, 10, 20, 30]


@pytest.mark.parametrize("period_s", [0.0, 0.3, 5.25])
def test_a_period_that_fits_neither_ticks_nor_rate_windows_is_refused(period_s: float) -> None:
    with pytest.raises(ValueError, match="period_s"):
        ClassicalSettings(period_s=period_s)


def test_on_the_linear_model_the_peak_sensitivity_of_each_loop_is_below_2_with_the_other_closed() -> None:
    model, tuning = load_model(DEFAULT_MODEL_FILE), ClassicalSettings()
    peaks = []
    for omega in np.logspace(-4, -0.3, 400):
        s = 1j * omega
        response = model.C @ np.linalg.solve(s * np.eye(len(model.x0)) - model.A, model.B) + model.D
        delay = np.exp(-s * (tuning.period_s / 2 + TICK_S))  # the hold between executions, and the measurement's age
        level, temperature = (
            pi.gain * (1 + 1 / (s * pi.integral_time_s)) * delay for pi in (tuning.level, tuning.temperature)
        )
        g = response[np.ix_([L1, T5], [NCR22, CV156])]
        across = g[0, 1] * g[1, 0]
        peaks.append(
            (
                abs(1 / (1 + level * (g[0, 0] - across * temperature / (1 + temperature * g[1, 1])))),
                abs(1 / (1 + temperature * (g[1, 1] - across * level / (1 + level * g[0, 0])))),
            )
        )
    assert np.max(peaks) < 2.0


# -- in the control PLC ------------------------------------------------------------------------------------------------


def test_the_loops_drive_from_the_first_measurement_on_and_no_update_is_latched() -> None:
    program = classical_program()
    assert program.mode is Mode.CLASSICAL
    applied = []
    for tick in range(60):
        actuators = program.begin_scan()
        applied.append(Row(*actuators.u))
        assert program.end_scan(measured(tick, outputs(level=1.0))) is None
        assert program.mode is Mode.CLASSICAL
        assert not program.awaiting_plan
        assert not program.awaiting_sequence
    assert applied[:PERIOD] == [REST] * PERIOD
    assert applied[PERIOD].ncr22 == pytest.approx(REST.ncr22 + 100.0 * 5.0 / 300.0)
    assert len(set(applied)) == 3, "one move each 5 s"
    assert program.player.deadline_misses == 0


def test_a_new_session_begins_as_the_first_did() -> None:
    program = classical_program()
    sessions = []
    for session in (1, 2):
        program.restart(session)
        applied = []
        for tick in range(50):
            applied.append(program.begin_scan().u)
            program.end_scan(measured(tick, outputs(level=0.01 * tick, temperature=-0.02 * tick)))
        sessions.append(applied)
    assert sessions[0] == sessions[1]


@given(
    readings=st.lists(
        st.tuples(st.floats(-80.0, 80.0) | st.just(math.nan), st.floats(-8.0, 100.0) | st.just(math.inf)),
        min_size=1,
        max_size=30,
    ),
    level_gain=st.floats(-5000.0, 5000.0),
    period_s=st.sampled_from([0.25, 1.5, 2.5, 3.75, 5.0]),
    reference=st.sampled_from(RateReference),
)
def test_whatever_the_sensors_tell_bounds_and_rates_are_kept(
    readings: list[tuple[float, float]], level_gain: float, period_s: float, reference: RateReference
) -> None:
    limits = InputLimits(rate_reference=reference)
    program = classical_program(limits, classical={"period_s": period_s, "level": {"gain": level_gain}})
    applied = []
    for tick in range(7 * len(readings)):
        applied.append(program.begin_scan().u)
        level, temperature = readings[tick // 7]
        program.end_scan(measured(tick, outputs(level, temperature)))
    for tick, row in enumerate(applied):
        window = applied[max(0, tick // PERIOD * PERIOD - 1)]
        for i, value in enumerate(row):
            assert limits.low[i] <= value <= limits.high[i]
            assert abs(value - window[i]) <= limits.rate[i]


def test_the_loops_hold_the_plant_by_themselves_on_load_a() -> None:
    load = find_load("a", HEADER.w0, COLD_BOX)
    plant = make_plant(HEADER, SensorSettings(), load, seed=1)
    program = classical_program()
    level, temperature = [], []
    for _ in range(14400):
        u = as_transmitted(program.begin_scan()).u
        plant.apply(u)
        y = plant.measure()
        level.append(y[L1])
        temperature.append(y[T5])
        program.end_scan(measured(plant.tick, y))
        plant.advance()
    assert 58.3 < min(level) < max(level) < 61.2
    assert 8.3 < min(temperature) < max(temperature) < 12.5
    assert sum(59.0 <= value <= 61.0 for value in level) > 0.9 * len(level)
    assert sum(9.0 <= value <= 16.0 for value in temperature) > 0.9 * len(temperature)
