import math
import struct
from itertools import accumulate

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coldloop.process.settings import InputLimits, RateReference
from coldloop.registers.control_plc import Verdict
from coldloop_control_plc.output_limits import OutputGuard
from tests.harness.records import Row

INITIAL = Row(43.0, 75.0, 36.0)
TICKS_PER_SAMPLE = 20

anything = st.floats(allow_nan=True, allow_infinity=True)
near = st.floats(-20.0, 180.0)
rows = st.builds(Row, *[st.one_of(near, near, anything)] * 3)
scans = st.lists(st.tuples(rows, st.booleans(), st.integers(1, 30)), min_size=1, max_size=60)
each_reference = pytest.mark.parametrize("reference", RateReference)


@st.composite
def odd_limits(draw: st.DrawFn) -> InputLimits:
    """Return limits whose rates single precision cannot represent."""
    low = [draw(st.floats(0.0, 40.0, width=32)) for _ in range(3)]
    high = [draw(st.floats(single(bottom + 1.0), 200.0, width=32)) for bottom in low]
    rate = [draw(st.floats(0.001, 50.0)) for _ in range(3)]
    return InputLimits(
        low=(low[0], low[1], low[2]),
        high=(high[0], high[1], high[2]),
        rate=(rate[0], rate[1], rate[2]),
        rate_reference=draw(st.sampled_from(RateReference)),
    )


