"""The control PLC against a rack that loses, delays, damages, repeats, freezes and skews, judged by what it applies.

The rack is the real one over a plant that does nothing. Between it and the scan cycle is a medium with every fault that
a link can have; programs stand still and restart, other masters write, operators restart sessions. Time is simulated.
"""

import json
import math
from collections.abc import Sequence
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from coldloop.errors import DamagedAnswerError, LinkError, PeerUnreachableError, RequestRefusedError
from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits, RateReference
from coldloop.registers.bank import BusyError, Caller
from coldloop.registers.common import LeaseState
from coldloop.registers.control_plc import (
    Operator,
    OperatorMode,
    Plan,
    PlantLinkState,
    SequenceHeader,
    Verdict,
)
from coldloop.registers.declaration import Role
from coldloop.registers.plant import Actuators, Measurement, OutputVerdict
from coldloop.safety.writers import InputSequence, WriterLease, with_checksum
from coldloop.service.journal import Journal
from coldloop.session import TimeBase
from coldloop_control_plc.plant_link import PlantLink
from coldloop_control_plc.program import make_program
from coldloop_control_plc.rack import PHASE, RackClock, ScanCycle
from coldloop_control_plc.sessions import ControlStateStore, RetainedControlState
from coldloop_control_plc.settings import ControlSection
from coldloop_plant.rack import Rack, Session
from coldloop_plant.settings import SafeAction, WatchdogSettings
from tests.harness.records import Row, as_transmitted

HEADER = read_header(DEFAULT_MODEL_FILE)
SECTION = ControlSection.model_validate({"ladder": {"hold_s": 3.0, "optimizer_timeout_s": 8.0}})
SAFE_STATE = (30.0, 50.0, 40.0)
LIMITS = InputLimits()
SLACK = (4e-6, 1e-5, 4e-6)
"""Half a unit of the last place of what is applied, twice."""

US = frozenset({Role.CONTROL})

FATES = st.sampled_from(
    ["good"] * 6 + ["request lost", "answer lost", "request damaged", "answer damaged", "repeated", "delayed", "reset"]
)


STANDSTILLS = st.one_of(st.floats(0.3, 2.0), st.floats(2.0, 30.0))
"""s: some are so short that outputs are still timely after them, and a short watchdog has acted all the same."""


class StillPlant:
    """A plant whose measurements tremble, and which does nothing else."""

    def __init__(self, load: LoadProfile, _seed: int) -> None:
        self.tick = 0
        self._load = load
        self.state = HEADER.x0
        self.station = self.station_status = None
        self.model_range = 0

    @property
    def load(self) -> float:
        return self._load.value(self.tick)

    def measure(self) -> tuple[float, ...]:
        return tuple(value + 0.001 * (self.tick % 7) for value in HEADER.y0)

    def apply(self, u: Sequence[float]) -> None:
        assert all(map(math.isfinite, u))

    def advance(self) -> None:
        self.tick += 1


class FakeRack:
    """The rack with its lease and its clock, and what it has applied."""

    def __init__(self, *, realtime: bool, skew: float, watchdog_s: float) -> None:
        self.now = 0.0
        self.realtime = realtime
        self.skew = skew
        self.frozen = False
        self.lies_not_a_number = False
        self.journal = Journal(now=lambda: self.now)
        watchdog = WatchdogSettings(timeout_s=watchdog_s, action=SafeAction.SAFE, safe_state=SAFE_STATE)
        self.rack = Rack(watchdog, HEADER.u0, StillPlant, self.session(1), journal=self.journal)  # type: ignore[arg-type]
        self.lease = WriterLease("the outputs", lambda: self.rack.silence_s, now=lambda: self.now)
        self.fraction = 0.0
        self.own_steps: list[tuple[float, ...]] = []

    def session(self, number: int) -> Session:
        return Session(number, TimeBase(self.realtime, 1.0), LoadProfile((0,), (HEADER.w0,)), 1)

    def passes(self, seconds: float) -> None:
        """Let real time pass; in real time the plant moves with it."""
        self.now += seconds
        if self.realtime and self.rack.moving and not self.frozen:
            self.fraction += seconds / TICK_S * (1.0 + self.skew)
            while self.fraction >= 1.0:
                self.fraction -= 1.0
                self.rack.advance()

    def write(self, outputs: Actuators, caller: Caller, *, ours: bool) -> Measurement:
        """Take outputs as the server would; `ours` are judged: no step beyond the rate."""
        try:
            self.lease.check(caller, outputs.holder)
        except BusyError as error:
            raise RequestRefusedError("busy", 6) from error
        self.lease.take(caller, outputs.holder)
        before, outputs = self.rack.outputs.u, as_transmitted(outputs)
        verdict = self.rack.offer(outputs, caller)
        if verdict is OutputVerdict.ACCEPTED and ours:
            self.judge(before, self.rack.outputs.u)
        answer = self.read()
        if not self.realtime and self.rack.moving:
            self.rack.advance()
        return answer

    def judge(self, before: Sequence[float], after: Sequence[float]) -> None:
        for old, new, rate, slack in zip(before, after, LIMITS.rate, SLACK, strict=True):
            assert math.isfinite(new)
            assert abs(new - old) <= rate + slack, (before, after)
        for old, new, low, high in zip(before, after, LIMITS.low, LIMITS.high, strict=True):
            assert low <= new <= high or min(abs(new - low), abs(new - high)) <= min(abs(old - low), abs(old - high))

    def read(self) -> Measurement:
        reading = as_transmitted(self.rack.measurement(self.fraction if self.realtime else 0.0))
        return reading._replace(u=(math.nan, *reading.u[1:])) if self.lies_not_a_number else reading


