"""Samples, updates and events as Arrow tables with the columns of `rig/results/columns.py`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from coldloop.process.loaded import PROCESS
from coldloop.process.model_range import recorded_model_range
from coldloop.process.signals import TICK_S
from coldloop.registers.audit import Event
from coldloop.registers.optimizer_plc import Optimization
from coldloop.service.event_text import describe, utc_text
from rig.results.arrow_arrays import number_array, text_array
from rig.results.columns import EVENTS, HELD_COLUMNS, MODEL_RANGE_COLUMN, STATION, TRACE, UPDATES, arrow_schema
from rig.results.driving import DrivingHistory
from rig.results.indicators import StageCost
from rig.results.recording import SampleBlock


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
    ticks = block.first + np.arange(len(block.load))
    columns = [
        ticks, ticks * TICK_S, *block.rows.T, *driving.measured(ticks, block.y), *driving.columns(ticks),
        cost.of(block), *_held(ticks, updates), _model_range(block),
    ]  # fmt: skip
    schema = arrow_schema(TRACE)
    arrays = [
        data if isinstance(data, pa.Array) else number_array(data, field.type)
        for field, data in zip(schema, columns, strict=True)
    ]
    return pa.table(arrays, schema)


def _model_range(block: SampleBlock) -> pa.Array:
    """Return what was outside the property tables; null at unknown ticks."""
    bits = recorded_model_range(block.x, block.station) if PROCESS.has_station else np.zeros(len(block.load), np.int32)
    return number_array(bits, MODEL_RANGE_COLUMN.kind, np.isnan(block.load))


def station_table(block: SampleBlock) -> pa.Table:
    """Return what is known of the station at the ticks of a block that has one."""
    ticks = block.first + np.arange(len(block.load))
    unknown = np.isnan(block.station[:, 0])
    schema = arrow_schema(STATION)
    columns = [(ticks, None), (ticks * TICK_S, None), *((np.nan_to_num(column), unknown) for column in block.station.T)]
    arrays = [number_array(data, field.type, mask) for field, (data, mask) in zip(schema, columns, strict=True)]
    return pa.table(arrays, schema)


def _held(ticks: Any, updates: Sequence[Optimization]) -> list[pa.Array]:  # noqa: ANN401 an array of integers
    """Return the columns that change at updating instants only.

    The time of an update that a load step has cut off belongs to the one before.
    """
    latest = np.searchsorted([row.tick for row in updates], ticks, side="right") - 1
    none = latest < 0
    values: list[list[float]] = [
        [row.update for row in updates],
        [row.tau_u * TICK_S for row in updates],
        [row.iterations for row in updates],
        [row.j_effective for row in updates],
    ]
    held = [np.asarray(column or [0])[np.maximum(latest, 0)] for column in values]
    types = [column.kind for column in HELD_COLUMNS]
    return [number_array(column, kind, none) for column, kind in zip(held, types, strict=True)]


def updates_table(updates: Sequence[Optimization]) -> pa.Table:
    """Return the table of updates."""
    rows = [
        {**row._asdict(), "time_s": row.tick * TICK_S, "tau_u_s": row.tau_u * TICK_S} for row in updates
    ]  # fmt: skip
    return _table(rows, UPDATES)


def events_table(events: Sequence[tuple[str, Event]]) -> pa.Table:
    """Return the table of events."""
    return _table([_event_row(service, event) for service, event in events], EVENTS)


def _event_row(service: str, event: Event) -> dict[str, Any]:
    text = describe(event)
    return {
        **text._asdict(), "service": service, "number": event.number, "boot": event.boot, "utc": utc_text(event),
        "tick": event.tick,
        "time_s": event.tick * TICK_S, "value": event.value if text.value else None,
    }  # fmt: skip


def _table(rows: Sequence[dict[str, Any]], columns: Any) -> pa.Table:  # noqa: ANN401 a tuple of columns
    return pa.table(
        [_array([row[column.name] for row in rows], column.kind) for column in columns], arrow_schema(columns)
    )


def _array(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    if pa.types.is_string(kind):
        return text_array(values)
    unknown = np.array([value is None for value in values], bool)
    return number_array([0 if value is None else value for value in values], kind, unknown)
