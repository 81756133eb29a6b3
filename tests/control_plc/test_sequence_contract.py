import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from coldloop.process.settings import InputLimits, RateReference
from coldloop.registers.control_plc import Acknowledgement, Verdict
from coldloop.safety.writers import InputSequence
from tests.harness.records import Row, as_transmitted

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

At = Callable[..., Row]


@pytest.fixture
def playing(bench: "Bench", at: At) -> "Bench":
    """A control PLC that plays sequence 1 from tick 4 on and has planned its next update for tick 12."""
    bench.play([at(0.25), *[at(0.3)] * 39], ticks=4)
    bench.scan()
    assert bench.plan(8)
    return bench


def wrong(bench: "Bench", at: At, fault: str) -> InputSequence:
    """Return a sequence with one fault."""
    rows = [at(0.4)] * 20
    header_faults: dict[str, dict[str, int]] = {
        "a length that is not that of the rows": {"length": 19},
        "another model": {"model_digest": 0xBAD},
        "a number that was played before": {"number": 1},
        "a first tick that has passed": {"first_tick": bench.program.tick - 1},
        "an earlier update": {"update": 0},
        "an update to come": {"update": 2},
        "a first tick before the planned one": {"first_tick": 11, "tau_u": 7},
        "a first tick after the planned one": {"first_tick": 13, "tau_u": 9},
        "another updating period": {"tau_u": 7},
    }
    row_faults: dict[str, Row] = {
        "a valve below its range": at(cv156=-16.1),
        "a valve above its range": at(cv155=17.1),
        "a heater below its range": at(ncr22=-75.5),
        "a heater above its range": at(ncr22=75.5),
        "a NaN": at(math.nan),
        "an infinite heater": at(ncr22=math.inf),
        "minus infinity": at(-math.inf),
        "a jump from what is played": at(0.9),
        "a jump down": at(-0.3),
        "a heater's jump": at(0.4, ncr22=10.1),
        "a turbine valve's jump": at(0.4, cv156=0.11),
    }
    listed = {
        "no rows": [],
        "steps whose sum is a jump": [at(0.4), at(0.75), at(0.81)],
        **{name: [*rows[:10], row, *rows[11:]] for name, row in row_faults.items()},
    }
    header, sent = sequence = bench.sequence(listed.get(fault, rows), **header_faults.get(fault, {}))
    if fault == "torn rows":
        return InputSequence(header, [*sent[:10], *[as_transmitted(at(0.3))] * 10])
    if fault == "a CRC with one bit wrong":
        return InputSequence(header._replace(crc=header.crc ^ 0x10000), sent)
    if fault == "a header changed after it was sealed":
        return InputSequence(header._replace(first_tick=13), sent)
    assert fault in header_faults | listed
    return sequence


FAULTS = {
    "no rows": Verdict.NO_ANSWER,
    "a length that is not that of the rows": Verdict.WRONG_LENGTH,
    "torn rows": Verdict.BAD_CRC,
    "a CRC with one bit wrong": Verdict.BAD_CRC,
    "a header changed after it was sealed": Verdict.BAD_CRC,
    "another model": Verdict.WRONG_MODEL,
    "a number that was played before": Verdict.REPEATED,
    "a first tick that has passed": Verdict.LATE,
    "an earlier update": Verdict.WRONG_UPDATE,
    "an update to come": Verdict.WRONG_UPDATE,
    "a first tick before the planned one": Verdict.WRONG_TICK,
    "a first tick after the planned one": Verdict.WRONG_TICK,
    "another updating period": Verdict.WRONG_TICK,
    "a valve below its range": Verdict.OUT_OF_RANGE,
    "a valve above its range": Verdict.OUT_OF_RANGE,
    "a heater below its range": Verdict.OUT_OF_RANGE,
    "a heater above its range": Verdict.OUT_OF_RANGE,
    "a NaN": Verdict.OUT_OF_RANGE,
    "an infinite heater": Verdict.OUT_OF_RANGE,
    "minus infinity": Verdict.OUT_OF_RANGE,
    "a jump from what is played": Verdict.RATE_EXCEEDED,
    "a jump down": Verdict.RATE_EXCEEDED,
    "a heater's jump": Verdict.RATE_EXCEEDED,
    "a turbine valve's jump": Verdict.RATE_EXCEEDED,
    "steps whose sum is a jump": Verdict.RATE_EXCEEDED,
}


