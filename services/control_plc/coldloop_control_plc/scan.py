"""A scan as two functions of one record: `decide` the outputs when a tick begins, `observe` what is measured in it.

Both are plain Python, for the control PLC has no numba; the rig compiles these very functions. Who decides the outputs
is chosen by the fail-safe ladder, from MPC by REST and HOLD down to CLASSICAL, until a sequence is accepted again
(`registers.control_plc.Mode`). An operator may take the ladder away (CLASSICAL, MANUAL). A bad sensor that MPC needs,
and a plant that begins warm, lead to CLASSICAL at once. The cool-down of a warm plant with a bath is a sequence of
steps (`CoolDownStep`): TURBINE ends when the turbine's outlet is at its set point, BATH when there is liquid, FILLING
when the level is in its band, SETTLING when level and outlet have stayed in their bands for a while. The level of the
cold box is L1, the turbine's outlet T5. How far the turbine may open is its governor's decision.
"""

import math
from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Cause, CoolDownStep, Mode, OperatorMode
from coldloop.safety.watchdog import Watchdog, expire
from coldloop_control_plc import player
from coldloop_control_plc.alarms import AlarmConditions, AlarmConstants, watch_bands
from coldloop_control_plc.output_limits import NEVER, GuardState, Limits, Numbers, Rows, admit_now
from coldloop_control_plc.player import PlayerState, begin_sequence, has_row
from coldloop_control_plc.sensors import NONE, SensorConstants, SensorState, check, is_missing, lacks_output
from coldloop_control_plc.settings import ClassicalSettings, CoolDownSettings

HOLD, MPC, CLASSICAL, REST, MANUAL = map(int, Mode)
FINISHED, TURBINE, BATH, FILLING, SETTLING = map(int, CoolDownStep)
AUTO, _, MANUALLY = map(int, OperatorMode)
BY_OPERATOR: Final = int(Cause.OPERATOR)
HOLD_EXPIRED: Final = int(Cause.HOLD_EXPIRED)
COOLS_DOWN: Final = int(Cause.COOL_DOWN)
SENSOR_BAD: Final = int(Cause.SENSOR_BAD)
SEQUENCE_BEGAN: Final = int(Cause.SEQUENCE_BEGAN)
SEQUENCE_LATE: Final = int(Cause.SEQUENCE_LATE)
EXHAUSTED: Final = int(Cause.SEQUENCE_EXHAUSTED)
HANDSHAKE_PAUSE_TICKS: Final = 120
"""After a handshake that came to nothing the classical loops are not held again for so long."""
LONGEST_GAP: Final = 3
"""Periods; of a longer gap between two executions of the loops no more counts for the integral."""


class LoopConstants(NamedTuple):
    """The PI loops; sequences have one element per loop."""

    outputs: Sequence[int]
    actuators: Sequence[int]
    gains: Numbers
    integral_times_s: Numbers
    setpoints: Numbers
    reaches: Numbers
    """Largest change of the input in one execution, up or down."""
    period_ticks: int
    period_s: float
    tick_s: float


class CoolDownConstants(NamedTuple):
    """The cool-down: places of the signals of a bath, and where its steps end."""

    level: int
    temperature: int
    outlet: int
    """The turbine's."""
    feed: int
    heater: int
    valve: int
    """Before the turbine."""
    low: Numbers
    """Lower edges of the bands of level and outlet."""
    high: Numbers
    cold: float
    """Temperature of the turbine's outlet at the operating point."""
    rest: Numbers
    """Inputs at the operating point."""
    warm: float
    liquid: float
    settled_s: float
    tick_s: float


class ScanConstants(NamedTuple):
    """Constants of a scan in one session."""

    limits: Limits
    sensors: SensorConstants
    alarms: AlarmConstants
    hold_ticks: int
    loops: LoopConstants
    cooling: CoolDownConstants


@dataclass(slots=True)
class LadderState:
    """Who decides the outputs, and what decides that; ticks are `NONE` where the event has not occurred."""

    mode: int
    cause: int
    since: int
    """Tick at which the mode began."""
    setpoints: list[float]
    """The operator's, shape (inputs,)."""
    wanted: MutableSequence[float]
    """Room for the outputs that the mode asks for, shape (inputs,)."""
    errors: list[float]
    """Last error of the loop of each output; NaN where there is none."""
    step: int
    """Step of the cool-down."""
    has_begun: bool
    """The cool-down has; the first measurement decides that."""
    settled_since: int = NONE
    operator: int = AUTO
    optimizer_present: bool = True
    is_measured: bool = False
    """A measurement has been taken."""
    handshake_failed: int = NEVER
    held_from: int = NONE
    """Since when the loops have been held for the sequence to come."""
    held_for_answer: bool = False
    """It had been accepted."""
    answer_failed: bool = False
    """A handshake came to nothing with a sequence that had been accepted."""
    seen: int = NONE
    """Tick at which the loops were asked last."""
    executed: int = NONE


