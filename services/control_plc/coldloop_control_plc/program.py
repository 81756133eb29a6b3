"""The control PLC's program: scan cycle, fail-safe ladder, alarms.

Pure: no sockets, no clock, no sleeping. A scan is `begin_scan` (decide the outputs), the exchange with the plant's
rack, `end_scan` (take the measurement, latch an update at an updating instant). Who decides the outputs is the
ladder's choice (`ladder.py`); what the optimiser sends goes through the sequence player (`player.py`); the guard has
the last word (`output_limits.py`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
from coldloop.registers.plant import Actuators, Measurement
from coldloop.registers.safety import Alarm, AlarmKind
from coldloop.safety.watchdog import Watchdog
from coldloop.safety.writers import Inputs, InputSequence
from coldloop.service.journal import Journal
from coldloop_control_plc.alarms import (
    OPTIMIZER_DRIVES,
    AlarmConditions,
    AlarmConstants,
    AlarmPanel,
    ProcessAlarms,
    ScanSummary,
    watch_bands,
)
from coldloop_control_plc.classical import ClassicalLoops
from coldloop_control_plc.cool_down import CoolDown
from coldloop_control_plc.ladder import Ladder, LadderInputs
from coldloop_control_plc.output_limits import GuardState, Limits, Numbers, OutputGuard
from coldloop_control_plc.player import PlayerState, SequencePlayer, awaits_sequence, begin_sequence, latches
from coldloop_control_plc.sensors import SensorConstants, SensorMonitor, SensorState, check
from coldloop_control_plc.settings import ControlSection, ControlStrategy

SEEN = 0.1
"""Share of its rate by which an input must have moved for the process to show it."""
HANDSHAKE_PAUSE_TICKS = 120
"""After a handshake that came to nothing the classical loops are not held again for so long."""
LOST_TICKS = 4
"""A rack that has been out of step for longer takes no new sequences: they would be played late."""


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """The model as the control PLC knows it: its inputs and outputs at rest, and its digest."""

    inputs: tuple[float, ...]
    outputs: tuple[float, ...]
    model_digest: int


class ScanConstants(NamedTuple):
    """Constants of a scan in one session."""

    limits: Limits
    sensors: SensorConstants
    alarms: AlarmConstants


class Scan(NamedTuple):
    """All that a scan changes while it tells nothing: each part is an object with lists here, a record in the rig."""

    guard: GuardState
    player: PlayerState
    sensors: SensorState
    alarms: AlarmConditions
    watchdog: Watchdog


def observe(
    c: ScanConstants, s: Scan, tick: int, y: Numbers, x: Numbers, load: float, applied: Numbers, cooling: bool  # noqa: FBT001
) -> bool:  # fmt: skip
    """Take the measurement of a tick; return whether it tells something beside the numbers in `s`.

    A sensor is bad or good again, load or state make no sense, or the alarm of a band is due.
    """
    told = check(c.sensors, s.sensors, tick, y, x, load, applied)
    due = watch_bands(c.alarms, s.alarms, tick, s.sensors.good, cooling)
    return told or due or s.sensors.is_unknown


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
        self._process_alarms = ProcessAlarms(self.alarms, self.journal, len(self._point.outputs))
        self.alarms.begin_at(tick)
        self._begin_step()
        self.scan = Scan(self.guard.state, self.player, self.sensors, self.alarms, self.watchdog)
        self.scan_constants = ScanConstants(self.guard.limits, self.sensors.constants, self.alarms.constants)

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
        return self.optimizer_present and awaits_sequence(self.player, self.tick)

    @property
    def _usable(self) -> bool:
        """MPC can work with what is measured: it continues without an output of a band, and does not begin without one.

        Nor does it begin before the plant is cold.
        """
        missing = self.sensors.unestimated if self.ladder.mode in OPTIMIZER_DRIVES else self.sensors.unusable
        return not (self.cool_down.is_active or self.sensors.is_unknown or missing)

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
        began = begin_sequence(self.player, tick)
        if self.player.broken_promise and self.ladder.mode is not Mode.CLASSICAL:
            self._failed_handshake = tick
        row = self.player.row(tick)
        self._climb(tick, row)
        applied = self.guard.admit(tick, self._wanted(tick, row), update=began)
        return Actuators(tick, applied, self.session)

    def _climb(self, tick: int, row: Inputs | None) -> None:
        """Let the ladder choose the mode of this scan."""
        before = self.ladder.mode
        inputs = LadderInputs(
            self.operator.mode, self.cool_down.is_active, not self._usable, row is not None,
            self.player.late or not self.optimizer_present,
        )  # fmt: skip
        if not self.ladder.step(tick, inputs):
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
        y, x, load = measurement.y, measurement.x, measurement.load
        observe(self.scan_constants, self.scan, self.tick, y, x, load, self.guard.applied, self.cool_down.is_active)
        return self.conclude(measurement)

    def conclude(self, measurement: Measurement) -> Update | None:
        """Do what follows when the measurement of this tick has been observed; return the update if one is latched."""
        tick, applied, sensors, load = self.tick, self.guard.applied, self.sensors, measurement.load
        y = tuple(sensors.good) if sensors.bad_count else measurement.y
        if self.cool_down.observe(tick, y):
            self.journal.note(tick, EventKind.COOL_DOWN, self.cool_down.step)
            self._begin_step()
            watch_bands(self.alarms.constants, self.alarms, tick, y, self.cool_down.is_active)
        self.process = ProcessNow(tick, load, applied, y)
        self._let_play(usable=self._usable)
        latched = None
        if latches(self.player, tick, load):
            if bad := sensors.bad:
                y = tuple(math.nan if i in bad else value for i, value in enumerate(y))
            latched = self.player.latch(
                Update(self.session, 0, tick, 0, load, tuple(self._before), applied, y, measurement.x)
            )
        self._process_alarms.watch(tick, self._summary, self.player.shortage)
        self.tick += 1
        self._in_scan = False
        return latched

    def _begin_step(self) -> None:
        """Begin a step of the cool-down, or none."""
        standing = self.cool_down.standing
        self.sensors.standing[:] = [output in standing for output in range(len(self._point.outputs))]

    @property
    def _summary(self) -> ScanSummary:
        ladder, player = self.ladder, self.player
        return ScanSummary(
            ladder.mode, ladder.cause, player.late, self.optimizer_present, player.shortage > 0.0,
            player.shortage < 0.0, self.bad_sensors, player.suspects,
        )  # fmt: skip

    # -- scans that are done with `scan` alone -------------------------------------------------------------------------

    @property
    def is_ordinary(self) -> bool:
        """Whether the scans to come do nothing beside `scan`, for as long as rows are played in time.

        They are done then by `begin_sequence`, `admit`, `observe` and, unless that tells something, `latches`.
        """
        alarms, answers = self.alarms, (AlarmKind.SEQUENCE_REJECTED, AlarmKind.MODEL_MISMATCH)
        return (
            self.ladder.mode is Mode.MPC
            and self.operator.mode == OperatorMode.AUTO
            and not (self.sensors.bad_count or self.sensors.is_unknown)
            and self._process_alarms.reported == self._summary
            and self.optimizer_present
            and alarms.next_report > self.tick
            and not any(alarms.active[kind] for kind in answers)
        )

    def take_over(self, measurement: Measurement, before: Inputs, *, concluded: bool) -> Update | None:
        """Continue after such scans, with the measurement of the last one, which may be still to be concluded.

        `before` was applied before that scan. Returns the update if it was latched in the conclusion.
        """
        self.tick = self.alarms.now = measurement.tick
        self.guard.applied, self._before = measurement.u, before
        if not concluded:
            return self.conclude(measurement)
        self.process = ProcessNow(self.tick, measurement.load, measurement.u, measurement.y)
        self.tick += 1
        return None

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
        return self.player.accept_plan(plan, self._earliest)

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


def make_program(header: ModelHeader, section: ControlSection, limits: InputLimits) -> ControlProgram:
    """Return the program that the configuration asks for, at the operating point of its model file."""
    point = OperatingPoint(header.u0, header.y0, header.short_digest)
    return ControlProgram(limits=limits, point=point, section=section)
