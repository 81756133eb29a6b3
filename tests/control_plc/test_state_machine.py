"""Whatever the interleaving of writes, losses, restarts and ticks: the contract and the ladder as a state machine."""

import json
import math
from itertools import pairwise

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, precondition, rule

from coldloop.process.cold_box import COLD_BOX, L1, T5
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits, RateReference
from coldloop.registers.common import ALL_ALARMS, AlarmAction, AlarmCommand, AlarmKind, AlarmState, EventKind
from coldloop.registers.control_plc import (
    Cause,
    Heartbeat,
    Mode,
    Operator,
    OperatorMode,
    Plan,
    SequenceHeader,
    Verdict,
)
from coldloop.registers.plant import Measurement
from coldloop.safety.writers import InputSequence, with_checksum
from coldloop.session import TimeBase
from coldloop_control_plc.program import ControlProgram, make_program
from coldloop_control_plc.sessions import ControlStateStore, RetainedControlState
from coldloop_control_plc.settings import ControlSection
from tests.harness.records import Row, as_transmitted

HEADER = read_header(DEFAULT_MODEL_FILE)
SECTION = ControlSection.model_validate(
    {"ladder": {"hold_s": 3.0, "optimizer_timeout_s": 8.0}, "sensors": {"bridged_s": 2.0}}
)
WINDOW = 20
SAFE_STATE = Row(30.0, 50.0, 40.0)
SLACK = (4e-6, 1e-5, 4e-6)
"""Half a unit of the last place of what is applied, twice."""

shares = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