class Scan(NamedTuple):
    """All that a scan changes while it tells nothing: each part is an object with lists here, a record in the rig."""

    guard: GuardState
    ladder: LadderState
    player: PlayerState
    sensors: SensorState
    alarms: AlarmConditions
    watchdog: Watchdog


def decide(c: ScanConstants, s: Scan, tick: int, rows: Sequence[Rows]) -> bool:
    """Decide the outputs of a tick; return whether something beside them has changed that is told.

    They are `s.guard.applied` then. `rows` are those of the player's two sequences. Mode or cause have changed, the
    optimiser is lost, or its sequence is late.
    """
    d, p = s.ladder, s.player
    was_late, was_present = p.late, d.optimizer_present
    if expire(s.watchdog, tick):
        d.optimizer_present = False
    begins = begin_sequence(p, tick)
    if p.broken_promise and d.mode != CLASSICAL:
        d.handshake_failed = tick
    plays = has_row(p, tick)
    changed = step_ladder(c, s, tick, plays)
    if d.mode == MANUAL:
        want(d, d.setpoints)
    elif d.mode == CLASSICAL and d.is_measured and not is_held(c, s, tick):
        want(d, s.guard.applied)
        move_loops(c, s, tick)
        if d.step != FINISHED:
            cool(c, d)
    elif plays:
        want(d, rows[p.slot][tick - p.first_ticks[p.slot]])
    else:
        want(d, s.guard.applied)
    admit_now(s.guard, c.limits, tick, d.wanted, begins)
    return changed or p.late != was_late or d.optimizer_present != was_present


def observe(c: ScanConstants, s: Scan, tick: int, y: Numbers, x: Numbers, load: float) -> bool:
    """Take the measurement of a tick; return whether it tells something beside the numbers in `s`.

    A sensor is bad or good again, load or state make no sense, a step of the cool-down has ended, or the alarm of a
    band is due.
    """
    told = check(c.sensors, s.sensors, tick, y, x, load, s.guard.applied)
    s.ladder.is_measured = True
    ended = follow_cool_down(c, s, tick)
    due = watch_bands(c.alarms, s.alarms, tick, s.sensors.good, s.ladder.step != FINISHED)
    return told or ended or due or s.sensors.is_unknown


# -- the ladder --------------------------------------------------------------------------------------------------------


def is_usable(c: ScanConstants, s: Scan) -> bool:
    """Return whether MPC can work with what is measured, of a plant that is cold.

    It continues without an output of a band, and does not begin without one.
    """
    if s.ladder.step != FINISHED or s.sensors.is_unknown:
        return False
    if s.ladder.mode in (MPC, REST) and s.sensors.bad_count <= c.sensors.estimated_most:
        return not lacks_output(c.sensors, s.sensors, c.sensors.estimated_ticks)
    return not lacks_output(c.sensors, s.sensors, c.sensors.bridged_ticks)


def step_ladder(c: ScanConstants, s: Scan, tick: int, plays: bool) -> bool:  # noqa: FBT001 compiled
    """Choose the mode of a scan; return whether it, or its cause, has changed."""
    d, p = s.ladder, s.player
    mode, cause = choose(c, s, tick, plays)
    if mode == d.mode and (cause == d.cause or mode == MPC):
        return False
    if mode == CLASSICAL:
        p.lengths[p.slot] = 0  # what has been played to its end: the loops move the inputs now
        if d.mode != CLASSICAL:  # what was measured is forgotten: the loops take over from whatever is applied next
            d.seen = d.executed = NONE
            for output in range(len(d.errors)):
                d.errors[output] = math.nan
    elif d.mode == CLASSICAL:
        d.handshake_failed, d.answer_failed = NEVER, False
    d.held_from = NONE
    d.mode, d.cause, d.since = mode, cause, tick
    return True


def choose(c: ScanConstants, s: Scan, tick: int, plays: bool) -> tuple[int, int]:  # noqa: FBT001 compiled
    """Return the mode of a scan, and its cause."""
    d = s.ladder
    if d.operator != AUTO:
        return MANUAL if d.operator == MANUALLY else CLASSICAL, BY_OPERATOR
    if not is_usable(c, s):
        return CLASSICAL, SENSOR_BAD if d.step == FINISHED else COOLS_DOWN
    if plays:
        rest = s.player.late or not d.optimizer_present
        return (REST, SEQUENCE_LATE) if rest else (MPC, SEQUENCE_BEGAN)
    if d.mode == CLASSICAL:
        return d.mode, HOLD_EXPIRED if d.cause == BY_OPERATOR else d.cause
    if d.mode == HOLD:
        return (CLASSICAL, HOLD_EXPIRED) if tick - d.since >= c.hold_ticks else (d.mode, d.cause)
    return HOLD, BY_OPERATOR if d.mode == MANUAL else EXHAUSTED