def single(value: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


def check(limits: InputLimits, initial: Row, history: list[tuple[Row, bool, int]]) -> None:
    """Ask for each row for some ticks, the first of them perhaps an update; compare with the rule, told anew.

    A window begins at an update, or 20 ticks after it began. What may be applied in it is what was applied before it,
    plus or minus the rate; where the elapsed time counts, times the share of 5 s that the inputs have stood still.
    """
    guard = OutputGuard(limits, initial)
    anchor, start, share, moved = initial, 0, 1.0, -TICKS_PER_SAMPLE
    applied, tick = initial, 0
    for wanted, is_update, ticks in history:
        for repetition in range(ticks):
            update = is_update and repetition == 0
            if update or tick - start >= TICKS_PER_SAMPLE:
                if limits.rate_reference is RateReference.ELAPSED:
                    share = min(1.0, (tick - moved) / TICKS_PER_SAMPLE)
                anchor, start = applied, tick
            before, applied = applied, guard.admit(tick, wanted, update=update)
            moved = tick if applied != before else moved
            assert applied == guard.applied
            for i, value in enumerate(applied):
                assert math.isfinite(value)
                assert limits.low[i] <= value <= limits.high[i]
                assert abs(value - anchor[i]) <= limits.rate[i] * share
                assert single(value) == value
            tick += 1


@each_reference
@settings(max_examples=4 * settings.default.max_examples)
@given(history=scans)
def test_whatever_is_asked_every_output_is_inside_its_bounds_and_its_rate_window(
    reference: RateReference, history: list[tuple[Row, bool, int]]
) -> None:
    check(InputLimits(rate_reference=reference), INITIAL, history)


@settings(max_examples=4 * settings.default.max_examples)
@given(limits=odd_limits(), history=scans, share=st.floats(0.0, 1.0))
def test_rates_that_single_precision_cannot_represent_are_kept_too(
    limits: InputLimits, history: list[tuple[Row, bool, int]], share: float
) -> None:
    middle = [
        single(low + (0.1 + 0.8 * share) * (high - low)) for low, high in zip(limits.low, limits.high, strict=True)
    ]
    check(limits, Row(*middle), history)


def test_bounds_that_single_precision_cannot_represent_are_kept_too() -> None:
    limits = InputLimits(low=(20.1, 0.3, 20.2), high=(59.9, 149.9, 60.2))
    for start, target in ((limits.low, -1e3), (limits.high, 1e3)):
        guard = OutputGuard(limits, Row(*[single(bound) for bound in start]))
        for tick in range(40):
            for value, low, high in zip(
                guard.admit(tick, Row(*[target] * 3), update=False), limits.low, limits.high, strict=True
            ):
                assert low <= value <= high


@given(history=scans)
def test_with_elapsed_rates_the_outputs_never_drift_faster_than_the_rate(
    history: list[tuple[Row, bool, int]],
) -> None:
    limits = InputLimits(rate_reference=RateReference.ELAPSED)
    guard = OutputGuard(limits, INITIAL)
    path = [INITIAL]
    for wanted, is_update, ticks in history:
        for repetition in range(ticks):
            path.append(guard.admit(len(path) - 1, wanted, update=is_update and repetition == 0))
    for i, rate in enumerate(limits.rate):
        for start in range(0, len(path), 7):
            for end in range(start + 1, len(path), 13):
                samples = (end - start) / TICKS_PER_SAMPLE
                assert abs(path[end][i] - path[start][i]) <= rate * (samples + 3.0)


@each_reference
@given(target=rows)
def test_a_value_that_can_be_reached_is_reached_and_then_held(reference: RateReference, target: Row) -> None:
    limits = InputLimits(rate=(5.0, 20.0, 5.0), rate_reference=reference)
    guard = OutputGuard(limits, INITIAL)
    for tick in range(20 * 10):
        guard.admit(tick, target, update=False)
    for value, wanted, low, high, first in zip(guard.applied, target, limits.low, limits.high, INITIAL, strict=True):
        reachable = first if not math.isfinite(wanted) else min(max(wanted, low), high)
        assert value == pytest.approx(reachable, rel=1e-6)


def at(first: float) -> Row:
    return Row(first, *INITIAL[1:])


@pytest.mark.parametrize("idle", [0, 3, 4, 7])
def test_a_sequence_is_judged_behind_rows_that_begin_later(idle: int) -> None:
    """After the rack has gone back, the sequence being played begins some ticks from now."""
    limits = InputLimits()
    rows = [INITIAL, INITIAL, at(43.5)]
    offered = [at(44.0)] * 3
    for elapsed in (False, True):
        guard = OutputGuard(limits, INITIAL)
        guard.begin_at(4, INITIAL)
        first = 4 + idle + len(rows) + (20 if elapsed else 0)
        meanwhile = [*[None] * idle, *rows, *[None] * (first - 4 - idle - len(rows))]
        verdict = guard.judge(offered, first, meanwhile)
        applied = [guard.admit(4 + k, row or guard.applied, update=False) for k, row in enumerate(meanwhile)]
        assert applied[-1] == rows[-1]
        played = [guard.admit(first + k, row, update=k == 0) for k, row in enumerate(offered)]
        assert (verdict is Verdict.ACCEPTED) == (played == offered)


def test_a_move_at_the_end_of_what_is_played_limits_what_follows() -> None:
    guard = OutputGuard(InputLimits(), INITIAL)
    guard.begin_at(4, INITIAL)
    meanwhile = [*[None] * 4, *[INITIAL] * 7, at(43.5)]
    assert guard.judge([at(44.0)], 16, meanwhile) is Verdict.RATE_EXCEEDED


@pytest.mark.parametrize("fault", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_no_number_holds_what_was_applied_before_the_window(fault: float) -> None:
    guard = OutputGuard(InputLimits(), INITIAL)
    guard.admit(0, Row(43.25, 80.0, 36.0), update=True)
    assert guard.admit(5, Row(fault, 81.0, fault), update=True) == (43.25, 81.0, 36.0)


def test_per_update_rates_allow_the_full_step_at_every_update_and_elapsed_rates_a_share_of_it() -> None:
    far = Row(60.0, 150.0, 60.0)
    reached = {}
    for reference in RateReference:
        guard = OutputGuard(InputLimits(rate_reference=reference), INITIAL)
        for tick in range(21):
            guard.admit(tick, far, update=tick > 0 and tick % 5 == 0)
        reached[reference] = guard.applied[1] - INITIAL.ncr22
    assert reached[RateReference.PER_UPDATE] == pytest.approx(5 * 10.0)
    assert reached[RateReference.ELAPSED] == pytest.approx(10.0 + 4 * 2.5)


def test_breaks_that_follow_one_another_do_not_give_a_full_rate_each() -> None:
    limits = InputLimits()
    guard = OutputGuard(limits, Row(43.0, 75.0, 36.0))
    wanted = Row(60.0, 150.0, 60.0)
    for tick in range(1, 20):
        guard.begin_at(tick, guard.admit(tick, wanted, update=False))
    assert guard.applied[0] == pytest.approx(43.5)
    assert guard.applied[1] == pytest.approx(85.0)


def test_what_is_applied_outside_an_open_window_begins_a_new_one() -> None:
    guard = OutputGuard(InputLimits(), Row(43.0, 75.0, 36.0))
    guard.begin_at(5, Row(50.0, 75.0, 36.0))
    assert guard.admit(6, Row(43.0, 75.0, 36.0), update=False)[0] == pytest.approx(49.5)


@settings(max_examples=2 * settings.default.max_examples)
@given(
    applied=st.tuples(*[st.floats(0.0, 200.0, width=32)] * 3),
    wanted=st.tuples(*[st.floats(0.0, 200.0)] * 3),
    reference=st.sampled_from(RateReference),
)
def test_from_anywhere_at_all_outputs_come_into_their_bounds_within_the_rate(
    applied: tuple[float, ...], wanted: tuple[float, ...], reference: RateReference
) -> None:
    limits = InputLimits(rate_reference=reference)
    guard = OutputGuard(limits, Row(43.0, 75.0, 36.0))
    guard.begin_at(1000, Row(*applied))
    before = guard.applied
    for tick in range(1001, 1001 + 20 * 30, 20):
        after = guard.admit(tick, Row(*wanted), update=False)
        for i, value in enumerate(after):
            assert abs(value - before[i]) <= limits.rate[i] + 1e-5
            if limits.low[i] <= before[i] <= limits.high[i]:
                assert limits.low[i] <= value <= limits.high[i]
            elif tick > 1001:  # the window that the break began may have nothing left
                middle = (limits.low[i] + limits.high[i]) / 2
                assert abs(value - middle) < abs(before[i] - middle), "towards the bounds"
        before = after


@settings(max_examples=200)
@given(jitter=st.lists(st.integers(-6, 6), min_size=40, max_size=120))
@example(jitter=[0, 3, -3] * 20)
@example(jitter=[-3] * 19 + [3] * 14 + [-3] * 30)
@example(jitter=[20] * 20 + [0] * 20 + [-20] * 20 + [-40] * 10)
def test_a_rack_whose_tick_wavers_moves_no_output_further_than_a_calm_one(jitter: list[int]) -> None:
    """In calm two windows meet within 5 s: an output may move by its rate at the end of one, and again in the next."""
    limits, wanted = InputLimits(), Row(60.0, 150.0, 60.0)
    guard, told, moves = OutputGuard(limits, INITIAL), 0, [INITIAL]
    for now, off in enumerate(jitter, start=100):
        if now + off != told + 1:
            guard.begin_at(now + off, guard.applied, passed=1)
        told = now + off
        moves.append(guard.admit(told, wanted, update=False))
    shown = [99, *(now + off for now, off in enumerate(jitter, start=100))]
    for first in range(len(moves)):
        low, high = accumulate(shown[first:], min), accumulate(shown[first:], max)
        for wall, (least, most, after) in enumerate(zip(low, high, moves[first:], strict=True)):
            if most - least <= TICKS_PER_SAMPLE or wall <= TICKS_PER_SAMPLE:  # by either clock
                assert after[1] - moves[first][1] <= 2 * limits.rate[1] + 1e-4


def test_a_tick_that_is_set_back_for_good_does_not_stop_the_guards_time() -> None:
    guard, wanted = OutputGuard(InputLimits(), INITIAL), Row(60.0, 150.0, 60.0)
    for tick in range(1000, 1020):
        guard.admit(tick, wanted, update=False)
    before = guard.applied
    guard.begin_at(979 - TICKS_PER_SAMPLE, before, passed=1)
    for tick in range(980 - TICKS_PER_SAMPLE, 1001):
        guard.admit(tick, wanted, update=False)
    assert guard.applied[1] > before[1]