class Link(RuleBasedStateMachine):
    """An optimiser, an operator and a plant that do what they like; what reaches the actuators is watched."""

    sent = Bundle("sent")

    @initialize(reference=st.sampled_from(RateReference))
    def begin(self, reference: RateReference) -> None:
        self.limits = InputLimits(rate_reference=reference)
        self.program = self.new_program()
        self.program.restart(session=1)
        self.number = 0
        self.load = HEADER.w0
        self.readings: dict[int, float] = {}
        self.drift = (0.0, 0.0)
        """Level and temperature, off their setpoints: the loops have something to do."""
        self.ticks: list[int] = [-1]
        self.began: list[int] = []
        """Places in the trace at which a sequence began, or a restart forgot the window."""
        self.trace: list[Row] = [Row(*HEADER.u0)]
        """Every value that has reached the actuators, tick by tick."""
        self.promised: InputSequence | None = None
        """An accepted sequence that nothing has voided."""
        self.accepted_rows: set[Row] = set()
        self.approaches = False
        """The rack was at its safe state: the outputs return to what is played at their rates."""
        self.scan()

    def new_program(self) -> ControlProgram:
        return make_program(HEADER, SECTION, self.limits)

    # -- the plant -----------------------------------------------------------------------------------------------------

    def scan(self) -> None:
        program = self.program
        due = self.promised is not None and self.promised.header.first_tick == program.tick
        actuators = program.begin_scan()
        applied = Row(*actuators.u)
        if due and self.promised is not None:
            assert applied == self.promised.rows[0], "an accepted sequence begins at its tick"
            assert program.mode in (Mode.MPC, Mode.REST)
            self.began.append(len(self.trace))
            self.promised = None
        if program.mode in (Mode.MPC, Mode.REST):
            wanted = Row(*program.ladder.wanted)
            assert wanted in self.accepted_rows, "only what was accepted whole is played"
            self.approaches = self.approaches and applied != wanted
            assert applied == wanted or self.approaches
        self.trace.append(applied)
        self.ticks.append(actuators.tick)
        y = list(HEADER.y0)
        y[L1] += self.drift[0]
        y[T5] += self.drift[1]
        for output, reading in self.readings.items():
            y[output] = reading
        before = program.player.update
        program.end_scan(Measurement(program.tick, self.load, tuple(y), HEADER.x0, program.session, (0.0,) * 3))
        self.scanned = True
        if program.player.update is not before:
            self.promised = None  # a load step, a bad sensor: the update that it answered is over

    @rule(ticks=st.integers(1, 25))
    def time_passes(self, ticks: int) -> None:
        for _ in range(ticks):
            self.scan()

    @rule(step=st.floats(-100.0, 100.0))
    def the_load_moves(self, step: float) -> None:
        self.load = HEADER.w0 + step

    @rule(level=st.floats(-3.0, 3.0), temperature=st.floats(-3.0, 3.0))
    def the_process_drifts(self, level: float, temperature: float) -> None:
        self.drift = (level, temperature)

    @rule(output=st.sampled_from([L1, T5, 4]), reading=st.sampled_from([math.nan, math.inf, -1e9, 60.0]))
    def a_sensor_fails(self, output: int, reading: float) -> None:
        self.readings[output] = reading

    @rule()
    def the_sensors_are_repaired(self) -> None:
        self.readings.clear()

    @rule(ticks=st.integers(-1, 60))
    def time_leaps_or_the_rack_is_one_tick_back(self, ticks: int) -> None:
        program = self.program
        tick = max(0, program.tick + ticks)
        if self.promised is not None and self.promised.header.first_tick < tick:
            self.promised = None
        if ticks < 0:
            self.promised = None
        program.rejoin(tick, self.trace[-1])

    @rule()
    def the_rack_has_gone_to_its_safe_state(self) -> None:
        """Not by our doing: what we do from there on is what counts."""
        self.trace.append(SAFE_STATE)
        self.ticks.append(self.program.tick)
        self.began.append(len(self.trace))
        self.promised = None
        self.approaches = True
        self.program.rejoin(self.program.tick, SAFE_STATE)

    # -- the optimiser -------------------------------------------------------------------------------------------------

    @rule(ticks=st.integers(0, 25), load_step=st.sampled_from([0.0, 0.0, 20.0]), update=st.sampled_from([0, 0, 0, 1]))
    def a_plan_arrives(self, ticks: int, load_step: float, update: int) -> None:
        latched = self.program.player.update
        if latched is not None:
            self.program.accept_plan(Plan(latched.update + update, latched.tick + ticks, load_step))

    @rule(target=sent, moves=st.lists(shares, min_size=1, max_size=30), damage=st.sampled_from(["", "", "", "torn"]),
          excess=st.sampled_from([0.99, 0.99, 0.99, 1.5]))  # fmt: skip
    def a_sequence_arrives(self, moves: list[tuple[float, ...]], damage: str, excess: float) -> InputSequence:
        player, applied = self.program.player, self.program.applied
        first = player.next_update_tick
        rows = [
            as_transmitted(
                Row(*[u + excess * m * r for u, m, r in zip(applied, move, self.limits.rate, strict=True)])
            )
            for move in moves
        ]  # fmt: skip
        self.number += 1
        update = player.update
        header = SequenceHeader(
            self.number, update.update if update else 0, first, len(rows), first - update.tick if update else 0,
            HEADER.short_digest, 0,
        )  # fmt: skip
        sequence = with_checksum(header, rows)
        if damage:
            rows = [*rows[:-1], rows[-1]._replace(cv155=rows[-1].cv155 + 0.001)]
            sequence = InputSequence(sequence.header, [as_transmitted(row) for row in rows])
        self.offer(sequence)
        return sequence

    @rule(sequence=sent)
    def an_old_sequence_arrives_again(self, sequence: InputSequence) -> None:
        self.offer(sequence)

    def offer(self, sequence: InputSequence) -> None:
        answer = self.program.offer(sequence)
        if answer.verdict == Verdict.ACCEPTED:
            self.promised = sequence
            self.accepted_rows |= set(sequence.rows)

    @rule()
    def the_optimiser_has_lost_the_thread(self) -> None:
        self.program.abandon()

    @rule()
    def the_optimiser_is_lost(self) -> None:
        self.program.optimizer_lost()

    @rule(digest=st.sampled_from([HEADER.short_digest, 0xBAD]))
    def the_optimiser_gives_a_sign(self, digest: int) -> None:
        self.program.heartbeat(Heartbeat(1, digest))

    # -- operators, restarts -------------------------------------------------------------------------------------------

    @rule(
        mode=st.sampled_from(OperatorMode),
        setpoints=st.tuples(st.floats(0, 100), st.floats(0, 1000), st.floats(0, 100)),
    )
    def an_operator_writes(self, mode: OperatorMode, setpoints: tuple[float, ...]) -> None:
        self.program.operate(as_transmitted(Operator(mode, tuple(setpoints))))
        if mode is not OperatorMode.AUTO:
            self.promised = None

    @rule(alarm=st.sampled_from([*AlarmKind, ALL_ALARMS]), action=st.sampled_from(AlarmAction))
    def alarms_are_handled(self, alarm: int, action: AlarmAction) -> None:
        self.program.alarms.command(AlarmCommand(alarm, action))

    @precondition(lambda self: self.program.tick > 0)
    @rule()
    def the_control_plc_is_killed_and_comes_back(self) -> None:
        store = ControlStateStore(None, HEADER.short_digest, COLD_BOX)
        content = store.content(self.program, TimeBase(realtime=False, factor=1.0))
        kept = RetainedControlState.parsed(json.loads(json.dumps(content)), COLD_BOX)
        self.program = self.new_program()
        self.program.alarms.restore(kept.alarms)
        self.program.resume(kept.session, kept.tick, self.trace[-1], updates=kept.updates, operator=kept.operator)
        self.promised = None
        self.began.append(len(self.trace))
        self.scanned = False

    # -- what must hold ------------------------------------------------------------------------------------------------

    @invariant()
    def bounds_and_rates_are_kept(self) -> None:
        for earlier, later in pairwise(self.trace[-2 * WINDOW :]):
            if later is SAFE_STATE:
                continue
            for i, value in enumerate(later):
                assert self.limits.low[i] <= value <= self.limits.high[i]
                assert abs(value - earlier[i]) <= self.limits.rate[i] + SLACK[i]

    @invariant()
    def no_longer_span_gains_more_than_its_windows_give(self) -> None:
        """Over three windows without a sequence that begins: one rate for each, and one for a window that was open.

        And one more, as a window goes a rate to either side of its anchor: up first, and then down through all others.
        """
        first = max(0, len(self.trace) - 3 * WINDOW)
        ticks = self.ticks[first:]
        begun = sum(place >= first for place in self.began)
        rates = (max(ticks) - min(ticks)) // WINDOW + 3 + begun
        if any(row is SAFE_STATE for row in self.trace[first:]):
            return
        for i, rate in enumerate(self.limits.rate):
            values = [row[i] for row in self.trace[first:]]
            assert max(values) - min(values) <= rates * (rate + SLACK[i])

    @invariant()
    def lock_step_waits_only_while_mpc_is_wanted(self) -> None:
        program = self.program
        if program.awaiting_plan or program.awaiting_sequence:
            assert program.operator.mode == OperatorMode.AUTO

    @invariant()
    def the_mode_alarm_tells_the_truth(self) -> None:
        program = self.program
        row = program.alarms.rows[AlarmKind.MODE]
        if not self.scanned:
            return
        own_doing = program.ladder.cause in (Cause.SESSION_STARTED, Cause.OPERATOR)
        assert bool(row.active) == (program.mode is not Mode.MPC and not own_doing)
        if row.active:
            assert row.state not in (AlarmState.NORMAL, AlarmState.RETURNED)

    @invariant()
    def each_change_of_mode_is_an_event(self) -> None:
        events = [event for event in self.program.journal.since(0) if event.kind == EventKind.MODE]
        if events:
            assert events[-1].subject == self.program.mode


TestLink = Link.TestCase
TestLink.settings = settings(max_examples=3 * settings.default.max_examples, stateful_step_count=60)