def is_held(c: ScanConstants, s: Scan, tick: int) -> bool:
    """Return whether the loops are at rest, so that the first sequence begins at inputs the optimiser knows.

    A handshake fails when its update is abandoned, its sequence refused or missing, and in any case after
    a sampling period. The next begins with an update, not amid one: the loops may have moved the inputs since.
    """
    d, p = s.ladder, s.player
    if d.held_from != NONE:
        given_up = p.phase in (player.NONE, player.REFUSED, player.ABANDONED)
        if given_up or p.broken_promise or not 0 <= tick - d.held_from < c.limits.ticks_per_sample:
            d.handshake_failed, d.held_from = tick, NONE
            d.answer_failed = d.answer_failed or d.held_for_answer
    if p.has_answer:  # it was judged from where the inputs are
        held = have_worked(d, tick) or not d.answer_failed
    elif not p.has_update or p.broken_promise or d.operator != AUTO:
        held = False
    else:
        expected = p.phase in (player.PLANNED, player.ANSWERED)
        held = expected and (d.held_from != NONE or have_worked(d, p.update_tick + 1))
    if held and d.held_from == NONE:
        d.held_from, d.held_for_answer = tick, False
    d.held_for_answer = d.held_for_answer or (held and p.has_answer)
    return held


def have_worked(d: LadderState, tick: int) -> bool:
    """Return whether the loops have worked for long enough since a handshake failed."""
    return tick - d.handshake_failed > HANDSHAKE_PAUSE_TICKS


def want(d: LadderState, row: Numbers) -> None:
    """Ask for a row of outputs."""
    for i in range(len(d.wanted)):
        d.wanted[i] = row[i]


# -- the classical loops -----------------------------------------------------------------------------------------------


