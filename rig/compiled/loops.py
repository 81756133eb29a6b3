"""Ticks and updates of the three programs as one compiled loop, while nothing unusual happens.

An ordinary tick plays a row of a sequence in time, with good sensors and no alarm that changes. Before each tick `look`
finds out whether it is one; when not, the loop ends with nothing of that tick done, and the programs do it. Values that
would cross the link are rounded as the link rounds them, through the rows of the trace.
"""

from typing import Any, Final, NamedTuple

import numpy as np

import rig.compiled.portable  # noqa: F401 it lets kernels call what is plain Python
from coldloop.compiled import kernel
from coldloop.process import L1, T5
from control_plc.output_limits import admit, admits, copy_state, in_range
from control_plc.sensors import CONTROLLED, are_inside, watch_standing
from optimizer_plc import scheme
from optimizer_plc.scheme import Constants, Memory
from rig.compiled.plants import advance_plant
from rig.compiled.records import NOT, Alarms, Array, PlantState, Reports, Trace, World

DONE: Final = 0
UNUSUAL: Final = 1
UPDATE: Final = 2
"""An updating instant, which the caller does itself."""


@kernel
def look(w: World, alarms: Alarms, s: Any, plant: PlantState, trace: Trace) -> bool:  # noqa: ANN401 a record
    """Write load, outputs and state of the present tick into the trace; tell whether the tick is an ordinary one."""
    row = s.tick - s.first
    while s.load_index + 1 < w.load_ticks.shape[0] and w.load_ticks[s.load_index + 1] <= s.tick:
        s.load_index += 1
    load = w.load_watts[s.load_index]
    trace.load[row], trace.y[row], trace.x[row], trace.station[row] = load, plant.y, plant.x, plant.station
    y, x = trace.y[row], trace.x[row]
    known = 0.0 <= load <= w.largest_load
    for i in range(x.shape[0]):
        known = known and np.isfinite(x[i])
    interrupted = s.load_step > 0.0 and abs(load - s.update_load) > s.load_step
    frozen = False
    for place in range(len(CONTROLLED)):
        stands = y[CONTROLLED[place]] == s.seen[CONTROLLED[place]]
        frozen = frozen or (stands and s.stands[place] + 1 >= w.frozen_ticks)
    changes = is_due(alarms.level_band, alarms.level_active, alarms.level_delay, s.level_since, s.tick, y[L1])
    changes = changes or is_due(alarms.t5_band, alarms.t5_active, alarms.t5_delay, s.t5_since, s.tick, y[T5])
    return known and not (interrupted or frozen or changes) and are_inside(y, w.low, w.high)


@kernel
def is_due(band: tuple[float, float], active: bool, delay: int, since: int, tick: int, value: float) -> bool:  # noqa: FBT001
    """Tell whether a band alarm follows its condition at this tick, `delay` ticks after it has changed."""
    if (not band[0] <= value <= band[1]) == active:
        return False
    return tick - (tick if since == NOT else since) >= delay


@kernel
def pending(band: tuple[float, float], active: bool, since: int, tick: int, value: float) -> int:  # noqa: FBT001
    """Return since when the condition of a band alarm has been another than the alarm shows, or NOT."""
    if (not band[0] <= value <= band[1]) == active:
        return NOT
    return tick if since == NOT else since


@kernel
def scan(
    w: World, alarms: Alarms, s: Any, guard: Any, rows: Array, plant: PlantState, trace: Trace  # noqa: ANN401 records
) -> None:  # fmt: skip
    """Do the tick that `look` has looked at: outputs, the plant's step, the measurement."""
    tick, row = s.tick, s.tick - s.first
    admit(guard, w.limits, tick, rows[tick - s.first_tick], tick == s.first_tick)
    u, load = guard.applied, w.load_watts[s.load_index]
    trace.u[row] = u
    advance_plant(w.plant, plant, u, load, row)
    if plant.noise.shape[0]:
        for i in range(plant.y.shape[0]):
            plant.y[i] = plant.y[i] + w.biases[i] + w.deviations[i] * plant.noise[row, i]
    y = trace.y[row]
    watch_standing(s.stands, s.seen, y, 1)
    s.level_since = pending(alarms.level_band, alarms.level_active, s.level_since, tick, y[L1])
    s.t5_since = pending(alarms.t5_band, alarms.t5_active, s.t5_since, tick, y[T5])
    s.tick = tick + 1


@kernel
def play(
    w: World, alarms: Alarms, scans: Any, guards: Any, rows: Array, plant: PlantState, trace: Trace, until: int  # noqa: ANN401
) -> int:  # fmt: skip
    """Play the sequence up to the next updating instant; return DONE at the tick `until`, UNUSUAL or UPDATE."""
    s, guard = scans[0], guards[0]
    while s.tick < until:
        if s.tick == s.next_update:
            return UPDATE
        if s.tick - s.first_tick >= s.length or not look(w, alarms, s, plant, trace):
            return UNUSUAL
        scan(w, alarms, s, guard, rows, plant, trace)
    return DONE


