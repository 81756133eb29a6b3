"""Ticks and updates of the three programs as one compiled loop, which runs until something has to be reported.

A tick is: outputs, the plant's step, the measurement observed. The control PLC's part is its own functions, which take
records in the place of its objects. The loop ends with a tick that `decide` or `observe` has found something in, which
the program concludes. Values that would cross the link are rounded as the link
rounds them, through the rows of the trace.
"""

from collections.abc import Callable
from inspect import isfunction
from typing import Any, Final

import numpy as np
from numba.extending import overload, register_jitable
from numpy.typing import NDArray

from coldloop.kernels import single_precision
from coldloop.kernels.compiled import inlined, kernel
from coldloop.kernels.intrinsics import borrowed
from coldloop.safety import watchdog
from coldloop.safety.watchdog import trigger
from coldloop_control_plc import alarms, output_limits, player, scan, sensors
from coldloop_control_plc.output_limits import in_range, judge
from coldloop_control_plc.player import accept, awaits_sequence, has_row, latch, latches, promise
from coldloop_control_plc.scan import Scan, decide, observe
from coldloop_optimizer_plc import scheme
from coldloop_optimizer_plc.decisions import Latched, note_answer, take_update
from coldloop_optimizer_plc.scheme import OptimizerState
from coldloop_rig.cosim.compiled import records
from coldloop_rig.cosim.compiled.plants import advance_plant
from coldloop_rig.cosim.compiled.records import Array, Optimizer, PlantState, Records, Reports, Trace, World

Counts = NDArray[np.int64]

PORTABLE: Final[tuple[Callable[..., Any], ...]] = (
    single_precision.neighbour,
    *(
        function
        for module in (alarms, output_limits, player, scan, sensors, watchdog)
        for name, function in vars(module).items()
        if isfunction(function) and function.__module__ == module.__name__ and not name.startswith("_")
    ),
)
"""The control PLC's scan, which is plain Python (that PLC runs without numba): kernels call it, and exports have it."""

for portable in PORTABLE:
    register_jitable(error_model="numpy")(portable)


@overload(single_precision.single, jit_options={"error_model": "numpy"}, strict=False)
def _single(value: Any) -> Any:  # noqa: ANN401, ARG001 a type of numba
    return lambda value: np.float64(np.float32(value))


DONE: Final = 0
OBSERVED: Final = 2
"""The last tick is still to be concluded."""
AWAITED: Final = 3
"""The next tick awaits a sequence."""
LATCHED: Final = 4
"""An update was latched in the last tick, and awaits its plan."""
LATE: Final = False
"""Whether answers come late."""


@kernel
def play(
    w: World, parts: Records, rows: Array, plant: PlantState, trace: Trace, counts: Counts, until: int
) -> int:  # fmt: skip
    """Do ticks before the tick `until`; return why there are no more."""
    w, rows, plant, trace, counts = borrowed(w), borrowed(rows), borrowed(plant), borrowed(trace), borrowed(counts)
    return go_on(w, parts, rows, plant, trace, counts, until)


@inlined
def go_on(
    w: World, parts: Records, rows: Array, plant: PlantState, trace: Trace, counts: Counts, until: int
) -> int:  # fmt: skip
    """Do what `play` does. `rows` (2, 240, inputs) are those of a slot."""
    guard, player = parts.guard[0], parts.player[0]
    s = Scan(guard, parts.ladder[0], player, parts.sensors[0], parts.alarms[0], parts.watchdog[0])
    tick = counts[records.TICK]
    while tick < until:
        if awaits_sequence(player, tick):
            return AWAITED
        row = tick - counts[records.FIRST]
        while counts[records.LOAD] + 1 < w.load_ticks.shape[0] and w.load_ticks[counts[records.LOAD] + 1] <= tick:
            counts[records.LOAD] += 1
        load = w.load_watts[counts[records.LOAD]]
        trace.load[row], trace.y[row], trace.x[row], trace.station[row] = load, plant.y, plant.x, plant.station
        changed = decide(w.scan, s, tick, rows)  # type: ignore[arg-type]
        u, y, x = guard.applied, trace.y[row], trace.x[row]
        trace.u[row] = u
        advance_plant(w.plant, plant, u, load, row)
        if plant.noise.shape[0]:
            for i in range(plant.y.shape[0]):
                plant.y[i] = plant.y[i] + w.biases[i] + w.deviations[i] * plant.noise[row, i]
        told = observe(w.scan, s, tick, y, x, trace.load[row])
        counts[records.TICK] = tick + 1
        if told or changed:
            return OBSERVED
        if latches(player, tick, trace.load[row]):
            latch(player, tick, trace.load[row], w.scan.limits.ticks_per_sample)
            return LATCHED
        tick += 1
    return DONE