def move_loops(c: ScanConstants, s: Scan, tick: int) -> None:
    """Write the inputs that the loops ask for at `tick`; the others stay, and those of loops that are open or blind.

    Between executions none changes. Executions are at multiples of the period, so that with 5 s and no sequence before
    each of them has its own rate window and may use it in full. Where the scan at such a tick was missed the next one
    executes, with the time that has passed.
    """
    loops, d, executed = c.loops, s.ladder, s.ladder.executed
    seen, d.seen = d.seen, tick
    if executed != NONE and tick <= executed:  # this scan was begun before, or time has gone back
        d.executed = min(executed, tick)
        return
    period = loops.period_ticks
    if tick % period != 0 and (seen == NONE or tick // period <= seen // period):
        return
    elapsed_s = loops.period_s
    if executed != NONE:
        elapsed_s = min(tick - executed, LONGEST_GAP * loops.period_ticks) * loops.tick_s
    d.executed = tick
    for loop in range(len(loops.outputs)):
        output, actuator = loops.outputs[loop], loops.actuators[loop]
        measured = s.sensors.good[output]
        if is_open(c.cooling, d.step, output) or is_missing(s.sensors, output, c.sensors.bridged_ticks):
            measured = math.nan
        d.wanted[actuator] = execute(c, d, loop, measured, s.guard.applied[actuator], elapsed_s)


def execute(c: ScanConstants, d: LadderState, loop: int, measured: float, applied: float, elapsed_s: float) -> float:
    """Return the input that a loop asks for by its output; NaN leaves it as it is applied.

    It computes what to add to the input that is really applied: du = K (e_k - e_{k-1} + T/T_i e_k). This is the PI
    whose integral is reset before each execution such that its last output is the applied input (tracking with the
    shortest time constant; Astrom and Murray, Feedback Systems, section on anti-windup). So nothing winds up,
    whatever limits the input, and a start from any input is bumpless.
    """
    loops = c.loops
    output, actuator, reach = loops.outputs[loop], loops.actuators[loop], loops.reaches[loop]
    error = loops.setpoints[loop] - measured
    before = error if math.isnan(d.errors[output]) else d.errors[output]
    change = loops.gains[loop] * (error - before + elapsed_s / loops.integral_times_s[loop] * error)
    if not (math.isfinite(measured) and math.isfinite(change)):  # no number, or beyond all numbers
        d.errors[output] = math.nan
        return applied
    d.errors[output] = error
    low, high = c.limits.low[actuator], c.limits.high[actuator]
    return min(max(applied + change, applied - reach, low), applied + reach, high)


def loop_constants(settings: ClassicalSettings, limits: InputLimits, outputs: Sequence[float]) -> LoopConstants:
    """Return the loops of a tuning; setpoints count from the outputs at the operating point."""
    process = settings.process
    places = [(process.output_names.index(y), process.input_names.index(u), pi) for y, u, pi in settings.pairs]
    return LoopConstants(
        [output for output, _, _ in places], [actuator for _, actuator, _ in places],
        [pi.gain for _, _, pi in places], [pi.integral_time_s for _, _, pi in places],
        [outputs[output] + pi.setpoint_offset for output, _, pi in places],
        [limits.rate[actuator] * settings.period_s / process.sampling_period_s for _, actuator, _ in places],
        settings.period_ticks, settings.period_s, process.tick_s,
    )  # fmt: skip


# -- the cool-down -----------------------------------------------------------------------------------------------------


def is_open(c: CoolDownConstants, step: int, output: int) -> bool:
    """Return whether the loop of an output is open in a step of the cool-down."""
    return (output == c.level and step in (TURBINE, BATH, FILLING)) or (output == c.outlet and step == TURBINE)


def cool(c: ScanConstants, d: LadderState) -> None:
    """Write the inputs of the cool-down over those of the closed loops; the output guard moves towards them."""
    limits, signals = c.limits, c.cooling
    opened = d.step in (TURBINE, BATH)
    d.wanted[signals.feed] = limits.high[signals.feed] if opened else signals.rest[signals.feed]
    if is_open(signals, d.step, signals.level):
        d.wanted[signals.heater] = limits.low[signals.heater]
    if is_open(signals, d.step, signals.outlet):
        d.wanted[signals.valve] = signals.rest[signals.valve]


def follow_cool_down(c: ScanConstants, s: Scan, tick: int) -> bool:
    """Take the outputs measured at a tick, bad ones substituted; return whether the step has changed."""
    d, before = s.ladder, s.ladder.step
    d.step = next_step(c.cooling, d, tick, s.sensors.good)
    d.has_begun = True
    if d.step != before:
        note_standing(c, s)
    return d.step != before


def note_standing(c: ScanConstants, s: Scan) -> None:
    """Note which outputs may be constant for long without being frozen: all without a band once the bath fills."""
    filling = s.ladder.step in (FILLING, SETTLING)
    for output in range(len(s.sensors.standing)):
        s.sensors.standing[output] = s.ladder.step != FINISHED and not (filling and c.sensors.controlled[output])


def next_step(c: CoolDownConstants, d: LadderState, tick: int, y: Numbers) -> int:
    """Return the step that follows from the outputs of a tick."""
    if not d.has_begun:
        return TURBINE if y[c.temperature] > c.warm and y[c.level] < c.liquid else FINISHED
    if d.step == FINISHED:
        return FINISHED
    if d.step == SETTLING:
        if not (c.low[0] <= y[c.level] <= c.high[0] and c.low[1] <= y[c.outlet] <= c.high[1]):
            d.settled_since = NONE
            return SETTLING
        if d.settled_since == NONE or tick < d.settled_since:
            d.settled_since = tick
        return FINISHED if (tick - d.settled_since) * c.tick_s >= c.settled_s else SETTLING
    ended = (
        (d.step == TURBINE and y[c.outlet] <= c.cold)
        or (d.step == BATH and y[c.level] >= c.liquid)
        or (d.step == FILLING and y[c.level] >= c.low[0])
    )
    return d.step + ended


def cool_down_constants(
    settings: CoolDownSettings, limits: InputLimits, inputs: Sequence[float], outputs: Sequence[float]
) -> CoolDownConstants:  # fmt: skip
    """Return the cool-down of a process, with the inputs and outputs at its operating point."""
    process, bath = limits.process, limits.process.bath
    times = settings.settled_s, process.tick_s
    if bath is None:
        return CoolDownConstants(-1, -1, -1, -1, -1, -1, [0.0], [0.0], 0.0, inputs, 0.0, 0.0, *times)
    level, temperature, outlet = map(process.output_names.index, (bath.level, bath.temperature, bath.turbine_outlet))
    feed, heater, valve = map(process.input_names.index, bath.inputs)
    bands = dict(zip(process.controlled, process.bands, strict=True))
    return CoolDownConstants(
        level, temperature, outlet, feed, heater, valve,
        [bands[level].low, bands[outlet].low], [bands[level].high, bands[outlet].high], outputs[outlet], inputs,
        settings.warm_k, settings.liquid_pct, *times,
    )  # fmt: skip
