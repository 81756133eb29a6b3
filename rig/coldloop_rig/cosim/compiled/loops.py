"""Ticks and updates of the three programs as one compiled loop, while nothing unusual happens.

An ordinary tick plays a row of a sequence in time, with good sensors and no alarm that changes. Before each tick `look`
finds out whether it is one; when not, the loop ends with nothing of that tick done, and the programs do it. Values that
would cross the link are rounded as the link rounds them, through the rows of the trace.
"""

from typing import Any, Final

import numpy as np

import coldloop_rig.cosim.compiled.portable  # noqa: F401 it lets kernels call what is plain Python
from coldloop.kernels.compiled import inlined, kernel
from coldloop.kernels.intrinsics import borrowed
from coldloop.registers.plant import MAX_STATE
from coldloop_control_plc.output_limits import admit, copy_state, in_range, judge
from coldloop_control_plc.sensors import are_inside, count_unchanged, have_moved, is_frozen, is_to_move, note_moves
from coldloop_optimizer_plc import decisions, scheme
from coldloop_optimizer_plc.scheme import OptimizerState
from coldloop_rig.cosim.compiled.plants import advance_plant
from coldloop_rig.cosim.compiled.records import NOT, Alarms, Array, Optimizer, PlantState, Reports, Trace, World

DONE: Final = 0
UNUSUAL: Final = 1
UPDATE: Final = 2
"""An updating instant, which the caller does itself."""


@inlined
def look(w: World, alarms: Alarms, s: Any, plant: PlantState, trace: Trace) -> bool:  # noqa: ANN401 a record
    """Write load, outputs and state of the present tick into the trace; return whether the tick is an ordinary one."""
    row = s.tick - s.first
    while s.load_index + 1 < w.load_ticks.shape[0] and w.load_ticks[s.load_index + 1] <= s.tick:
        s.load_index += 1
    load = w.load_watts[s.load_index]
    trace.load[row], trace.y[row], trace.x[row], trace.station[row] = load, plant.y, plant.x, plant.station
    y, x = trace.y[row], trace.x[row]
    known = w.least_load <= load <= w.largest_load
    for i in range(x.shape[0]):
        known = known and abs(x[i]) <= MAX_STATE
    interrupted = s.load_step > 0.0 and abs(load - s.update_load) > s.load_step
    frozen, same = False, load == (trace.load[row - 1] if row > 0 else s.seen_load)
    for i in range(y.shape[0]):
        rests = y[i] == s.seen[i]
        same = same and rests
        still = rests and is_frozen(s.unchanged[i] + 1, s.rests[i], w.least[i])
        frozen = frozen or (still and (not w.each_may_rest or is_to_move(s.inputs_moved[i], s.tick, w.least[i])))
    if same:
        for i in range(x.shape[0]):
            same = same and x[i] == (trace.x[row - 1, i] if row > 0 else s.seen_x[i])
    s.same = same
    changes = False
    for band in range(alarms.places.shape[0]):
        changes = changes or is_due(alarms, band, s.since[band], s.tick, y)
    return known and not (interrupted or frozen or changes) and are_inside(y, w.low, w.high)


@kernel
def differs(alarms: Alarms, band: int, y: Array) -> bool:
    """Return whether the condition of a band alarm is another than the alarm shows."""
    inside = alarms.low[band] <= y[alarms.places[band]] <= alarms.high[band]
    return bool(inside == alarms.active[band])


@kernel
def is_due(alarms: Alarms, band: int, since: int, tick: int, y: Array) -> bool:
    """Return whether a band alarm follows its condition at this tick, after its delay."""
    return differs(alarms, band, y) and bool(tick - (tick if since == NOT else since) >= alarms.delays[band])


