"""The control PLC's program, and what ordinary ticks change of it."""

from typing import Any

import numpy as np

from coldloop.registers.control_plc import SEQUENCE_ROWS, Mode, OperatorMode, ProcessNow, SequenceHeader, Update
from coldloop.registers.safety import AlarmKind, CapacityCause, band_alarms
from coldloop.safety.sequence import InputSequence, with_checksum
from coldloop_control_plc.output_limits import GuardState, Limits
from coldloop_control_plc.process_alarms import present_limits
from coldloop_control_plc.program import ControlProgram
from coldloop_rig.cosim.compiled.records import NOT, Alarms, Array, Trace, guard_type, scan_type

OF_PLANS = (AlarmKind.CAPACITY, AlarmKind.SENSOR_SUSPECT, AlarmKind.INPUT_WITHOUT_EFFECT)
"""Alarms of what plans say."""
SILENCE_TICKS = 2
"""What may be longer than a sampling period between two signs of life of an optimiser that answers every update."""


def is_ordinary(program: ControlProgram) -> bool:
    """Return whether the next tick is an ordinary one, as far as the control PLC is concerned."""
    return (
        program.mode is Mode.MPC
        and program.operator.mode == OperatorMode.AUTO
        and program.optimizer_present
        and program.player.is_ordinary(program.tick)
        and not program.sensors.bad
        and not program.guard.state.out_of_bounds
        and program.alarms.are_quiet
        and program.alarms.reported(AlarmKind.CAPACITY) == CapacityCause.of(program.shortage)
        and program.has_noted_suspects
        and due(program) > program.tick
        and not program.watchdog.expired
        and (not program.watchdog.time or program.watchdog.time > program.guard.limits.ticks_per_sample + SILENCE_TICKS)
    )


def due(program: ControlProgram) -> float:
    """Return the tick at which an alarm of what plans say follows its condition; infinite where none is about to."""
    return min(map(program.alarms.due, OF_PLANS))


def alarms_of(program: ControlProgram) -> Alarms:
    """Return the band alarms as they are, with their present limits."""
    low, high = np.array(present_limits(program.alarm_settings, program.alarms), dtype=np.float64).T
    bands, process = band_alarms(program.alarm_settings.process), program.alarm_settings.process
    active, delays = zip(
        *((bool(program.alarms.rows[each].active), program.alarms.delay(each)) for each in bands), strict=True
    )
    return Alarms(
        low.copy(),
        high.copy(),
        np.array(process.controlled),
        np.array(active),
        np.array(delays),
    )


def scan_record(program: ControlProgram) -> Any:  # noqa: ANN401 a record
    """Return the state of player, sensors, alarms and watchdog, shape (1,)."""
    scans, player, sensors = np.zeros(1, scan_type(program.alarm_settings.process)), program.player, program.sensors
    s, update, playing = scans[0], player.update, player.sequence
    if update is None or playing is None:
        raise RuntimeError("an ordinary tick plays a sequence")
    s["first"] = s["tick"] = program.tick
    s["next_update"], s["updates"] = player.next_update_tick, player.updates
    s["update_tick"], s["update_load"], s["load_step"] = update.tick, update.load, player.load_step
    header = playing.header
    s["number"], s["first_tick"], s["length"], s["tau_u"] = (
        header.number, header.first_tick, header.length, header.tau_u
    )  # fmt: skip
    s["triggered"], s["lowest"] = program.watchdog.triggered, program.watchdog.lowest
    s["since"] = [
        NOT if since is None else since
        for since in program.alarms.pending(*band_alarms(program.alarm_settings.process))
    ]
    s["unchanged"], s["rests"], s["seen"] = sensors.unchanged, sensors.rests, sensors.before
    s["inputs"], s["inputs_moved"] = sensors.inputs, sensors.inputs_moved
    _, s["seen_x"], (s["seen_load"],) = sensors.image.last
    s["image_inputs"], s["image_count"], s["image_moved"] = (
        sensors.image.inputs, sensors.image.count, sensors.image.has_moved
    )  # fmt: skip
    s["short"], s["suspects"] = np.sign(program.shortage), program.suspects
    return scans