class Medium:
    """The link from the control PLC to the rack; a connection has a number, and a fault ends it."""

    def __init__(self, rack: FakeRack) -> None:
        self.rack = rack
        self.connection = 1
        self.delayed: list[tuple[Actuators, Caller]] = []

    def caller(self) -> Caller:
        return Caller("control PLC", US, self.connection)

    def ask(self, outputs: Actuators | None, fate: str) -> Measurement:
        """Carry a request, or fail of it."""
        if fate in ("request lost", "reset"):
            self.broken("request lost")
        if fate == "request damaged":
            raise RequestRefusedError("a wrong CRC", 3)
        if fate == "delayed":  # it arrives when nobody waits any more
            if outputs is not None:
                self.delayed.append((outputs, self.caller()))
            self.broken("timed out")
        answer = self.rack.read() if outputs is None else self.rack.write(outputs, self.caller(), ours=True)
        if fate == "repeated" and outputs is not None:
            answer = self.rack.write(outputs, self.caller(), ours=True)
        if fate == "answer lost":
            self.broken("timed out")
        if fate == "answer damaged":
            raise DamagedAnswerError("a wrong CRC")
        return answer

    def broken(self, reason: str) -> None:
        self.rack.lease.closed(self.caller())
        self.connection += 1
        raise PeerUnreachableError(reason)

    def late_frames_arrive(self) -> None:
        for outputs, caller in self.delayed:
            try:
                self.rack.write(outputs, caller, ours=True)
            except LinkError:
                continue
        self.delayed.clear()


