"""The compiled loop and the programs leave the same trace, the same updates and the same events."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rig.cosim.compiled.portable  # noqa: F401 lets numba compile what is plain Python
from coldloop.config import load_configuration
from coldloop.kernels.compiled import kernel
from coldloop.kernels.single_precision import neighbour, single
from coldloop.process.limits import InputLimits, RateReference
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.audit import EventKind
from control_plc.output_limits import admit, beginning, plain
from plant.load import find_load
from rig.cosim.compiled.control import guard_records
from rig.cosim.compiled.stretches import CompiledStretches, Stretch
from rig.cosim.one_process import OneProcessRig
from rig.cosim.scenario import Scenario
from rig.results.recording import MemorySink, Recorder
from rig.settings import Settings

PROGRAM = "optimizer_plc.program."
NOISE = ("plant.sensors.level=0.02", "plant.sensors.speed=0.5", "plant.sensors.temperature=0.02")
SUSPECTS = tuple(
    f"{PROGRAM}plausibility.{each}" for each in ("sigmas=1.5", "settled_s=5", "agreeing_s=5", "longest_s=9")
)
REFRIGERATOR = "plant.kind=refrigerator"
SINGLE = f'{PROGRAM}arithmetic="float32"'
TRIP = (
    'plant.refrigerator.events=[{at_s=90, target="nc1", value=0}, {at_s=120, target="nc1", value=1}, '
    '{at_s=30, target="cv155", value=0}, {at_s=45, target="heater", value=2}, {at_s=60, target="heater", value=1}, '
    '{at_s=65, target="turbine", value=0}, {at_s=75, target="turbine", value=1}, {at_s=80, target="cv155", value=1}, '
    '{at_s=85, target="blocked_nef2", value=5.0}, {at_s=150.25, target="leak", value=2.0}]'
)
COMPILED = {
    "adaptive": (),
    "fixed": (f"{PROGRAM}updating_period_s=2.5",),
    "contraction": (f'{PROGRAM}adaptive.rule="contraction"',),
    "noise": NOISE,
    "state-feedback": (f'{PROGRAM}estimator.kind="state-feedback"',),
    "rates that count elapsed time": ('limits.rate_reference="elapsed"',),
    "long sequences": (f"{PROGRAM}sequence_ticks=240",),
    "a fast PLC": (f"{PROGRAM}budget.power=10",),
    "interior point": (f'{PROGRAM}solver="interior-point"', f"{PROGRAM}updating_period_s=5"),
    "interior point, cut off": (f'{PROGRAM}solver="interior-point"', f'{PROGRAM}adaptive.rule="contraction"'),
    "hybrid": (f'{PROGRAM}solver="hybrid"', f"{PROGRAM}updating_period_s=1.5"),
    "hybrid on a fast PLC": (f'{PROGRAM}solver="hybrid"', f"{PROGRAM}budget.power=10"),
    "fast gradient": (f'{PROGRAM}solver="fast-gradient"',),
    "loads that cannot be held": (
        f"{PROGRAM}holdable_load_w=[330,345]",
        "control_plc.alarms.rules.capacity.on_delay_s=2",
    ),
    "suspects": (*SUSPECTS, *NOISE),
    "suspects in single precision": (SINGLE, *SUSPECTS, *NOISE),
    "load steps that interrupt": (f"{PROGRAM}updating_period_s=5", f"{PROGRAM}interrupting_load_step_w=10"),
    "load steps that interrupt a rule": (
        f'{PROGRAM}adaptive.rule="contraction"',
        f"{PROGRAM}interrupting_load_step_w=10",
        f'{PROGRAM}solver="hybrid"',
    ),
    "refrigerator": (REFRIGERATOR, TRIP, "plant.station.noise_bar=0.005", *NOISE),
    "refrigerator with PI and a model of its own": (
        REFRIGERATOR,
        "plant.station.control=pi",
        "model.file=refrigerator",
        f"{PROGRAM}updating_period_s=2.5",
    ),
    "as printed": (f'{PROGRAM}preset="as-printed"',),
    "as printed, interior point": (f'{PROGRAM}preset="as-printed"', f'{PROGRAM}solver="interior-point"'),
    "as printed, elapsed time": (f'{PROGRAM}preset="as-printed"', 'limits.rate_reference="elapsed"'),
    "soft rows": (f"{PROGRAM}penalties.output_rows=1", f"{PROGRAM}penalties.rate_rows=[1, 2, 3]"),
    "a box penalty alone": (f"{PROGRAM}penalties.box=2",),
    "first knot as rows": (f"{PROGRAM}penalties.first_knot_in_box=false",),
    "no look-ahead rows": (f"{PROGRAM}ode.look_ahead_rows=false",),
    "not held at bounds": (f"{PROGRAM}ode.hold_at_bounds=false",),
    "single precision": (SINGLE,),
    "single precision, fixed": (SINGLE, f"{PROGRAM}updating_period_s=2.5", *NOISE),
    "single precision, load steps that interrupt a rule": (
        SINGLE,
        f'{PROGRAM}adaptive.rule="contraction"',
        f"{PROGRAM}interrupting_load_step_w=10",
    ),
}
"""Whose updates are compiled too."""
LEFT_TO_PROGRAMS = {
    "osqp": (f'{PROGRAM}solver="osqp"', f"{PROGRAM}updating_period_s=5"),
    "daqp": (f'{PROGRAM}solver="daqp"', *NOISE),
    "qpoases": (f'{PROGRAM}solver="qpoases"',),
    "osqp and load steps that interrupt": (f'{PROGRAM}solver="osqp"', f"{PROGRAM}interrupting_load_step_w=10"),
    "qpoases and a refrigerator": (f'{PROGRAM}solver="qpoases"', REFRIGERATOR),
}
"""Whose ticks alone are compiled, where that is worth while."""
UNUSUAL = {
    "narrow alarm bands": ("control_plc.alarms.level_band=[59.9,60.1]", "control_plc.alarms.t5_band=[12,13]"),
    "sensors out of range": ("control_plc.sensors.level=[59.9,60.1]",),
    "sensors that freeze soon": ("control_plc.sensors.frozen_s=0.5",),
    "sequences that are refused": ("limits.slew_s=4",),
    "sequences that are refused, and load steps that interrupt": (
        "limits.slew_s=4",
        f"{PROGRAM}interrupting_load_step_w=10",
    ),
    "an impatient watchdog": ("control_plc.ladder.optimizer_timeout_s=2",),
    "the classical loops": ('control_plc.driver="classical"',),
}
"""What leads back to the programs in some of the ticks, or in all of them."""


class Left(NamedTuple):
    """What a run leaves behind."""

    trace: str
    updates: list[Any]
    events: list[Any]


@pytest.fixture(scope="module")
def lively(mean_load: float) -> LoadProfile:
    """A load that moves from the first minute on."""
    e = find_load("e", mean_load)
    return LoadProfile((0, *(time - e.times[1] + 60 for time in e.times[1:])), e.watts)


def left_by(assignments: tuple[str, ...], load: LoadProfile, ticks: int, *, compiled: bool) -> Left:
    chosen = load_configuration(Settings, environment={}, assignments=assignments).settings
    sink = MemorySink()
    recorder = Recorder(ticks, [sink])
    period_s = chosen.optimizer_plc.program.updating_period_s
    OneProcessRig(chosen, compiled=compiled).run(Scenario(ticks, load, period_s, seed=3), recorder)
    recorder.close()
    recording = sink.recording(recorder.link)
    events = [(service, event.tick, event.kind, event.subject, event.cause) for service, event in sink.events]
    return Left(recording.trace_sha256, recording.updates, events)


USUALLY = {
    "adaptive", "noise", "interior point, cut off", "hybrid", "fast gradient", "load steps that interrupt",
    "refrigerator", "as printed", "single precision", "osqp", "sequences that are refused", "an impatient watchdog",
    "the classical loops", "loads that cannot be held", "suspects",
}  # fmt: skip
"""One of each kind; the others differ from one of them in a part of the configuration."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in USUALLY else pytest.mark.exhaustive)
        for name in (*COMPILED, *LEFT_TO_PROGRAMS, *UNUSUAL)
    ],
)
def test_the_compiled_loop_leaves_what_the_programs_leave(name: str, lively: LoadProfile) -> None:
    assignments = (COMPILED | LEFT_TO_PROGRAMS | UNUSUAL)[name]
    assert left_by(assignments, lively, 1500, compiled=True) == left_by(assignments, lively, 1500, compiled=False)


