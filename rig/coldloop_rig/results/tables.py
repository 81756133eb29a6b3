"""Samples, updates and events as Arrow tables with the columns of `rig/coldloop_rig/results/columns.py`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from coldloop.process.declaration import Process
from coldloop.process.model_range import recorded_model_range
from coldloop.registers.audit import Event
from coldloop.registers.optimizer_plc import Optimization
from coldloop.service.event_text import describe, utc_text
from coldloop_rig.results.arrow_arrays import number_array, text_array
from coldloop_rig.results.columns import EVENTS, STATION, TRACE, UPDATES, RunFile, files_of
from coldloop_rig.results.driving import DrivingHistory
from coldloop_rig.results.indicators import StageCost
from coldloop_rig.results.recording import SampleBlock


def trace_table(
    block: SampleBlock, updates: Sequence[Optimization], cost: StageCost, driving: DrivingHistory
) -> pa.Table:
    """Return the trace of a block.

    Args:
        block: Ticks in a row.
        updates: Those whose sequence was played, from the last one before the block on, in their order.
        cost: Computes the stage cost.
        driving: Has the events of these ticks.
    """
    ticks, process = block.first + np.arange(len(block.load)), driving.process
    outside: Any = recorded_model_range(block.x, block.station) if process.has_station else np.zeros(len(ticks))
    columns = [
        ticks, ticks * process.tick_s, *block.rows.T, *driving.measured(ticks, block.y), *driving.columns(ticks),
        cost.of(block), *_held(ticks, updates, process.tick_s), (outside, np.isnan(block.load)),
    ]  # fmt: skip
    return _of_arrays(columns, files_of(process)[TRACE])


def station_table(block: SampleBlock, process: Process) -> pa.Table:
    """Return what is known of the station at the ticks of a block that has one."""
    ticks = block.first + np.arange(len(block.load))
    unknown = np.isnan(block.station[:, 0])
    known = ((np.nan_to_num(column), unknown) for column in block.station.T)
    return _of_arrays([ticks, ticks * process.tick_s, *known], files_of(process)[STATION])


def _of_arrays(columns: Sequence[Any], file: RunFile) -> pa.Table:
    """Return the table of columns: Arrow arrays, numbers, or numbers with a mask of those that are unknown."""
    schema = file.schema
    arrays = [
        data if isinstance(data, pa.Array)
        else number_array(data[0], field.type, data[1]) if isinstance(data, tuple)
        else number_array(data, field.type)
        for field, data in zip(schema, columns, strict=True)
    ]  # fmt: skip
    return pa.table(arrays, schema)


def _held(ticks: Any, updates: Sequence[Optimization], tick_s: float) -> list[Any]:  # noqa: ANN401 an array of integers
    """Return the columns that change at updating instants only, with a mask of the ticks before the first.

    The time of an update that a load step has cut off belongs to the one before.
    """
    latest = np.searchsorted([row.tick for row in updates], ticks, side="right") - 1
    none = latest < 0
    values: list[list[float]] = [
        [row.update for row in updates],
        [row.tau_u * tick_s for row in updates],
        [row.iterations for row in updates],
        [row.j_effective for row in updates],
    ]
    return [(np.asarray(column or [0])[np.maximum(latest, 0)], none) for column in values]


def updates_table(updates: Sequence[Optimization], process: Process) -> pa.Table:
    """Return the table of updates."""
    tick_s = process.tick_s
    rows = [{**row._asdict(), "time_s": row.tick * tick_s, "tau_u_s": row.tau_u * tick_s} for row in updates]
    return _of_rows(rows, files_of(process)[UPDATES])


def events_table(events: Sequence[tuple[str, Event]], process: Process) -> pa.Table:
    """Return the table of events."""
    return _of_rows([_event_row(service, event, process) for service, event in events], files_of(process)[EVENTS])


def _event_row(service: str, event: Event, process: Process) -> dict[str, Any]:
    text = describe(event, process)
    return {
        **text._asdict(), "service": service, "number": event.number, "boot": event.boot, "utc": utc_text(event),
        "tick": event.tick, "time_s": event.tick * process.tick_s,
        "value": event.value if text.value else None,
    }  # fmt: skip


def _of_rows(rows: Sequence[dict[str, Any]], file: RunFile) -> pa.Table:
    return pa.table([_array([row[column.name] for row in rows], column.kind) for column in file.columns], file.schema)


def _array(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    if pa.types.is_string(kind):
        return text_array(values)
    unknown = np.array([value is None for value in values], bool)
    return number_array([0 if value is None else value for value in values], kind, unknown)