class RackLink(RuleBasedStateMachine):
    """Everything that can happen to the link, in any order."""

    @initialize(
        realtime=st.booleans(),
        skew=st.sampled_from([0.0, 2e-4, -2e-4, 0.025, -0.025]),
        reference=st.sampled_from(RateReference),
        remembers=st.booleans(),
        watchdog_s=st.sampled_from([0.75, 5.0]),
    )
    def begin(
        self, *, realtime: bool, skew: float, reference: RateReference, remembers: bool, watchdog_s: float
    ) -> None:
        self.realtime = realtime
        self.limits = InputLimits(rate_reference=reference)
        self.fake = FakeRack(realtime=realtime, skew=skew, watchdog_s=watchdog_s)
        self.medium = Medium(self.fake)
        self.remembers = remembers
        self.holder = 0xC01D
        self.number = 0
        self.accepted: InputSequence | None = None
        self.session = 1
        self.kept: dict[str, Any] | None = None
        self.power_up()
        self.program.restart(session=1)
        self.link.begin()

    def power_up(self) -> None:
        self.program = make_program(HEADER, SECTION, self.limits)
        self.link = PlantLink(self.program.alarms, self.program.journal, self.holder)
        self.cycle = ScanCycle(self.program, self.link, self.adopt)
        self.clock = RackClock(1.0, self.fake.now, 0.25)

    def adopt(self, reading: Measurement) -> bool:
        if reading.session != self.session:
            return False
        self.accepted = None
        kept = (
            RetainedControlState.parsed(self.kept, COLD_BOX)
            if self.kept and self.kept["session"] == reading.session
            else None
        )
        self.program.resume(
            reading.session, reading.tick, reading.u, updates=kept.updates if kept else 0,
            operator=kept.operator if kept else self.program.operator, playing=kept.sequence if kept else None,
        )  # fmt: skip
        return True

    # -- the scan cycle ------------------------------------------------------------------------------------------------

    def turn(self, fate: str, *, stands_s: float = 0.0, stands_before_sending: bool = False) -> None:
        """Do what the runtime does once: scan when in step and due, else look; perhaps standing still in between."""
        if self.realtime:
            due = self.clock.due(self.program.tick) if self.link.synchronised else self.fake.now + TICK_S
            self.fake.passes(max(0.0, due - self.fake.now))
            if self.link.synchronised and self.fake.now - due > self.clock.tick_s:
                self.link.missed_scans()
        else:
            self.fake.passes(0.01)
        outputs = self.cycle.begin()
        if stands_before_sending:
            self.fake.passes(stands_s)
        try:
            answer = self.medium.ask(outputs, fate)
        except LinkError as error:
            self.cycle.failed(error)
            self.program.alarms.now = max(self.program.alarms.now, self.clock.tick_at(self.fake.now))
            return
        at = self.fake.now
        if not stands_before_sending:
            self.fake.passes(stands_s)
        joining = not self.link.synchronised
        self.cycle.answered(answer, at / TICK_S if self.realtime else None)
        if self.link.synchronised and joining:
            self.clock.synchronise(answer.tick + (answer.age or (0.0 if answer.tick else PHASE)), at)
        elif self.link.synchronised and self.realtime and answer.tick:
            self.clock.observe(answer.tick + answer.age, at)
        if self.link.synchronised and not joining:
            self.keep()

    def keep(self) -> None:
        content = ControlStateStore(None, HEADER.short_digest, COLD_BOX).content(
            self.program, TimeBase(self.realtime, 1.0)
        )
        content["holder"] = self.holder
        self.kept = json.loads(json.dumps(content)) if self.remembers else None

    @rule(fates=st.lists(FATES, min_size=1, max_size=12))
    def scans(self, fates: list[str]) -> None:
        for fate in fates:
            self.turn(fate)

    @rule(turns=st.integers(1, 45))
    def all_is_well_for_a_while(self, turns: int) -> None:
        """But for what the rack itself does."""
        for _ in range(turns):
            self.turn("good")

    @rule(seconds=STANDSTILLS, before=st.booleans(), fate=FATES)
    def the_control_plc_stands_still_within_an_exchange(self, seconds: float, before: bool, fate: str) -> None:  # noqa: FBT001
        self.turn(fate, stands_s=seconds, stands_before_sending=before)

    @rule(seconds=STANDSTILLS)
    def the_control_plc_stands_still_between_scans(self, seconds: float) -> None:
        self.fake.passes(seconds)

    @rule()
    def late_frames_arrive(self) -> None:
        self.medium.late_frames_arrive()

    @rule(forgets=st.booleans(), seconds=st.floats(0.0, 20.0))
    def the_control_plc_is_killed_and_comes_back(self, forgets: bool, seconds: float) -> None:  # noqa: FBT001
        self.fake.lease.closed(self.medium.caller())
        self.medium.connection += 1
        self.fake.passes(seconds)
        if forgets or not self.remembers:
            self.kept = None
            self.holder += 1
        self.accepted = None
        self.power_up()

    # -- the rack and those around it ----------------------------------------------------------------------------------

    @rule(turns=st.integers(1, 30))
    def the_rack_freezes_for_a_while(self, turns: int) -> None:
        self.fake.frozen = True
        self.all_is_well_for_a_while(turns)
        self.fake.frozen = False

    @rule(turns=st.integers(1, 10))
    def the_rack_shows_no_number_for_a_while(self, turns: int) -> None:
        self.fake.lies_not_a_number = True
        self.all_is_well_for_a_while(turns)
        self.fake.lies_not_a_number = False

    @rule(share=st.tuples(*[st.floats(0.0, 1.0)] * 3), holder=st.sampled_from([0, 0xBAD]), turns=st.integers(0, 60))
    def another_master_writes(self, share: tuple[float, ...], holder: int, turns: int) -> None:
        """It has a connection of its own, moves the outputs as it likes, and may go or stay for a while."""
        other = Caller("other", US, 1_000_000 + holder)
        u = [low + part * (high - low) for part, low, high in zip(share, LIMITS.low, LIMITS.high, strict=True)]
        held = self.fake.lease.state is not LeaseState.FREE and self.fake.lease.holder != holder
        before = self.fake.rack.outputs.u
        for _ in range(turns):
            try:
                self.fake.write(
                    Actuators(self.fake.rack.tick, tuple(u), self.fake.rack.session.number, holder), other, ours=False
                )
            except LinkError:
                assert held
                assert self.fake.rack.outputs.u == before, "who is refused changes nothing"
                break
            self.turn("good")
        self.fake.lease.closed(other)

    @rule(new=st.booleans())
    def an_operator_starts_a_session_on_the_rack(self, *, new: bool) -> None:
        self.session += new
        self.fake.rack.start(self.fake.session(self.session), "operator")
        self.fake.fraction = 0.0

    @rule()
    def an_operator_starts_the_session_of_the_rack(self) -> None:
        self.program.restart(self.session)
        self.accepted = None
        self.link.begin()

    @rule(time=st.sampled_from([0, 3, 20]))
    def an_operator_sets_the_watchdog_of_the_rack(self, time: int) -> None:
        self.fake.rack.set_watchdog(time, "operator")

    @rule(mode=st.sampled_from(OperatorMode), share=st.tuples(*[st.floats(0.0, 1.0)] * 3))
    def an_operator_chooses_the_mode(self, mode: OperatorMode, share: tuple[float, ...]) -> None:
        u = [low + part * (high - low) for part, low, high in zip(share, LIMITS.low, LIMITS.high, strict=True)]
        self.program.operate(as_transmitted(Operator(mode, tuple(u))))

    # -- the optimiser -------------------------------------------------------------------------------------------------

    @rule(ticks=st.integers(2, 20), share=st.tuples(*[st.floats(-1.0, 1.0)] * 3), length=st.integers(2, 60))
    def the_optimiser_answers(self, ticks: int, share: tuple[float, ...], length: int) -> None:
        player = self.program.player
        update = player.update
        if update is None or not self.program.accept_plan(Plan(update.update, update.tick + ticks)):
            return
        row = Row(*[u + part * rate for u, part, rate in zip(self.program.applied, share, LIMITS.rate, strict=True)])
        self.number += 1
        header = SequenceHeader(self.number, update.update, update.tick + ticks, length, ticks, HEADER.short_digest, 0)
        sequence = with_checksum(header, [as_transmitted(row)] * length)
        if self.program.offer(sequence).verdict == Verdict.ACCEPTED:
            self.accepted = sequence

    # -- what must hold ------------------------------------------------------------------------------------------------

    @invariant()
    def only_what_is_in_step_writes(self) -> None:
        assert self.link.synchronised or self.cycle.begin() is None

    @invariant()
    def what_was_accepted_is_played_at_its_time(self) -> None:
        """Unless an operator, a session or time itself has made it void."""
        sequence, player = self.accepted, self.program.player
        if sequence is None or not player.invited or self.program.operator.mode != OperatorMode.AUTO:
            self.accepted = None
            return
        behind = self.program.tick - sequence.header.first_tick
        if behind < 0 and self.link.synchronised and player.playing < sequence.header.number:
            assert player.has_answer or self.was_set_back(), "an accepted sequence is kept until its tick"
        elif 0 < behind < sequence.header.length and self.link.synchronised and not self.was_set_back():
            assert player.playing >= sequence.header.number or player.has_answer, "and begins then"

    def was_set_back(self) -> bool:
        """Time has gone back by more than a sampling period: sequences are void then."""
        update = self.program.player.update
        return update is None or self.accepted is None or update.update != self.accepted.header.update

    @invariant()
    def a_rack_that_is_well_is_joined(self) -> None:
        if self.link.state is PlantLinkState.SYNCHRONISED:
            assert self.link.session == self.program.session

    def teardown(self) -> None:
        """Whatever has happened: when all is well again the control PLC drives the rack within a second or two."""
        if not hasattr(self, "fake"):
            return
        self.medium.delayed.clear()
        self.fake.passes(60.0 if self.fake.rack.watchdog.time else 15.0)
        self.program.operate(Operator(OperatorMode.AUTO, tuple(HEADER.u0)))
        if self.program.session != self.session:
            self.program.restart(self.session)
            self.link.begin()
        for _ in range(12):
            self.turn("good")
        assert self.link.synchronised, (self.link.state.name, self.link.cause.name)
        assert self.fake.rack.outputs.holder == self.link.holder


TestRackLink = RackLink.TestCase
TestRackLink.settings = settings(max_examples=4 * settings.default.max_examples, stateful_step_count=40)