def test_suspects_come_and_go(lively: LoadProfile) -> None:
    """What the comparison above is about."""
    events = left_by(COMPILED["suspects"], lively, 1500, compiled=True).events
    assert {cause for _, _, kind, _, cause in events if kind == EventKind.SENSOR} == {0, 2}, "none stands still"
    assert sum(kind == EventKind.SENSOR for _, _, kind, _, _ in events) > 20


def done_by_the_loop(monkeypatch: pytest.MonkeyPatch, assignments: tuple[str, ...], load: LoadProfile) -> int:
    """Return how many of 600 ticks the compiled loop did."""
    ticks = 0
    original = CompiledStretches.ahead

    def counted(self: CompiledStretches, until: int) -> Stretch | None:
        nonlocal ticks
        stretch = original(self, until)
        ticks += len(stretch.block.load) if stretch else 0
        return stretch

    monkeypatch.setattr(CompiledStretches, "ahead", counted)
    left_by(assignments, load, 600, compiled=True)
    return ticks


@pytest.mark.parametrize("assignments", [(), COMPILED["hybrid"], COMPILED["load steps that interrupt"]])
def test_nearly_all_ticks_of_an_ordinary_run_are_compiled(
    monkeypatch: pytest.MonkeyPatch, assignments: tuple[str, ...], lively: LoadProfile
) -> None:
    assert done_by_the_loop(monkeypatch, assignments, lively) > 500