def test_the_faults_reach_every_verdict_of_a_rejection() -> None:
    others = {Verdict.NONE, Verdict.ACCEPTED, Verdict.NOT_INVITED, Verdict.PLANT_LOST}
    assert set(FAULTS.values()) == set(Verdict) - others


@pytest.mark.parametrize(("fault", "verdict"), FAULTS.items(), ids=FAULTS)
def test_a_faulty_sequence_is_rejected_with_its_reason_and_never_reaches_the_actuators(
    playing: "Bench", at: At, fault: str, verdict: Verdict
) -> None:
    sequence = wrong(playing, at, fault)
    assert playing.offer(sequence) == Acknowledgement(sequence.header.number, verdict)
    program = playing.program
    assert program.player.acknowledgement == Acknowledgement(sequence.header.number, verdict)
    assert (program.player.accepted, program.player.rejected, program.player.playing) == (1, 1, 1)
    expected = as_transmitted(at(0.3))
    assert set(playing.scans(38)) == {expected}
    assert (program.player.playing, program.player.deadline_misses) == (
        1,
        2,
    )  # its own instant, and the silence after it


@pytest.mark.parametrize("fault", FAULTS)
def test_after_a_rejection_a_right_sequence_is_still_taken(playing: "Bench", at: At, fault: str) -> None:
    playing.offer(wrong(playing, at, fault))
    assert playing.offer(playing.sequence([at(0.4)] * 20)).verdict == Verdict.ACCEPTED
    applied = playing.scans(12)
    assert applied[6] == as_transmitted(at(0.3))
    assert applied[7] == as_transmitted(at(0.4))


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_after_a_right_sequence_does_not_displace_it(playing: "Bench", at: At, fault: str) -> None:
    assert playing.offer(playing.sequence([at(0.4)] * 20)).verdict == Verdict.ACCEPTED
    playing.offer(wrong(playing, at, fault))
    assert playing.scans(10)[7:] == [as_transmitted(at(0.4))] * 3
    assert playing.program.player.playing == 2


def test_a_sequence_before_its_plan_answers_no_update(bench: "Bench", at: At) -> None:
    sequence = bench.sequence([at(0.1)] * 20, first_tick=5, tau_u=5)
    assert bench.offer(sequence).verdict == Verdict.WRONG_UPDATE
    assert bench.plan(5)
    assert bench.offer(sequence).verdict == Verdict.ACCEPTED


def test_an_accepted_sequence_cannot_be_committed_twice(bench: "Bench", at: At) -> None:
    assert bench.plan(5)
    sequence = bench.sequence([at(0.1)] * 20)
    verdicts = [bench.offer(sequence).verdict, bench.offer(sequence).verdict]
    assert verdicts == [Verdict.ACCEPTED, Verdict.REPEATED]
    bench.scans(6)
    assert bench.offer(sequence).verdict == Verdict.REPEATED


def test_an_answer_is_late_from_the_moment_its_scan_begins(bench: "Bench", at: At) -> None:
    assert bench.plan(2)
    sequence = bench.sequence([at(0.1)] * 20)
    bench.scan()
    actuators = bench.program.begin_scan()
    assert bench.offer(sequence).verdict == Verdict.LATE
    bench.program.end_scan(bench.measurement(actuators))
    assert bench.offer(sequence).verdict == Verdict.LATE
    assert bench.program.player.deadline_misses == 1


def test_an_answer_that_comes_just_before_its_scan_is_in_time(bench: "Bench", at: At) -> None:
    assert bench.plan(2)
    sequence = bench.sequence([at(0.1)] * 20)
    bench.scan()
    assert bench.program.awaiting_sequence
    assert bench.offer(sequence).verdict == Verdict.ACCEPTED
    assert not bench.program.awaiting_sequence
    assert bench.scan()[0] == as_transmitted(at(0.1))


def test_rounding_to_single_precision_is_no_violation_and_the_guard_still_allows_none(bench: "Bench", at: At) -> None:
    bench.play([at(cv156=0.1)] * 20, ticks=4)
    bench.scan()
    first, second = as_transmitted(at(cv156=0.1)).cv156, as_transmitted(at(cv156=0.2)).cv156
    assert second - first > 0.1
    bench.play([at(cv156=0.2)] * 20, ticks=4)
    applied = bench.scans(1)[0].cv156
    assert applied - first <= 0.1
    assert applied == pytest.approx(second, abs=1e-5)


