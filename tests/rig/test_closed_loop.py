"""What the loop does to the plant, tick by tick, in one process."""

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest

from coldloop.process.cold_box import L1, T5, TICKS_PER_SAMPLE
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import read_header
from coldloop.process.settings import InputLimits, RateReference
from coldloop.registers.common import EventKind
from coldloop.registers.control_plc import Cause, Verdict
from coldloop_optimizer_plc.settings import ControlDesign, OptimizerSection, ProgramSettings
from coldloop_plant.kinds import make_program
from coldloop_plant.settings import SensorSettings
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recording
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from tests.rig.conftest import Simulate

pytestmark = pytest.mark.usefixtures("compiles")

BANDS = ControlDesign()
HALF_HOUR, TEN_MINUTES, FIVE_MINUTES = 7200, 2400, 1200


@pytest.fixture(scope="module")
def half_hour(load_a: LoadProfile, simulate: "Simulate") -> Recording:
    """Half an hour of load a under the adaptive updating period."""
    return simulate(Scenario(HALF_HOUR, load_a, 0.0, seed=1))


@pytest.fixture(scope="module")
def step(mean_load: float) -> LoadProfile:
    """100 W more after ten seconds."""
    return LoadProfile((0, 40), (mean_load, mean_load + 100.0))


def outside_the_bands(y: "np.ndarray[tuple[int, int], np.dtype[np.float32]]") -> int:
    constrained = y[:, [L1, T5]]
    return int(((constrained < BANDS.output_low) | (constrained > BANDS.output_high)).sum())


def rate_windows(recording: Recording) -> Iterator[slice]:
    """Yield the ticks, of an update or of 5 s, in which inputs may stray by one rate limit from where they were."""
    instants = [0, *(row.tick + row.tau_u for row in recording.updates), len(recording.u)]
    for start, end in pairwise(instants):
        for first in range(start, end, TICKS_PER_SAMPLE):
            yield slice(first, min(end, first + TICKS_PER_SAMPLE))


def assert_inside_limits(recording: Recording, limits: InputLimits) -> None:
    """Hold every tick against bounds and rates, without any tolerance."""
    u = recording.u.astype(float)
    assert (u >= limits.low).all()
    assert (u <= limits.high).all()
    before = np.array(read_header(Settings().model.file).u0, dtype=np.float32).astype(float)
    moved = [0, *(1 + np.flatnonzero((np.diff(u, axis=0) != 0).any(axis=1)))]
    for window in rate_windows(recording):
        anchor = u[window.start - 1] if window.start else before
        last_move = max((tick for tick in moved if tick < window.start), default=-TICKS_PER_SAMPLE)
        reach = np.array(limits.rate) * limits.rate_share(window.start - last_move)
        assert (np.abs(u[window] - anchor) <= reach).all(), f"a rate is broken in {window}"


def test_level_and_temperature_stay_in_their_bands_under_load_a(half_hour: Recording) -> None:
    assert np.ptp(half_hour.load) > 50
    assert outside_the_bands(half_hour.y) == 0


def test_without_control_a_step_of_100_w_drives_the_level_out_of_its_band(step: LoadProfile) -> None:
    plant = make_program(read_header(Settings().model.file), SensorSettings(), step, seed=1)
    for _ in range(TEN_MINUTES):
        plant.advance()
    assert plant.measure()[L1] < BANDS.output_low[0]


@pytest.mark.parametrize("period_s", [0.0, 2.5], ids=["adaptive", "fixed"])
def test_a_step_of_100_w_is_rejected(period_s: float, step: LoadProfile, simulate: "Simulate") -> None:
    recording = simulate(Scenario(TEN_MINUTES, step, period_s, seed=1))
    assert outside_the_bands(recording.y) == 0
    assert recording.u[-1][1] < recording.u[0][1] - 20  # the heater makes room for the load


def test_what_is_applied_keeps_bounds_and_rates_at_every_tick(half_hour: Recording) -> None:
    assert_inside_limits(half_hour, InputLimits())


def test_rates_scaled_to_the_elapsed_time_are_kept_too(step: LoadProfile, simulate: "Simulate") -> None:
    limits = InputLimits(rate_reference=RateReference.ELAPSED)
    recording = simulate(Scenario(FIVE_MINUTES, step, 0.0, seed=1), limits=limits)
    assert_inside_limits(recording, limits)


def test_narrow_limits_are_kept_when_they_bite(step: LoadProfile, simulate: "Simulate") -> None:
    u0, widths = read_header(Settings().model.file).u0, (1.3, 7.7, 0.31)  # single precision holds no such bounds
    low = (u0[0] - widths[0], u0[1] - widths[1], u0[2] - widths[2])
    high = (u0[0] + widths[0], u0[1] + widths[1], u0[2] + widths[2])
    limits = InputLimits(low=low, high=high, rate=(0.07, 1.1, 0.013))
    recording = simulate(Scenario(FIVE_MINUTES, step, 0.0, seed=1), limits=limits)
    assert_inside_limits(recording, limits)
    assert recording.u[-1][1] == pytest.approx(low[1])  # it did bite


@pytest.mark.parametrize("period_s", [0.0, 0.5, 2.5, 5.0])
def test_updates_tile_the_time_without_a_gap(period_s: float, step: LoadProfile, simulate: "Simulate") -> None:
    updates = simulate(Scenario(FIVE_MINUTES, step, period_s, seed=1)).updates
    tick = 0
    for number, row in enumerate(updates):
        assert (row.update, row.tick, row.verdict) == (number, tick, Verdict.ACCEPTED)
        assert period_s in {0.0, row.tau_u * 0.25}
        assert row.iterations == row.tau_u - 1, "four a second but one"
        tick += row.tau_u
    assert FIVE_MINUTES - 20 <= tick < FIVE_MINUTES


def test_the_adaptive_period_roams_within_2_to_19_iterations_by_steps_of_2(
    load_a: LoadProfile, simulate: "Simulate"
) -> None:
    program = ProgramSettings.model_validate({"adaptive": {"rule": "algorithm-1"}})
    run = simulate(Scenario(HALF_HOUR, load_a, 0.0, seed=1), optimizer_plc=OptimizerSection(program=program))
    q = np.array([row.iterations for row in run.updates])
    assert q[0] == 9
    assert q.min() == 2
    assert q.max() <= 19
    assert len(set(q.tolist())) > 5
    assert (np.abs(np.diff(q)) <= 2).all()
    assert [row.tau_u for row in run.updates] == (q + 1).tolist()


def test_by_default_the_period_rests_at_its_shortest_and_grows_by_ones(half_hour: Recording) -> None:
    q = np.array([row.iterations for row in half_hour.updates])
    assert (q[0], q.min(), q.max()) == (5, 2, 5)
    assert np.median(q) == 2
    assert (np.abs(np.diff(q)) <= 1).all()


def test_a_load_step_late_in_a_period_does_not_exhaust_the_sequence(simulate: "Simulate") -> None:
    """The sequence that begins at tick 174 had 18 rows; its period is interrupted at 183: the next begins at 193."""
    load = LoadProfile((0, 32, 47, 99, 120, 130, 183), (385.0, 360.0, 420.0, 445.0, 385.0, 325.0, 365.0))
    section = OptimizerSection(program=ProgramSettings(interrupting_load_step_w=10.0))
    events = simulate(Scenario(240, load, 0.0, seed=1), optimizer_plc=section).events
    modes = [event for _, event in events if event.kind == EventKind.MODE]
    assert [event.cause for event in modes] == [Cause.SESSION_STARTED, Cause.SEQUENCE_BEGAN]