def guard_records(state: GuardState, limits: Limits) -> Any:  # noqa: ANN401 records
    """Return the state of the output guard, and room for a twin of it, shape (2,)."""
    guards = np.zeros(2, guard_type(limits))
    g, slots = guards[0], len(state.moves)
    for name in ("applied", "anchor", "start", "share", "moved", "oldest"):
        g[name] = getattr(state, name)
    g["moves"][:slots], g["before"][:slots] = state.moves, state.before
    return guards


def restore_guard(program: ControlProgram, g: Any) -> None:  # noqa: ANN401 a record
    """Restore the guard from a record."""
    state, slots = program.guard.state, len(program.guard.state.moves)
    state.applied[:], state.anchor[:] = g["applied"].tolist(), g["anchor"].tolist()
    state.moves[:], state.before[:] = g["moves"][:slots].tolist(), g["before"][:slots].tolist()
    state.start, state.moved, state.oldest = int(g["start"]), int(g["moved"]), int(g["oldest"])
    state.share = float(g["share"])
    program.guard.applied = tuple(state.applied)


def restore_scan(program: ControlProgram, s: Any, trace: Trace) -> None:  # noqa: ANN401 a record
    """Restore sensors, alarms, watchdog and process after the ticks of a record (at least one)."""
    last = int(s["tick"]) - 1
    row = last - int(s["first"])
    u, y, x = (tuple(values[row].tolist()) for values in (trace.u, trace.y, trace.x))
    load, sensors = float(trace.load[row]), program.sensors
    program.tick, program.alarms.now = last + 1, last
    program.process = ProcessNow(last, load, u, y)
    for name in ("unchanged", "rests", "inputs", "inputs_moved"):
        getattr(sensors, name)[:] = s[name].tolist()
    sensors.image.inputs, sensors.image.count = tuple(s["image_inputs"].tolist()), int(s["image_count"])
    sensors.image.has_moved = bool(s["image_moved"])
    sensors.seen(last, y, x, (load,))
    program.watchdog.triggered, program.watchdog.lowest = int(s["triggered"]), int(s["lowest"])
    for kind, since in zip(band_alarms(program.alarm_settings.process), s["since"].tolist(), strict=True):
        program.alarms.set_pending(kind, None if since == NOT else since)


def latched_update(program: ControlProgram, s: Any, trace: Trace) -> Update:  # noqa: ANN401 a record
    """Return the update under way, which was latched within the trace."""
    tick = int(s["update_tick"])
    row = tick - int(s["first"])
    u, y, x = (tuple(values[row].tolist()) for values in (trace.u, trace.y, trace.x))
    return Update(
        session=program.session, update=int(s["updates"]) - 1, tick=tick, playing=int(s["number"]),
        load=float(trace.load[row]), u_before=tuple(s["u_before"].tolist()), u=u, y=y, x=x,
    )  # fmt: skip


def played_sequence(s: Any, update: int, rows: Array, model_digest: int) -> InputSequence:  # noqa: ANN401 a record
    """Return the sequence being played, which answers `update`."""
    length = int(s["length"])
    header = SequenceHeader(
        number=int(s["number"]), update=update, first_tick=int(s["first_tick"]), length=length, tau_u=int(s["tau_u"]),
        model_digest=model_digest, crc=0,
    )  # fmt: skip
    return with_checksum(header, list(map(tuple, rows[:length].tolist())))


def sequence_rows(sequence: InputSequence) -> Array:
    """Return the rows of a sequence, and room for those of the next one, shape (2, 240, inputs)."""
    rows = np.zeros((2, SEQUENCE_ROWS, len(sequence.rows[0])))
    rows[0, : len(sequence.rows)] = sequence.rows
    return rows