def test_a_swing_from_one_edge_of_the_window_to_the_other_is_too_large_a_step(bench: "Bench", at: At) -> None:
    assert bench.plan(4)
    swing = bench.sequence([at(0.5), at(-0.5)])
    assert bench.offer(swing).verdict == Verdict.RATE_EXCEEDED


def test_a_sequence_is_judged_against_what_is_played_just_before_it_begins(bench: "Bench", at: At) -> None:
    bench.play([*[at(0.4)] * 6, *[at(0.0)] * 2, *[at(-0.4)] * 32], ticks=4)
    bench.scan()
    assert bench.plan(10)
    assert bench.offer(bench.sequence([at(0.2)] * 20)).verdict == Verdict.RATE_EXCEEDED
    assert bench.offer(bench.sequence([at(-0.8)] * 20)).verdict == Verdict.ACCEPTED


def test_a_sequence_is_judged_against_the_last_row_when_the_one_before_will_have_run_out(
    bench: "Bench", at: At
) -> None:
    bench.play([*[at(0.4)] * 3, *[at()] * 2, *[at(-0.4)] * 3], ticks=4)
    bench.scan()
    assert bench.plan(10)
    assert bench.offer(bench.sequence([at(0.2)] * 20)).verdict == Verdict.RATE_EXCEEDED
    assert bench.offer(bench.sequence([at(-0.8)] * 20)).verdict == Verdict.ACCEPTED


def test_with_elapsed_rates_a_missed_deadline_does_not_widen_what_is_accepted(
    new_bench: "Callable[[InputLimits], Bench]", at: At
) -> None:
    """A window begins anew at tick 24, 20 ticks after the last sequence: an update at tick 29 has a quarter of it."""
    bench = new_bench(InputLimits(rate_reference=RateReference.ELAPSED))
    bench.scan()
    bench.play([at()] * 60, ticks=4)
    bench.scan()
    assert bench.plan(10)
    bench.scans(10)
    assert bench.program.player.deadline_misses == 1
    assert bench.plan(15)
    offered = bench.offer(bench.sequence([at(0.4)] * 20))
    assert offered.verdict == Verdict.RATE_EXCEEDED or bench.scans(15)[-1] == as_transmitted(at(0.4))


moves = st.tuples(*[st.floats(-1.05, 1.05)] * 3)
STILL = [(0.0, 0.0, 0.0)]
updates = st.tuples(st.integers(1, 20), st.lists(moves, min_size=1, max_size=4))


@example(
    reference=RateReference.PER_UPDATE, script=[(15, STILL), (15, STILL), (18, STILL), (18, STILL), (15, STILL * 4)]
)
@given(reference=st.sampled_from(RateReference), script=st.lists(updates, max_size=8))
def test_what_is_accepted_is_what_is_applied(
    new_bench: "Callable[[InputLimits], Bench]",
    reference: RateReference,
    script: list[tuple[int, list[tuple[float, float, float]]]],
) -> None:
    """No accepted sequence is bent by the guard, but for what single precision cannot tell."""
    limits = InputLimits(rate_reference=reference)
    bench = new_bench(limits)
    bench.steady = True  # outputs that count the ticks leave their sensors' ranges, and MPC is left for that
    now, _ = bench.scan()
    for ticks, wanted in script:
        assert bench.plan(ticks)
        rows, row, share = [], now, limits.rate_share(ticks)
        for move in wanted:  # one move in every 20 ticks, some of them a little more than the rate
            row = Row(*[u + share * rate * part for u, rate, part in zip(row, limits.rate, move, strict=True)])
            rows += [row] * 20
            share = 1.0
        sequence = bench.sequence(rows)
        accepted = bench.offer(sequence).verdict == Verdict.ACCEPTED
        bench.scans(ticks - 1)
        now, update = bench.scan()
        assert update is not None
        if not accepted:
            return
        for value, asked, low, high in zip(now, sequence.rows[0], limits.low, limits.high, strict=True):
            assert abs(value - asked) <= 1.1e-5 * (high - low)
    played = bench.program.player.playing
    if played:
        for asked_row, applied in zip(sequence.rows[1:], bench.scans(len(sequence.rows) - 1), strict=True):
            for value, asked, low, high in zip(applied, asked_row, limits.low, limits.high, strict=True):
                assert abs(value - asked) <= 1.1e-5 * (high - low)
