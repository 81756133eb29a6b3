"""Whatever clients, operators, networks and restarts do: nobody moves the outputs who does not know what is applied."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from coldloop.process.settings import InputLimits
from coldloop.registers.common import EventKind, LeaseState, LeaseStatus, WatchdogStatus, WatchdogTime
from coldloop.registers.plant import Actuators, Measurement, OutputVerdict, PlantSession

if TYPE_CHECKING:
    from tests.plant.conftest import RackClient, RackOnTheBus

Outputs = tuple[float, float, float]
SAFE = (30.0, 50.0, 40.0)
RATE = InputLimits().rate
NUMBERS = (77, 78, 0, 0)
"""Two control PLCs and two simple clients."""

clients = st.integers(0, len(NUMBERS) - 1)
outputs = st.tuples(st.integers(0, 100), st.integers(0, 1000), st.integers(0, 100)).map(lambda u: tuple(map(float, u)))


class Writer:
    """A client, and what it may believe to be applied: what it read last, or what it has sent since."""

    def __init__(self, connection: "RackClient") -> None:
        self.connection = connection
        self.generation = 0
        self.believed: list[Outputs] = []

    def learns(self, measurement: Measurement) -> None:
        self.generation = measurement.generation
        self.believed = [measurement.u]  # type: ignore[list-item] # three of them


class RackMachine(RuleBasedStateMachine):
    def __init__(self, switch_on: "type[RackOnTheBus]") -> None:
        super().__init__()
        self._switch_on = switch_on
        self._folder = tempfile.TemporaryDirectory()

    def teardown(self) -> None:
        self._folder.cleanup()

    @initialize(realtime=st.booleans(), safe=st.booleans(), limited=st.booleans())
    def begin(self, *, realtime: bool, safe: bool, limited: bool) -> None:
        self.action = "safe" if safe else "hold"
        self.mode = "realtime" if realtime else "lockstep"
        self.limited = limited
        self.beginning: tuple[int, tuple[float, ...]] = (-1, ())
        """The last tick in which somebody wrote, and what was applied when it began."""
        self.rack = self.switched_on()
        self.writers = [Writer(self.rack.client(f"client {place}", number)) for place, number in enumerate(NUMBERS)]
        self.applied = self.rack.shown()

    def switched_on(self) -> "RackOnTheBus":
        return self._switch_on(
            session={"mode": self.mode},
            watchdog={"timeout_s": 3.0, "action": self.action, "safe_state": SAFE},
            rate_limited=self.limited,
            retain={"file": str(Path(self._folder.name) / "plant")},
        )

    def read(self) -> Measurement:
        self.before, self.applied = self.applied, self.rack.shown()
        return self.applied

    def unchanged(self) -> None:
        """What is applied is what was applied, and whose it was."""
        now = self.read()
        assert (now.u, now.holder, now.generation) == (self.before.u, self.before.holder, self.before.generation)

    # -- clients -------------------------------------------------------------------------------------------------------

    @rule(
        place=clients, u=outputs, late=st.sampled_from([0] * 4 + [1, -1, 9, -9]),
        session_off=st.sampled_from([0] * 6 + [1]), compares=st.sampled_from([True] * 3 + [False]), lost=st.booleans(),
    )  # fmt: skip
    def exchange(self, place: int, u: Outputs, late: int, session_off: int, *, compares: bool, lost: bool) -> None:
        writer, present = self.writers[place], self.rack.registers.rack
        sent = writer.connection.outputs(
            *u, tick=max(0, present.tick - late), session=present.session.number + session_off,
            generation=writer.generation if compares else 0,
        )  # fmt: skip
        timely = abs(sent.tick - present.tick) <= (8 if present.session.pace.realtime else 0)
        lease = self.rack.operator.read(LeaseStatus)
        if self.beginning[0] != present.tick:
            self.beginning = present.tick, self.applied.u
        answer = writer.connection.exchange(sent)
        if not isinstance(answer, Measurement):
            assert answer == (6,)
            assert lease.state != LeaseState.FREE, "nobody is refused while nobody holds the lease"
            assert self.rack.operator.read(LeaseStatus).refused == lease.refused + 1
            self.unchanged()
            return
        self.judge(writer, sent, answer, timely=timely)
        if not lost:
            writer.learns(answer)
        else:
            writer.believed.append(u)
        self.read()

    def judge(self, writer: Writer, sent: Actuators, answer: Measurement, *, timely: bool) -> None:
        before, verdict = self.applied, answer.verdict
        assert (verdict == OutputVerdict.WRONG_SESSION) == (sent.session != answer.session)
        assert (verdict == OutputVerdict.STALE) == (sent.session == answer.session and not timely)
        if verdict == OutputVerdict.ACCEPTED:
            assert (answer.u, answer.holder) == (sent.u, writer.connection.number)
            assert sent.generation in (0, answer.generation)
            assert not sent.generation or before.u in writer.believed, "it did not know what was applied"
            return
        if verdict == OutputVerdict.LIMITED:
            assert self.limited
            assert answer.u != sent.u
            moves = [abs(after - base) for after, base in zip(answer.u, self.beginning[1], strict=True)]
            assert all(move <= rate + 1e-4 for move, rate in zip(moves, RATE, strict=True))
            assert answer.generation > before.generation, "its writer does not know what is applied"
            return
        assert (answer.u, answer.holder) == (before.u, before.holder)
        if verdict == OutputVerdict.CHANGED:
            assert sent.generation not in (0, answer.generation)
            assert answer.generation >= before.generation
        else:
            assert answer.generation == before.generation

    @rule(place=clients)
    def look(self, place: int) -> None:
        writer = self.writers[place]
        writer.learns(writer.connection.read(Measurement))
        self.unchanged()

    @rule(place=clients)
    def reconnect(self, place: int) -> None:
        """Believes and knows what it did before."""
        writer = self.writers[place]
        writer.connection.closes()
        writer.connection = self.rack.client(f"client {place}", NUMBERS[place])
        self.unchanged()

    @rule(place=clients, time=st.sampled_from([0, 4, 40]))
    def set_watchdog(self, place: int, time: int) -> None:
        answer = self.writers[place].connection.write(WatchdogTime(time))
        assert answer in (None, (6,))
        assert answer is not None or self.rack.operator.read(WatchdogStatus).time == time
        self.unchanged()

    # -- time, operators, restarts -------------------------------------------------------------------------------------

    @rule(seconds=st.sampled_from([0.5, 2.0, 20.0]))
    def time_passes(self, seconds: float) -> None:
        rack, ticks = self.rack.registers.rack, round(4 * seconds)
        if not rack.moving:
            self.rack.now += seconds
            self.unchanged()
            return
        trips = rack.watchdog.trips
        self.rack.passes(ticks)
        if rack.watchdog.trips == trips or self.action == "hold":
            self.unchanged()
            return
        self.read()
        assert (self.applied.u, self.applied.holder) == (SAFE, 0)
        assert self.applied.generation == self.before.generation + 1
        assert self.applied.verdict == OutputVerdict.NONE

    @rule(same=st.booleans(), realtime=st.booleans())
    def session_begins(self, *, same: bool, realtime: bool) -> None:
        number = self.applied.session + (not same)
        assert self.rack.operator.write(PlantSession(number, int(realtime), 1.0, 1, 1)) is None
        self.read()
        self.beginning = (-1, ())
        assert (self.applied.tick, self.applied.session, self.applied.holder) == (0, number, 0)
        assert self.applied.generation == self.before.generation + 1
        assert self.applied.verdict == OutputVerdict.NONE

    @rule(session=st.builds(PlantSession, st.just(0), st.just(1), st.just(1.0), st.just(1), st.sampled_from([0, 1, 7])))
    def session_is_refused(self, session: PlantSession) -> None:
        assert self.rack.operator.write(session) == (3,)
        self.unchanged()

    @precondition(lambda self: self.applied.tick > 0)
    @rule()
    def rack_restarts(self) -> None:
        now, events = self.rack.now, self.rack.registers.rack.journal.count
        self.rack = self.switched_on()
        self.rack.now = now + 5.0
        for place, writer in enumerate(self.writers):
            writer.connection = self.rack.client(f"client {place}", NUMBERS[place])
        self.read()
        self.beginning = (-1, ())
        assert self.applied.generation > self.before.generation
        assert self.applied.verdict == OutputVerdict.NONE
        (boot,) = self.rack.events(EventKind.BOOT)
        assert (boot.number, boot.subject) == (events + 1, 1)

    # -- always --------------------------------------------------------------------------------------------------------

    @invariant()
    def the_lease_says_who_may_write(self) -> None:
        lease = self.rack.operator.read(LeaseStatus)
        if lease.state == LeaseState.FREE:
            assert not lease.holder
            assert not any(lease.who)
        else:
            assert any(lease.who)


def test_nobody_moves_the_outputs_who_does_not_know_what_is_applied(switch_on: "type[RackOnTheBus]") -> None:
    run_state_machine_as_test(
        lambda: RackMachine(switch_on),
        settings=settings(max_examples=2 * settings.default.max_examples, stateful_step_count=40),
    )