@kernel
def is_old_image(w: World, s: Any, guard: Any, twin: Any, wanted: Array, begins: bool) -> bool:  # noqa: ANN401, FBT001
    """Return whether the image that `look` has seen is one that the sensor check no longer believes.

    It has been unchanged for long although the inputs have moved, with those of this tick, where `wanted` is asked for.
    """
    if not s.same or s.image_count + 1 < w.frozen_ticks:
        return False
    copy_state(guard, twin, w.limits)
    admit(twin, w.limits, s.tick, wanted, begins)
    return s.image_moved or have_moved(twin.applied, s.image_inputs, w.moves)


@kernel
def note_image(w: World, s: Any, u: Array) -> None:  # noqa: ANN401
    """Count for how many ticks the image is unchanged, and note whether the inputs have moved meanwhile."""
    if s.same:
        s.image_count += 1
        s.image_moved = s.image_moved or have_moved(u, s.image_inputs, w.moves)
    else:
        for i in range(u.shape[0]):  # a slice would be more machine code to load
            s.image_inputs[i] = u[i]
        s.image_count, s.image_moved = 0, not w.may_rest


@inlined
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
    count_unchanged(s.unchanged, s.rests, s.seen, y, 1, w.least, w.controlled, w.kinds)
    if w.each_may_rest:
        note_moves(s.unchanged, s.inputs, s.inputs_moved, u, w.moves, tick)
    note_image(w, s, u)
    for band in range(alarms.places.shape[0]):
        if not differs(alarms, band, y):
            s.since[band] = NOT
        elif s.since[band] == NOT:
            s.since[band] = tick
    s.tick = tick + 1


@kernel
def play(
    w: World, alarms: Alarms, scans: Any, guards: Any, rows: Array, plant: PlantState, trace: Trace, until: int  # noqa: ANN401
) -> int:  # fmt: skip
    """Play the sequence up to the next updating instant; return DONE at the tick `until`, UNUSUAL or UPDATE."""
    w, alarms, rows, plant, trace = borrowed(w), borrowed(alarms), borrowed(rows), borrowed(plant), borrowed(trace)
    s, guard, twin = scans[0], guards[0], guards[1]
    while s.tick < until:
        place = s.tick - s.first_tick
        if s.tick == s.next_update:
            return UPDATE
        if place >= s.length or not look(w, alarms, s, plant, trace):
            return UNUSUAL
        if is_old_image(w, s, guard, twin, rows[place], place == 0):
            return UNUSUAL
        scan(w, alarms, s, guard, rows, plant, trace)
    return DONE


@kernel
def run_block(
    w: World,
    alarms: Alarms,
    o: Optimizer,
    scans: Any,  # noqa: ANN401
    guards: Any,  # noqa: ANN401
    rows: Array,
    plant: PlantState,
    trace: Trace,
    reports: Reports,
    until: int,
) -> int:
    """Do ticks and updates; return DONE at the tick `until` or where a shortage or the suspects change, or UNUSUAL.

    An answer is computed when the programs would deliver it: at its instant, or at once where a load step may cut it
    off. One that has not begun when something unusual happens is not reported: it is computed again, with the same
    bits. `rows` (2, 240, inputs) are those of the sequence being played, and of the one that was offered.
    """
    w, alarms, o, rows, plant = borrowed(w), borrowed(alarms), borrowed(o), borrowed(rows), borrowed(plant)
    trace, reports = borrowed(trace), borrowed(reports)
    s, guard, twin = scans[0], guards[0], guards[1]
    u_before, answered = np.empty(guard.applied.shape[0]), False
    outcome = DONE
    while s.tick < until:
        tick, instant = s.tick, s.tick == s.next_update
        outcome = UNUSUAL
        if not look(w, alarms, s, plant, trace):
            break
        if not answered and (instant or s.load_step > 0.0):
            answered = s.next_update <= until and answer(w, o, s, guard, twin, rows, reports)
            if not answered:
                break
        place = 0 if instant else tick - s.first_tick
        ended = not instant and place >= s.length
        if ended or is_old_image(w, s, guard, twin, rows[int(instant), place], place == 0):
            break
        if instant:
            begin_sequence(s, rows, o.memory)
            answered = False
        u_before[:] = guard.applied
        scan(w, alarms, s, guard, rows[0], plant, trace)
        outcome = DONE
        if instant:
            latch(w, o, s, trace, tick, u_before)
            now = o.memory.numbers[0]
            if np.sign(now.shortage) != s.short or now.suspects != s.suspects:
                break
    if answered:
        s.solved -= 1
    return outcome