@kernel
def go_on(
    w: World,
    alarms: Alarms,
    c: Constants,
    scans: Any,  # noqa: ANN401
    guards: Any,  # noqa: ANN401
    m: Memory,
    plant: PlantState,
    trace: Trace,
    reports: Reports,
    until: int,
) -> int:
    """Do ticks and updates; return DONE at the tick `until`, or UNUSUAL.

    An answer is computed when the programs would deliver it: at its instant, or at once where a load step may cut it
    off. One that has not begun when something unusual happens is forgotten, as if it had never been computed.
    """
    s, guard, twin = scans[0], guards[0], guards[1]
    u_before, kept, length = np.empty(3), before_solving(m), 0
    outcome = DONE
    while s.tick < until:
        tick, instant = s.tick, s.tick == s.next_update
        outcome = UNUSUAL
        if not look(w, alarms, s, plant, trace):
            break
        if length == 0 and (instant or s.load_step > 0.0):
            if s.next_update <= until:
                length = answer(w, c, s, guard, twin, m, kept, reports)
            if length == 0:
                break
        if instant:
            begin_sequence(s, m, length)
            length = 0
        if tick - s.first_tick >= s.length:
            break
        u_before[:] = guard.applied
        scan(w, alarms, s, guard, m.rows, plant, trace)
        if instant:
            latch(w, c, s, m, trace, reports, tick, u_before)
        outcome = DONE
    if length > 0:
        forget_answer(m, kept)
        s.solved -= 1
    return outcome


class BeforeSolving(NamedTuple):
    """What a solve changes in an optimiser's memory, as it was before."""

    numbers: Any
    u_before: Array
    predicted: Array
    x_solved: Array


@kernel
def before_solving(m: Memory) -> BeforeSolving:
    """Return a copy of what a solve changes."""
    return BeforeSolving(m.numbers.copy(), m.u_before.copy(), m.predicted.copy(), m.x_solved.copy())


@kernel
def forget_answer(m: Memory, kept: BeforeSolving) -> None:
    """Undo a solve."""
    m.numbers[0] = kept.numbers[0]
    m.u_before[:], m.predicted[:], m.x_solved[:] = kept.u_before, kept.predicted, kept.x_solved


@kernel
def answer(
    w: World, c: Constants, s: Any, guard: Any, twin: Any, m: Memory, kept: BeforeSolving, reports: Reports  # noqa: ANN401
) -> int:  # fmt: skip
    """Solve the problem of the update under way, and judge the sequence as the control PLC would; return its length.

    What is refused has the length 0, and is forgotten, as if it had never been solved.
    """
    kept.numbers[0] = m.numbers[0]
    kept.u_before[:], kept.predicted[:], kept.x_solved[:] = m.u_before, m.predicted, m.x_solved
    length = scheme.solve(c, m)
    accepted = s.next_update - s.first_tick <= s.length
    for tick in range(length):
        accepted = accepted and in_range(w.limits, m.answer_rows[tick])
    copy_state(guard, twin, w.limits)
    if accepted:
        for tick in range(s.tick, s.next_update):
            admit(twin, w.limits, tick, m.rows[tick - s.first_tick], tick == s.first_tick)
    if not (accepted and admits(twin, w.limits, s.next_update, m.answer_rows, length)):
        forget_answer(m, kept)
        return 0
    report(s, m, reports)
    trigger(w, s, s.tick)
    return length


@kernel
def begin_sequence(s: Any, m: Memory, length: int) -> None:  # noqa: ANN401
    """Let the answer be what is played."""
    scheme.take_answer(m)
    s.number, s.first_tick = m.numbers[0].sequences, s.tick
    s.length, s.tau_u = length, m.numbers[0].ticks
    s.accepted += 1


@kernel
def latch(
    w: World, c: Constants, s: Any, m: Memory, trace: Trace, reports: Reports, tick: int, u_before: Array  # noqa: ANN401
) -> None:  # fmt: skip
    """Latch an update at `tick`, whose scan has been done, and plan the updating period that begins there."""
    row = tick - s.first
    s.updates += 1
    s.update_tick, s.update_load = tick, trace.load[row]
    s.u_before[:] = u_before
    y, x = trace.y[row].astype(np.float64), trace.x[row].astype(np.float64)
    a = scheme.plan(c, m, tick, u_before, np.float64(trace.load[row]), y, x)
    of_update = reports.assessment
    of_update[0], of_update[1], of_update[2], of_update[3] = a.efficiency, a.mismatch, a.contraction, a.gamma
    s.next_update, s.load_step = tick + m.numbers[0].ticks, c.load_step
    trigger(w, s, tick + 1)


@kernel
def trigger(w: World, s: Any, tick: int) -> None:  # noqa: ANN401
    """Let the optimiser's watchdog note a sign of life."""
    s.lowest = min(s.lowest, w.watchdog, max(0, w.watchdog - (tick - s.triggered)))
    s.triggered = tick


@kernel
def report(s: Any, m: Memory, reports: Reports) -> None:  # noqa: ANN401
    """Write what was done with the update under way."""
    o, a = m.numbers[0], reports.assessment
    counts, values = reports.counts[s.solved], reports.values[s.solved]
    counts[0], counts[1], counts[2], counts[3] = s.updates - 1, o.update_tick, o.ticks, o.done
    values[0], values[1], values[2], values[3] = o.effective, o.hot_start, o.delivered, o.j_dev
    values[4], values[5] = o.j_cst, o.violation
    values[6], values[7], values[8], values[9] = a[0], a[1], a[2], a[3]
    values[10] = o.mismatch
    s.solved += 1
