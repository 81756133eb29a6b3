"""The control PLC's program: scan cycle, fail-safe ladder, alarms.

Pure: no sockets, no clock, no sleeping. A scan is `begin_scan` (decide the outputs), the exchange with the plant's
rack, `end_scan` (take the measurement, latch an update at an updating instant). Who decides the outputs is the
ladder's choice (`scan.py`); what the optimiser sends goes through the sequence player (`player.py`); the guard has
the last word (`output_limits.py`).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from coldloop.errors import ConfigurationError
from coldloop.process.model_file import ModelHeader
from coldloop.process.settings import InputLimits
from coldloop.registers import control_plc as registers
from coldloop.registers import plant
from coldloop.registers.common import Alarm, AlarmKind, CapacityCause, EventKind
from coldloop.registers.control_plc import Cause, CoolDownStep, Mode, Operator, OperatorMode, ProcessNow, Update
from coldloop.safety.watchdog import Watchdog
from coldloop.safety.writers import Inputs, InputSequence
from coldloop.service.journal import Journal
from coldloop_control_plc import output_limits, scan
from coldloop_control_plc.alarms import NOT, AlarmPanel
from coldloop_control_plc.player import SequencePlayer, awaits_sequence, latches
from coldloop_control_plc.sensors import NONE, SensorMonitor
from coldloop_control_plc.settings import ControlSection, ControlStrategy

SEEN = 0.1
"""Share of its rate by which an input must have moved for the process to show it."""
LOST_TICKS = 4
"""A rack that has been out of step for longer takes no new sequences: they would be played late."""

SENSORS = {AlarmKind.SENSOR_BAD: 1, AlarmKind.SENSOR_SUSPECT: 2}
"""Alarms of sensors, and the cause of their events."""


class OperatingPoint(NamedTuple):
    """The model as the control PLC knows it: its inputs and outputs at rest, and its digest."""

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
        self.model_digest = point.model_digest
        self._section = section
        self.alarm_settings = section.alarms
        self._initial = tuple(point.inputs)
        if output_limits.OutputGuard(limits, self._initial).out_of_range([self._initial]):
            raise ConfigurationError(
                f"limits: the inputs {self._initial} of the operating point are outside; widen low and high, or "
                "give another model.file"
            )
        self.watchdog = Watchdog(section.ladder.optimizer_ticks)
        self.journal = journal or Journal()
        self.alarms = AlarmPanel(self.journal, section.alarms)
        self.restart(session=0)

    def restart(self, session: int) -> None:
        """Begin a session at tick 0 with the initial inputs applied."""
        self.reset_operating_mode()
        mode = Mode.CLASSICAL if self._section.driver is ControlStrategy.CLASSICAL else Mode.HOLD
        self._begin(session, 0, self._initial, mode, Cause.SESSION_STARTED, updates=0)

    def reset_operating_mode(self) -> None:
        """Let those drive whom the configuration names: no operator has said anything."""
        self.operator = self.configured_operator

    @property
    def configured_operator(self) -> Operator:
        """Operating mode in which the configured controller drives, with the initial inputs."""
        classical = self._section.driver is ControlStrategy.CLASSICAL
        return Operator(OperatorMode.CLASSICAL if classical else OperatorMode.AUTO, self._initial)

    def recall(self, operator: Operator, alarms: Sequence[Alarm], watchdog: int, tick: int) -> None:
        """Take over what operators had said before a restart, and the alarms; the session is resumed later.

        `watchdog` is the time-out of the optimiser's watchdog, in ticks; `tick` the last one.
        """
        self.operator = operator
        self.watchdog.set(watchdog, tick)
        self.alarms.now = tick
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
        """Resume a session after a restart, at the tick and the applied outputs of the rack.

        `updates` is the number of the next update, `operator` what operators have said, `cool_down` its step then. The
        rest of what was being `playing` is played on, if what the rack applies is of it: a state that was retained some
        ticks before the end may hold the sequence before.
        """
        self.operator = operator
        self._begin(session, tick, tuple(applied), Mode.HOLD, Cause.RESTARTED, updates=updates, cool_down=cool_down)
        ours = playing is not None and tuple(applied) in playing.rows[: max(0, tick - playing.header.first_tick)]
        self.player.resume(playing if ours else None, tick)

    def _begin(
        self, session: int, tick: int, applied: Inputs, mode: Mode, cause: Cause, *,
        updates: int, cool_down: CoolDownStep = CoolDownStep.FINISHED,
    ) -> None:  # fmt: skip
        self.session, self.tick = session, tick
        self.process: ProcessNow | None = None
        limits, point, section = self._limits, self._point, self._section
        self.guard = output_limits.OutputGuard(limits, self._initial)
        if applied != self._initial:
            self.guard.begin_at(tick, applied)
        self._before = self.guard.applied
        self.player = SequencePlayer(self.guard, self.model_digest, updates=updates)
        self.sensors = SensorMonitor(section.sensors, point.outputs, [SEEN * rate for rate in limits.rate])
        self.ladder = scan.LadderState(
            mode, cause, tick, list(applied), list(applied), [math.nan for _ in point.outputs], cool_down,
            has_begun=limits.process.bath is None or cool_down is not CoolDownStep.FINISHED,
        )  # fmt: skip
        self._in_scan = False
        self._noted: tuple[int, int] = mode, cause
        self._noted_step = self.ladder.step
        self.watchdog.set(self.watchdog.time, tick)
        self._reported: tuple[int, ...] | None = None
        """Conditions of the last scan whose alarms were reported."""
        self._sensors_before: dict[AlarmKind, frozenset[int]] = dict.fromkeys(SENSORS, frozenset())
        self.alarms.now = tick
        self.scan = scan.Scan(self.guard.state, self.ladder, self.player, self.sensors, self.alarms, self.watchdog)
        self.scan_constants = scan.ScanConstants(
            self.guard.limits, self.sensors.constants, self.alarms.constants, section.ladder.hold_ticks,
            scan.loop_constants(section.classical, limits, point.outputs),
            scan.cool_down_constants(section.cool_down, limits, point.inputs, point.outputs),
        )  # fmt: skip
        scan.note_standing(self.scan_constants, self.scan)
        if session:
            self.journal.note(tick, EventKind.MODE, mode, cause)

    # -- what others see -----------------------------------------------------------------------------------------------

    @property
    def mode(self) -> Mode:
        """Who decides the outputs."""
        return Mode(self.ladder.mode)

    @property
    def cool_down(self) -> CoolDownStep:
        """Step of the cool-down."""
        return CoolDownStep(self.ladder.step)

    @property
    def optimizer_present(self) -> bool:
        """The optimiser gives signs of life."""
        return self.ladder.optimizer_present

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
    def _earliest(self) -> int:
        return self.tick + self._in_scan

    # -- scan ----------------------------------------------------------------------------------------------------------

    def begin_scan(self) -> plant.Actuators:
        """Decide the outputs of this tick."""
        tick = self.alarms.now = self.tick
        self._in_scan = True
        self._before = self.guard.applied
        self.ladder.operator, self.ladder.setpoints[:] = self.operator
        scan.decide(self.scan_constants, self.scan, tick, self.player.rows)
        self._note_mode()
        return plant.Actuators(tick, self.guard.applied, self.session)

    def _note_mode(self) -> None:
        if self._noted != (self.ladder.mode, self.ladder.cause):
            self._noted = self.ladder.mode, self.ladder.cause
            self.journal.note(self.tick, EventKind.MODE, *self._noted)

    def end_scan(self, measurement: plant.Measurement) -> Update | None:
        """Take the measurement of this tick; return the update if it was latched here."""
        scan.observe(self.scan_constants, self.scan, self.tick, measurement.y, measurement.x, measurement.load)
        return self.conclude(measurement)

    def conclude(self, measurement: plant.Measurement) -> Update | None:
        """Do what follows when the measurement of this tick has been observed; return the update if one is latched."""
        tick, applied, sensors, load = self.tick, self.guard.applied, self.sensors, measurement.load
        y = tuple(sensors.good) if sensors.bad_count else measurement.y
        if self.ladder.step != self._noted_step:
            self._noted_step = self.ladder.step
            self.journal.note(tick, EventKind.COOL_DOWN, self._noted_step)
        self.process = ProcessNow(tick, load, applied, y)
        self._let_play()
        latched = None
        if latches(self.player, tick, load):
            if bad := sensors.bad:
                y = tuple(math.nan if i in bad else value for i, value in enumerate(y))
            latched = self.player.latch(
                Update(self.session, 0, tick, 0, load, tuple(self._before), applied, y, measurement.x)
            )
        self._report_alarms()
        self.tick += 1
        self._in_scan = False
        return latched

    @property
    def _conditions(self) -> tuple[int, ...]:
        """Conditions of a scan that its alarms depend on, beside those of bands."""
        ladder, player = self.ladder, self.player
        short = player.shortage > 0.0, player.shortage < 0.0
        return ladder.mode, ladder.cause, player.late, self.optimizer_present, *short, self.bad_sensors, player.suspects

    def _report_alarms(self) -> None:
        """Report the conditions of the alarms that depend on the process and on the ladder, at the end of a scan."""
        alarms, conditions = self.alarms, self._conditions
        for kind in alarms.constants.bands:
            if alarms.since[kind] != NOT:
                alarms.settle(kind)
        if conditions == self._reported and not alarms.reports:
            return
        self._reported, report = conditions, alarms.report
        player, mode, cause, outputs = self.player, self.ladder.mode, self.ladder.cause, len(self._point.outputs)
        fallen = mode != Mode.MPC and cause not in (Cause.SESSION_STARTED, Cause.OPERATOR, Cause.COOL_DOWN)
        report(AlarmKind.MODE, condition=fallen, cause=cause)
        exhausted = mode != Mode.MPC and cause in (Cause.SEQUENCE_EXHAUSTED, Cause.HOLD_EXPIRED)
        report(AlarmKind.SEQUENCE_EXHAUSTED, condition=exhausted)
        report(AlarmKind.SEQUENCE_LATE, condition=player.late)
        report(AlarmKind.OPTIMIZER_LOST, condition=not self.optimizer_present)
        short = CapacityCause.of(player.shortage if mode == Mode.MPC else 0.0)
        report(AlarmKind.CAPACITY, condition=bool(short), cause=short, value=abs(player.shortage))
        suspects = player.suspects if mode in (Mode.MPC, Mode.REST) else 0  # the optimiser's sequences are played
        self._report_sensors(AlarmKind.SENSOR_BAD, self.bad_sensors)
        self._report_sensors(AlarmKind.SENSOR_SUSPECT, suspects & ~(-1 << outputs))
        idle = suspects >> outputs
        first = (idle & -idle).bit_length() - 1
        report(AlarmKind.INPUT_WITHOUT_EFFECT, condition=bool(idle), cause=max(0, first))

    def _report_sensors(self, kind: AlarmKind, bits: int) -> None:
        """Note each sensor that became bad, suspect or good, and raise the alarm; its cause is the newest one."""
        found = frozenset(output for output in range(len(self._point.outputs)) if bits >> output & 1)
        before, self._sensors_before[kind] = self._sensors_before[kind], found
        for output in sorted(found ^ before):
            self.journal.note(self.tick, EventKind.SENSOR, output, SENSORS[kind] if output in found else 0)
        for output in sorted(found - before):
            self.alarms.raised(kind, output)
        if not found:
            self.alarms.returned(kind)

    @property
    def is_ordinary(self) -> bool:
        """Whether the scans to come do nothing beside `scan`, for as long as `decide` and `observe` tell nothing."""
        alarms, answers = self.alarms, (AlarmKind.SEQUENCE_REJECTED, AlarmKind.MODEL_MISMATCH)
        return (
            self.ladder.mode == Mode.MPC
            and self.operator.mode == OperatorMode.AUTO
            and not (self.sensors.bad_count or self.sensors.is_unknown)
            and self._reported == self._conditions
            and self.optimizer_present
            and self.player.invited
            and alarms.next_report > self.tick
            and not any(alarms.active[kind] for kind in answers)
        )

    def take_over(self, measurement: plant.Measurement, before: Inputs, *, concluded: bool) -> Update | None:
        """Continue after such scans, with the measurement of the last one, which may be still to be concluded.

        `before` was applied before that scan. Returns the update if it was latched in the conclusion.
        """
        self.tick = self.alarms.now = measurement.tick
        self._before = before
        if not concluded:
            self._note_mode()
            return self.conclude(measurement)
        self.process = ProcessNow(self.tick, measurement.load, measurement.u, measurement.y)
        self.tick += 1
        return None

    def _let_play(self) -> None:
        """Invite the optimiser, or send it away: an operator drives, or MPC cannot work with what is measured."""
        invited = self.operator.mode == OperatorMode.AUTO and scan.is_usable(self.scan_constants, self.scan)
        if invited and not self.player.invited:
            self.player.invite(self.tick)
        elif not invited and self.player.invited:
            self.player.dismiss()

    def interrupt(self) -> None:
        """Give up the scan under way: what the rack has done with its outputs is not known."""
        self._in_scan = False

    def rejoin(self, tick: int, applied: Sequence[float], passed: int | None = None) -> None:
        """Continue at another tick, that of the next scan: the rack was away, or time has jumped.

        Forward, all timers count the time that has passed. Back by a little, they begin at the present tick at the
        latest; back by more than a sampling period, sequences are dropped too, and the optimiser is invited again.
        `applied` is read back from the rack; `passed` are the ticks since the last scan by our own clock, None in
        lock-step.
        """
        if tick < self.tick:
            if self.tick - tick > self._limits.process.ticks_per_sample:
                self.player.set_back(tick)
                self.alarms.pulse(AlarmKind.CLOCK_SKEW, registers.LinkCause.TIME_JUMP)
            self.sensors.set_back(tick)
            self.watchdog.set_back(tick)
            ladder = self.ladder
            ladder.since = min(ladder.since, tick)
            ladder.handshake_failed, ladder.held_from = min(ladder.handshake_failed, tick), NONE
        self.tick = self.alarms.now = tick
        self._in_scan = False
        self.guard.begin_at(self.tick, tuple(applied), passed)

    # -- the optimiser's side ------------------------------------------------------------------------------------------

    def optimizer_seen(self) -> None:
        """Note a sign of life of the optimiser."""
        self.ladder.optimizer_present = True
        self.watchdog.trigger(max(self.tick, self.alarms.now))

    def optimizer_lost(self) -> None:
        """Continue without the optimiser until its next heartbeat; the alarm is raised by the end of the next scan."""
        self.ladder.optimizer_present = False

    def heartbeat(self, beat: registers.Heartbeat) -> None:
        """Take a heartbeat, which names the optimiser's model."""
        self.optimizer_seen()
        wrong = beat.model_digest != self.model_digest
        self.alarms.report(AlarmKind.MODEL_MISMATCH, condition=wrong)

    def accept_plan(self, plan: registers.Plan) -> bool:
        """Take the updating period of the last update; return whether it was acceptable."""
        self.optimizer_seen()
        return self.player.accept_plan(plan, self._earliest)

    def abandon(self) -> None:
        """Give up the update under way: an optimiser that has lost the thread asks for a new one."""
        self.player.abandon(self._earliest)

    def offer(self, sequence: InputSequence) -> registers.Acknowledgement:
        """Check a committed sequence; accept it for its first tick, or reject it with a reason."""
        self.optimizer_seen()
        lost = self.alarms.now - self.tick > LOST_TICKS
        answer = self.player.offer(sequence, self._earliest, plant_lost=lost)
        accepted = answer.verdict == registers.Verdict.ACCEPTED
        self.alarms.report(AlarmKind.SEQUENCE_REJECTED, condition=not accepted, cause=answer.verdict)
        if accepted or answer.verdict == registers.Verdict.WRONG_MODEL:
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
        self._let_play()


def make_program(header: ModelHeader, section: ControlSection, limits: InputLimits) -> ControlProgram:
    """Return the program that the configuration asks for, at the operating point of its model file."""
    point = OperatingPoint(header.u0, header.y0, header.short_digest)
    return ControlProgram(limits=limits, point=point, section=section)