def test_nearly_all_ticks_of_a_refrigerator_are_compiled(monkeypatch: pytest.MonkeyPatch, lively: LoadProfile) -> None:
    assert done_by_the_loop(monkeypatch, (REFRIGERATOR, TRIP), lively) > 550


def test_nothing_is_compiled_while_the_classical_loops_drive(
    monkeypatch: pytest.MonkeyPatch, lively: LoadProfile
) -> None:
    assert not done_by_the_loop(monkeypatch, UNUSUAL["the classical loops"], lively)


# -- arithmetic that is plain Python in the control PLC ----------------------------------------------------------------


@kernel
def compiled_single(value: float) -> float:
    return single(value)


@kernel
def compiled_neighbour(value: float, target: float) -> float:
    return neighbour(value, target)


@kernel
def compiled_admit(guard: Any, limits: Any, tick: int, wanted: Any, update: bool) -> None:  # noqa: ANN401, FBT001 a kernel
    admit(guard[0], limits, tick, wanted, update)


values = (
    st.floats(-1e30, 1e30)
    | st.floats(0.0, 200.0, width=32)
    | st.floats(-(2.0**-122), 2.0**-122, width=32)
    | st.integers(-149, 126).map(lambda exponent: 2.0**exponent)
    | st.just(0.0)
)


@given(value=values, target=values)
def test_single_precision_is_the_same_compiled(value: float, target: float) -> None:
    assert compiled_single(value) == single(value)
    own = single(value)
    found = neighbour(own, target)
    assert compiled_neighbour(own, target) == found
    assert math.copysign(1.0, compiled_neighbour(own, target)) == math.copysign(1.0, found)
    assert found == np.nextafter(np.float32(own), np.float32(math.inf if target > own else -math.inf))


anything = st.floats(-20.0, 180.0) | st.floats(allow_nan=True, allow_infinity=True)
scans = st.lists(st.tuples(st.tuples(anything, anything, anything), st.booleans(), st.integers(1, 30)), max_size=30)


@given(history=scans, slew_s=st.sampled_from([0.25, 0.5, 2.0, 5.0]), reference=st.sampled_from(RateReference))
def test_the_guard_is_the_same_compiled(
    history: list[tuple[tuple[float, float, float], bool, int]], slew_s: float, reference: RateReference
) -> None:
    limits = plain(InputLimits(slew_s=slew_s, rate_reference=reference))
    state = beginning(limits, (43.0, 75.0, 36.0))
    records, tick = guard_records(state), 0
    for wanted, update, ticks in history:
        for repetition in range(ticks):
            began = update and repetition == 0
            admit(state, limits, tick, wanted, began)
            compiled_admit(records, limits, tick, np.array(wanted), began)
            assert records[0]["applied"].tolist() == list(state.applied)
            assert (records[0]["share"], records[0]["moved"]) == (state.share, state.moved)
            tick += 1