@kernel
def answer(
    w: World, o: Optimizer, s: Any, guard: Any, twin: Any, rows: Array, reports: Reports  # noqa: ANN401
) -> bool:  # fmt: skip
    """Solve the problem of the update under way; return whether the control PLC would accept the sequence."""
    m = o.memory
    scheme.solve(o.constants, o.method, m)
    offered, length = rows[1], m.sent.numbers[0].length
    offered[:length] = m.sent.rows[:length]
    accepted = length > 0 and s.next_update - s.first_tick <= s.length
    for tick in range(length):
        accepted = accepted and in_range(w.limits, offered[tick])
    if not accepted:
        return False
    played, left = rows[0, s.tick - s.first_tick :], s.next_update - s.tick
    if not judge(guard, twin, w.limits, s.tick, played, 0, left, s.next_update, offered, length):
        return False
    report(s, m, reports)
    trigger(w, s, s.tick)
    return True


@kernel
def begin_sequence(s: Any, rows: Array, m: OptimizerState) -> None:  # noqa: ANN401
    """Let the answer be what is played."""
    decisions.begin_sent(m)
    playing = m.playing.numbers[0]
    rows[0, : playing.length] = rows[1, : playing.length]
    s.number, s.first_tick, s.length, s.tau_u = playing.number, s.tick, playing.length, playing.ticks
    s.accepted += 1


@kernel
def latch(
    w: World, o: Optimizer, s: Any, trace: Trace, tick: int, u_before: Array  # noqa: ANN401
) -> None:  # fmt: skip
    """Latch an update at `tick`, whose scan has been done, and plan the updating period that begins there."""
    m, row = o.memory, tick - s.first
    real = m.u.dtype.type
    s.update_tick, s.update_load = tick, trace.load[row]
    s.u_before[:] = u_before
    for i in range(m.u.shape[0]):
        m.u[i] = real(trace.u[row, i]) - o.constants.estimator.u0[i]
    before, y, x = measured(u_before, m), measured(trace.y[row], m), measured(trace.x[row], m)
    decisions.plan(o.constants, o.rule, m, decisions.BY_THE_RULE, s.updates, tick, before, real(trace.load[row]), y, x)
    s.updates += 1
    s.next_update, s.load_step = tick + m.numbers[0].ticks, w.load_step
    trigger(w, s, tick + 1)


@kernel
def measured(values: Array, m: OptimizerState) -> Array:
    """Return values in the optimiser's floating-point type."""
    result = np.empty(values.shape[0], m.u.dtype)
    for i in range(values.shape[0]):
        result[i] = values[i]
    return result


@kernel
def trigger(w: World, s: Any, tick: int) -> None:  # noqa: ANN401
    """Let the optimiser's watchdog note a sign of life."""
    s.lowest = min(s.lowest, w.watchdog, max(0, w.watchdog - (tick - s.triggered)))
    s.triggered = tick


@kernel
def report(s: Any, m: OptimizerState, reports: Reports) -> None:  # noqa: ANN401
    """Write what was done with the update under way."""
    now, sent = m.numbers[0], m.sent.numbers[0]
    counts, values = reports.counts[s.solved], reports.values[s.solved]
    counts[0], counts[1], counts[2], counts[3], counts[4] = now.update, now.tick, now.ticks, now.q, sent.iterations
    values[0], values[1], values[2], values[3] = now.effective, sent.hot_start, sent.delivered, sent.j_dev
    values[4], values[5] = sent.j_cst, sent.violation
    values[6], values[7], values[8], values[9] = now.efficiency, now.mismatch, now.contraction, now.gamma
    values[10] = m.belief.numbers[0].mismatch
    s.solved += 1
