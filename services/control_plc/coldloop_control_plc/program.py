"""The control PLC's program: scan cycle, fail-safe ladder, alarms.

Pure: no sockets, no clock, no sleeping. A scan is `begin_scan` (decide the outputs), the exchange with the plant's
rack, `end_scan` (take the measurement, latch an update at an updating instant). Who decides the outputs is the
ladder's choice (`ladder.py`); what the optimiser sends goes through the sequence player (`player.py`); the guard has
the last word (`guard.py`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from coldloop.errors import ConfigurationError
from coldloop.process.model_file import ModelHeader
from coldloop.process.settings import InputLimits
from coldloop.registers.audit import EventKind
from coldloop.registers.control_plc import (
    Acknowledgement,
    Cause,
    CoolDownStep,
    Heartbeat,
    LinkCause,
    Mode,
    Operator,
    OperatorMode,
    Plan,
    ProcessNow,
    Update,
    Verdict,
)
from coldloop.registers.plant import MAX_STATE, Actuators, Measurement
from coldloop.registers.safety import Alarm, AlarmKind
from coldloop.safety.sequence import Inputs, InputSequence
from coldloop.safety.watchdog import Watchdog
from coldloop.service.journal import Journal
from coldloop_control_plc.alarms import AlarmPanel
from coldloop_control_plc.classical import ClassicalLoops
from coldloop_control_plc.cool_down import CoolDown
from coldloop_control_plc.guard import OutputGuard
from coldloop_control_plc.ladder import Ladder, LadderInputs
from coldloop_control_plc.player import SequencePlayer
from coldloop_control_plc.process_alarms import OPTIMIZER_DRIVES, ProcessAlarms
from coldloop_control_plc.sensors import SensorMonitor
from coldloop_control_plc.settings import ControlSection, ControlStrategy

SEEN = 0.1
"""Share of its rate by which an input must have moved for the process to show it."""
HANDSHAKE_PAUSE_TICKS = 120
"""After a handshake that came to nothing the classical loops are not held again for so long."""
LOST_TICKS = 4
"""A rack that has been out of step for longer takes no new sequences: they would be played late."""


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """What the control PLC knows of the model: its inputs and outputs at rest, and its digest."""

    inputs: tuple[float, ...]
    outputs: tuple[float, ...]
    model_digest: int


class ControlProgram:
    """One session of the control PLC. `tick` is the tick of the next scan, or of the one in progress."""

    def __init__(
        self, *, limits: InputLimits, point: OperatingPoint, section: ControlSection, journal: Journal | None = None
    ) -> None:
        self._limits = limits
        self._point = point
        self._section = section
        self.alarm_settings = section.alarms
        self._initial = tuple(point.inputs)
        if OutputGuard(limits, self._initial).out_of_range([self._initial]):
            raise ConfigurationError(
                f"limits: the inputs {self._initial} of the operating point are outside; widen low and high, or "
                "give another model.file"
            )
        self._loops = ClassicalLoops(section.classical, limits, point.outputs)
        self.watchdog = Watchdog(section.ladder.optimizer_ticks)
        self.journal = journal or Journal()
        self.alarms = AlarmPanel(self.journal, section.alarms)
        self.restart(session=0)

    def restart(self, session: int) -> None:
        """Begin a session at tick 0 with the initial inputs applied."""
        self.reset_operating_mode()
        self._begin(session, 0, self._initial, updates=0)
        classical = self._section.driver is ControlStrategy.CLASSICAL
        mode = Mode.CLASSICAL if classical else Mode.HOLD
        self.ladder = Ladder(self._section.ladder.hold_ticks, mode, Cause.SESSION_STARTED)
        if session:
            self._note_mode(0)

    def reset_operating_mode(self) -> None:
        """Let those drive whom the configuration names: no operator has said anything."""
        classical = self._section.driver is ControlStrategy.CLASSICAL
        self.operator = Operator(OperatorMode.CLASSICAL if classical else OperatorMode.AUTO, self._initial)

    def recall(self, operator: Operator, alarms: Sequence[Alarm], watchdog: int, tick: int) -> None:
        """Take over what operators had said before a restart, and the alarms; the session is resumed later.

        Args:
            operator: Operating mode and setpoints.
            alarms: All alarms.
            watchdog: Time-out of the optimiser's watchdog, in ticks.
            tick: The last one.
        """
        self.operator = operator
        self.watchdog.set(watchdog, tick)
        self.alarms.begin_at(tick)
        self.alarms.restore(alarms)

    def resume(
        self,
        session: int,
        tick: int,
        applied: Sequence[float],
        *,
        updates: int,
        operator: Operator,
        playing: InputSequence | None = None,
        cool_down: CoolDownStep = CoolDownStep.FINISHED,
    ) -> None:
        """Resume a session after a restart.

        Args:
            session: Its number.
            tick: Where the rack is.
            applied: Its applied outputs.
            updates: Number of the next update.
            operator: What operators have said.
            playing: What was being played. Its rest is played on, if what the rack applies is of it: a state that was
                retained some ticks before the end may hold the sequence before.
            cool_down: Its step then.
        """
        self.operator = operator
        self._begin(session, tick, tuple(applied), updates=updates, cool_down=cool_down)
        ours = playing is not None and tuple(applied) in playing.rows[: max(0, tick - playing.header.first_tick)]
        self.player.resume(playing if ours else None, tick)
        self.ladder = Ladder(self._section.ladder.hold_ticks, Mode.HOLD, Cause.RESTARTED, tick)
        self._note_mode(tick)

    def _begin(
        self,
        session: int,
        tick: int,
        applied: Inputs,
        *,
        updates: int,
        cool_down: CoolDownStep = CoolDownStep.FINISHED,
    ) -> None:
        self.session = session
        self.tick = tick
        self.process: ProcessNow | None = None
        self.optimizer_present = True
        self.shortage = 0.0
        """Of the last plan, as the next."""
        self.suspects = 0
        self.guard = OutputGuard(self._limits, self._initial)
        if applied != self._initial:
            self.guard.begin_at(tick, applied)
        self._before = self.guard.applied
        self.player = SequencePlayer(self.guard, self._point.model_digest, updates=updates)
        self.sensors = SensorMonitor(
            self._section.sensors, self._point.outputs, [SEEN * rate for rate in self._limits.rate]
        )
        self.cool_down = CoolDown(
            self._section.cool_down, self._limits, self._point.inputs, self._point.outputs, cool_down
        )
        self._unknown = False
        """The load or the state that was measured last makes no sense."""
        self._failed_handshake = -math.inf
        self._held_from: int | None = None
        """Since when the loops have been held for the sequence to come."""
        self._held_for_answer = False
        """It had been accepted."""
        self._answer_failed = False
        """A handshake came to nothing with a sequence that had been accepted."""
        self._in_scan = False
        self.watchdog.set(self.watchdog.time, tick)
        self._loops.restart()
        self._process_alarms = ProcessAlarms(self.alarms, self.journal, self.alarm_settings)
        self.alarms.begin_at(tick)

    # -- what others see -----------------------------------------------------------------------------------------------

    @property
    def mode(self) -> Mode:
        """Who decides the outputs."""
        return self.ladder.mode

    @property
    def bad_sensors(self) -> int:
        """Bit i is set when output i is substituted."""
        return self.sensors.mask

    @property
    def has_noted_suspects(self) -> bool:
        """Whether alarm and journal have what the last plan says of suspects."""
        return self._process_alarms.has_noted(self.suspects)

    @property
    def applied(self) -> Inputs:
        """The inputs being applied."""
        return self.guard.applied

    @property
    def remaining(self) -> int:
        """Ticks of the sequence that are still to be played, the present one included."""
        return self.player.remaining(self.tick)

    @property
    def awaiting_plan(self) -> bool:
        """The last update has no updating period yet, and an optimiser is there to choose one."""
        return self.optimizer_present and self.player.awaiting_plan

    @property
    def awaiting_sequence(self) -> bool:
        """An updating instant has come, its sequence has not, and an optimiser is there to send it."""
        return self.optimizer_present and self.player.awaiting_sequence(self.tick)

    @property
    def _usable(self) -> bool:
        """MPC can work with what is measured: it continues without an output of a band, and does not begin without one.

        Nor does it begin before the plant is cold.
        """
        missing = self.sensors.unestimated if self.ladder.mode in OPTIMIZER_DRIVES else self.sensors.unusable
        return not (self.cool_down.is_active or self._unknown or missing)

    @property
    def _earliest(self) -> int:
        return self.tick + self._in_scan

    # -- scan ----------------------------------------------------------------------------------------------------------

    def begin_scan(self) -> Actuators:
        """Decide the outputs of this tick."""
        tick = self.alarms.now = self.tick
        self._in_scan = True
        self._before = self.guard.applied
        if self.watchdog.check(tick):
            self.optimizer_lost()
        began = self.player.begin(tick)
        if self.player.broken_promise and self.ladder.mode is not Mode.CLASSICAL:
            self._failed_handshake = tick
        row = self.player.row(tick)
        self._climb(tick, row)
        applied = self.guard.admit(tick, self._wanted(tick, row), update=began)
        return Actuators(tick, applied, self.session)

    def _climb(self, tick: int, row: Inputs | None) -> None:
        """Let the ladder choose the mode of this scan."""
        before = self.ladder.mode
        changed = self.ladder.step(
            tick,
            LadderInputs(
                operator=OperatorMode(self.operator.mode),
                cooling=self.cool_down.is_active,
                sensors_unusable=not self._usable,
                row=row is not None,
                late=self.player.late or not self.optimizer_present,
            ),
        )
        if not changed:
            return
        if self.ladder.mode is Mode.CLASSICAL:
            self.player.drop()
            if before is not Mode.CLASSICAL:
                self._loops.restart()
        elif before is Mode.CLASSICAL:
            self._failed_handshake, self._answer_failed = -math.inf, False
        self._held_from = None
        self._note_mode(tick)

    def _note_mode(self, tick: int) -> None:
        self.journal.note(tick, EventKind.MODE, self.ladder.mode, self.ladder.cause)

    def _wanted(self, tick: int, row: Inputs | None) -> Inputs:
        """Return the outputs requested in the mode of the ladder."""
        mode = self.ladder.mode
        if mode is Mode.MANUAL:
            return self.operator.u
        if mode is Mode.CLASSICAL and self.process is not None and not self._handing_over(tick):
            return self._of_the_loops(tick, self.process.y)
        return self.guard.applied if row is None else row

    def _of_the_loops(self, tick: int, y: Sequence[float]) -> Inputs:
        without = {*self.sensors.unusable, *self.cool_down.open_loops}
        wanted = self._loops.wanted(tick, y, self.guard.applied, without=without)
        return self.cool_down.wanted(wanted) if self.cool_down.is_active else wanted

    def _handing_over(self, tick: int) -> bool:
        """Return whether the loops are at rest, so that the first sequence begins at inputs the optimiser knows.

        A handshake fails when its update is abandoned, its sequence refused or missing, and in any case after
        a sampling period. The next begins with an update, not amid one: the loops may have moved the inputs since.
        """
        player, held_from = self.player, self._held_from
        if held_from is not None:
            over = (
                player.given_up
                or player.broken_promise
                or not 0 <= tick - held_from < self._limits.process.ticks_per_sample
            )
            if over:
                self._failed_handshake, self._held_from = tick, None
                self._answer_failed = self._answer_failed or self._held_for_answer
        if player.has_answer:  # it was judged from where the inputs are
            held = self._rested_by(tick) or not self._answer_failed
        elif player.update is None or player.broken_promise or self.operator.mode != OperatorMode.AUTO:
            held = False
        else:
            held = player.answering and (self._held_from is not None or self._rested_by(player.update.tick + 1))
        if held and self._held_from is None:
            self._held_from, self._held_for_answer = tick, False
        self._held_for_answer |= held and player.has_answer
        return held

    def _rested_by(self, tick: int) -> bool:
        """Return whether the loops have worked for long enough since a handshake failed."""
        return tick - self._failed_handshake > HANDSHAKE_PAUSE_TICKS

    def end_scan(self, measurement: Measurement) -> Update | None:
        """Take the measurement of this tick; return the update if it was latched here."""
        applied = self.guard.applied
        others = measurement.x, (measurement.load,)
        y = tuple(self.sensors.check(self.tick, measurement.y, applied, *others, standing=self.cool_down.standing))
        if self.cool_down.observe(self.tick, y):
            self.journal.note(self.tick, EventKind.COOL_DOWN, self.cool_down.step)
        self.process = ProcessNow(self.tick, measurement.load, applied, y)
        least, largest = self._limits.process.load.stored_span
        self._unknown = not (least <= measurement.load <= largest and _are_states(measurement.x))
        self._let_play(usable=self._usable)
        latched = None
        if self.player.latches(self.tick, measurement.load):
            latched = self.player.latch(
                Update(
                    session=self.session, update=0, tick=self.tick, playing=0, load=measurement.load,
                    u_before=tuple(self._before), u=applied,
                    y=tuple(math.nan if i in self.sensors.bad else value for i, value in enumerate(y)), x=measurement.x,
                )
            )  # fmt: skip
        self._process_alarms.watch(
            self.tick, y, self.ladder, cooling=self.cool_down.is_active, late=self.player.late,
            optimizer=self.optimizer_present, shortage=self.shortage, bad=self.sensors.bad, suspects=self.suspects,
        )  # fmt: skip
        self.tick += 1
        self._in_scan = False
        return latched

    def _let_play(self, *, usable: bool) -> None:
        """Invite the optimiser, or send it away: an operator drives, or MPC would work with what is not so."""
        invited = usable and self.operator.mode == OperatorMode.AUTO
        if invited and not self.player.invited:
            self.player.invite(self.tick)
        elif not invited and self.player.invited:
            self.player.dismiss()

    def interrupt(self) -> None:
        """Give up the scan under way: what the rack has done with its outputs is not known."""
        self._in_scan = False

    def rejoin(self, tick: int, applied: Sequence[float], passed: int | None = None) -> None:
        """Continue at another tick: the rack was away, or time has jumped.

        Forward, all timers count the time that has passed. Back by a little, they begin at the present tick at the
        latest; back by more than a sampling period, sequences are dropped too, and the optimiser is invited again.

        Args:
            tick: Tick of the next scan.
            applied: What the rack applies, read back from it.
            passed: Ticks since the last scan by our own clock; None in lock-step.
        """
        if tick < self.tick:
            self._set_back(tick)
        self.tick = self.alarms.now = tick
        self._in_scan = False
        self.guard.begin_at(self.tick, tuple(applied), passed)

    def _set_back(self, tick: int) -> None:
        if self.tick - tick > self._limits.process.ticks_per_sample:
            self.player.set_back(tick)
            self.alarms.pulse(AlarmKind.CLOCK_SKEW, LinkCause.TIME_JUMP)
        self.sensors.set_back(tick)
        self.ladder.set_back(tick)
        self.watchdog.set_back(tick)
        self._failed_handshake = min(self._failed_handshake, tick)
        self._held_from = None
        self.alarms.begin_at(tick)

    # -- the optimiser's side ------------------------------------------------------------------------------------------

    def optimizer_seen(self) -> None:
        """Note a sign of life of the optimiser."""
        self.optimizer_present = True
        self.watchdog.trigger(max(self.tick, self.alarms.now))

    def optimizer_lost(self) -> None:
        """Continue without the optimiser until its next heartbeat; the alarm is raised by the end of the next scan."""
        self.optimizer_present = False

    def heartbeat(self, beat: Heartbeat) -> None:
        """Take a heartbeat, which names the optimiser's model."""
        self.optimizer_seen()
        wrong = beat.model_digest != self._point.model_digest
        self.alarms.report(AlarmKind.MODEL_MISMATCH, condition=wrong)

    def accept_plan(self, plan: Plan) -> bool:
        """Take the updating period of the last update; return whether it was acceptable."""
        self.optimizer_seen()
        accepted = self.player.accept_plan(plan, self._earliest)
        if accepted:
            self.shortage, self.suspects = plan.shortage, plan.suspects
        return accepted

    def abandon(self) -> None:
        """Give up the update under way: an optimiser that has lost the thread asks for a new one."""
        self.player.abandon(self._earliest)

    def offer(self, sequence: InputSequence) -> Acknowledgement:
        """Check a committed sequence; accept it for its first tick, or reject it with a reason."""
        self.optimizer_seen()
        lost = self.alarms.now - self.tick > LOST_TICKS
        answer = self.player.offer(sequence, self._earliest, plant_lost=lost)
        accepted = answer.verdict == Verdict.ACCEPTED
        self.alarms.report(AlarmKind.SEQUENCE_REJECTED, condition=not accepted, cause=answer.verdict)
        if accepted or answer.verdict == Verdict.WRONG_MODEL:
            self.alarms.report(AlarmKind.MODEL_MISMATCH, condition=not accepted)
        return answer

    # -- the operator's side -------------------------------------------------------------------------------------------

    def track(self) -> bool:
        """Let the manual setpoints follow the applied inputs for a bumpless change; return whether they moved."""
        applied = self.guard.applied
        if self.operator.mode == OperatorMode.MANUAL or self.operator.u == applied:
            return False
        self.operator = Operator(self.operator.mode, applied)
        return True

    def operate(self, operator: Operator) -> None:
        """Set the operating mode from the next scan on."""
        self.operator = operator
        self._let_play(usable=self._usable)


def _are_states(x: Sequence[float]) -> bool:
    """Return whether these can be states; otherwise the update is invalid."""
    return math.isfinite(sum(x)) and min(x) >= -MAX_STATE and max(x) <= MAX_STATE


def make_program(header: ModelHeader, section: ControlSection, limits: InputLimits) -> ControlProgram:
    """Return the program that the configuration asks for, at the operating point of its model file."""
    point = OperatingPoint(header.u0, header.y0, header.short_digest)
    return ControlProgram(limits=limits, point=point, section=section)