@kernel
def run_block(
    w: World,
    o: Optimizer,
    parts: Records,
    rows: Array,
    plant: PlantState,
    trace: Trace,
    reports: Reports,
    counts: Counts,
    until: int,
) -> int:
    """Do ticks and updates before the tick `until`, or until a shortage or the suspects change; return why no more."""
    w, o, parts, rows, plant = borrowed(w), borrowed(o), borrowed(parts), borrowed(rows), borrowed(plant)
    trace, reports, counts = borrowed(trace), borrowed(reports), borrowed(counts)
    before, first = np.empty(trace.u.shape[1], np.float32), counts[records.FIRST]
    for i in range(before.shape[0]):
        before[i] = parts.guard[0].applied[i]
    while True:
        outcome = go_on(w, parts, rows, plant, trace, counts, until)
        if outcome == AWAITED:
            if not answer(w, o, parts, rows, reports, counts):
                return outcome
        elif outcome == LATCHED:
            row = counts[records.TICK] - 1 - first
            if plan(o, parts, trace, row, trace.u[row - 1] if row > 0 else before):
                return DONE
        else:
            return outcome


@kernel
def answer(w: World, o: Optimizer, parts: Records, rows: Array, reports: Reports, counts: Counts) -> bool:
    """Solve the problem of the update under way; return whether the control PLC accepts the sequence."""
    m, player, limits, tick = o.memory, parts.player[0], w.scan.limits, counts[records.TICK]
    scheme.solve(o.constants, o.method, m)
    sent, other = m.sent.numbers[0], 1 - player.slot
    length, first_tick, offered = sent.length, player.next_update_tick, rows[other]
    offered[:length] = m.sent.rows[:length]
    in_limits = length > 0
    for place in range(length):
        in_limits = in_limits and in_range(limits, offered[place])
    if not in_limits:
        return False
    place = tick - player.first_ticks[player.slot]
    left = max(0, min(first_tick - tick, player.lengths[player.slot] - place)) if has_row(player, tick) else 0
    played = rows[player.slot, max(0, place) :]
    if not judge(parts.guard[0], parts.guard[1], limits, tick, played, 0, left, first_tick, offered, length):
        return False
    accept(player, sent.number, first_tick, length)
    note_answer(m, LATE)
    report(m, reports.counts[counts[records.SOLVED]], reports.values[counts[records.SOLVED]])
    counts[records.SOLVED] += 1
    trigger(parts.watchdog[0], tick)
    return True


@kernel
def plan(o: Optimizer, parts: Records, trace: Trace, row: int, before: NDArray[Any]) -> bool:
    """Plan the updating period of the update latched in a row; return whether a shortage or the suspects change."""
    m, player, real, room = o.memory, parts.player[0], o.memory.u.dtype.type, o.latched
    playing = player.numbers[player.slot] if player.lengths[player.slot] > 0 else 0
    write(before, room.u_before)
    write(trace.u[row], room.u)
    write(trace.y[row], room.y)
    write(trace.x[row], room.x)
    latched = Latched(
        player.update_number, player.update_tick, playing, real(trace.load[row]),
        room.u_before, room.u, room.y, room.x, room.ahead,
    )  # fmt: skip
    load_step: Any = np.float32(take_update(o.constants, o.rule, o.starts, m, latched))
    now, short, suspects = m.numbers[0], np.sign(player.shortage), player.suspects
    promise(player, player.update_tick + now.ticks, load_step, np.float32(now.shortage), now.suspects)  # type: ignore[arg-type]
    trigger(parts.watchdog[0], player.update_tick + 1)
    return np.sign(player.shortage) != short or player.suspects != suspects  # type: ignore[no-any-return]


@kernel
def write(values: Array, room: Array) -> None:
    """Write values in the optimiser's floating-point type."""
    for i in range(values.shape[0]):
        room[i] = values[i]


@kernel
def report(m: OptimizerState, counts: Counts, values: Array) -> None:
    """Write what was done with the update under way."""
    now, sent = m.numbers[0], m.sent.numbers[0]
    counts[0], counts[1], counts[2], counts[3], counts[4] = now.update, now.tick, now.ticks, now.q, sent.iterations
    values[0], values[1], values[2], values[3] = now.effective, sent.hot_start, sent.delivered, sent.j_dev
    values[4], values[5] = sent.j_cst, sent.violation
    values[6], values[7], values[8], values[9] = now.efficiency, now.mismatch, now.contraction, now.gamma
    values[10] = m.belief.numbers[0].mismatch
