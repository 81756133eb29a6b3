"""The columns of the files of a run: names, types, units, descriptions; Arrow arrays from and to numbers."""

from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray

from coldloop.process import cold_box, declaration
from coldloop.registers import Maps, common, control_plc, maps_of, optimizer_plc, plant

FORMAT: Final = 2
"""Version of the files of a run."""
TRACE, UPDATES, EVENTS = "trace.parquet", "updates.parquet", "events.parquet"
STATION: Final = "station.parquet"
"""Only where the plant is a refrigerator."""
FILES: Final = (TRACE, UPDATES, EVENTS, STATION)
REAL, WHOLE, LONG, TEXT = pa.float32(), pa.int32(), pa.int64(), pa.string()


class Column(NamedTuple):
    """One column. `unit` is 1 for a number without a unit and empty for text."""

    name: str
    kind: pa.DataType
    unit: str
    description: str
    values: type[IntEnum] | None = None
    """Meaning of the numbers of an enumeration."""

    @property
    def field(self) -> pa.Field:
        """The field of an Arrow schema, with unit and description in its metadata."""
        return pa.field(self.name, self.kind, metadata={"unit": self.unit, "description": self.description})


class RunFile(NamedTuple):
    """A file of a run."""

    description: str
    columns: tuple[Column, ...]

    @property
    def schema(self) -> pa.Schema:
        """Its Arrow schema."""
        return pa.schema([column.field for column in self.columns], metadata={"coldloop_format": str(FORMAT)})


@cache
def files_of(process: declaration.Process) -> dict[str, RunFile]:
    """Return the files of a run of a process, by name."""
    maps = maps_of(process)
    updates = "One row an update that no load step cut off; `verdict` says whether it was played"
    station = "One row a tick: compression station and nitrogen; only where the plant is a refrigerator"
    sample = maps.plant.block_of(plant.StationSample).fields
    signals = zip(cold_box.STATION_SIGNAL_NAMES, cold_box.STATION_SIGNAL_UNITS, strict=True)
    station_columns = (
        *_when(process),
        *(Column(name, REAL, unit, sample["signals"].description) for name, unit in signals),
        Column("mode", WHOLE, "1", sample["mode"].description, plant.StationMode),
        Column("alarms", WHOLE, "1", sample["alarms"].description),
    )
    event = maps.control_plc.block_of(common.Event).fields
    event_columns = (
        Column("service", TEXT, "", "Whose journal: control_plc or plant"),
        Column("number", LONG, "1", event["number"].description),
        Column("boot", WHOLE, "1", event["boot"].description),
        Column("utc", TEXT, "", "UTC, ISO 8601 with milliseconds"),
        *_when(process),
        Column("kind", TEXT, "", "What happened: mode, alarm raised, setpoint, ..."),
        Column("subject", TEXT, "", "The new mode, the alarm, the input, ...: depends on the kind"),
        Column("cause", TEXT, "", "Why; empty when there is no cause"),
        Column("value", REAL, "", "A value; null when the kind has none"),
        Column("unit", TEXT, "", "Unit of the value; empty when it has none"),
        Column("who", TEXT, "", "Client that made the request: address, role, certificate; empty if there is none"),
    )
    return {
        TRACE: RunFile(f"One row a tick of {process.tick_unit}", _trace(process, maps)),
        UPDATES: RunFile(updates, _updates(process, maps)),
        EVENTS: RunFile("One row an event of the journals: modes, alarms, commands", event_columns),
        STATION: RunFile(station, station_columns),
    }


def _when(process: declaration.Process) -> tuple[Column, Column]:
    return (
        Column("tick", LONG, "1", f"Tick since the start of the session, of {process.tick_unit}"),
        Column("time_s", pa.float64(), "s", "Plant time since the start of the session"),
    )


_TAU_U: Final = Column("tau_u_s", pa.float64(), "s", "Updating period t_{i+1} - t_i")
_DRIVING: Final = (
    Column("mode", TEXT, "", "Mode of the fail-safe ladder: mpc, rest, hold, classical, manual"),
    Column("cause", TEXT, "", "Why the control PLC is in this mode"),
    Column("driver", TEXT, "", "Whose inputs are applied: optimizer, loops, operator, or nobody (held)"),
    Column("bad_sensors", TEXT, "", "Outputs whose measurement the control PLC substitutes; empty when none"),
    Column("stage_cost", pa.float64(), "1", "Stage cost of what was reached: deviations and violations of the bands"),
)
"""Columns of the control PLC's operating state, from its events, and of the stage cost."""


def _trace(process: declaration.Process, maps: Maps) -> tuple[Column, ...]:
    """Return load, inputs, outputs and states in the order of the digest; what sensors showed; mode and update."""
    load = maps.plant.block_of(plant.PlantSample).fields["load"].description
    update = maps.optimizer_plc.block_of(optimizer_plc.Optimization).fields
    outside = maps.plant.block_of(plant.ModelRangeStatus).fields["outside"].description
    output = "Output {}: with the noise of its sensor, without a sensor fault"
    measured = "What the sensor of {} showed, with its faults; null when it was no number"
    return (
        *_when(process),
        Column(process.load.column, REAL, process.load.unit or "1", load),
        *(Column(one.name, REAL, one.unit, f"{one.description}; applied from this tick on") for one in process.inputs),
        *(Column(one.name, REAL, one.unit, output.format(one.name)) for one in process.outputs),
        *(Column(f"x_{one.name}", REAL, one.unit, f"Simulated state {one.name}") for one in process.states),
        *(Column(f"{one.name}_measured", REAL, one.unit, measured.format(one.name)) for one in process.banded),
        *_DRIVING,
        Column("update", LONG, "1", "Last update whose sequence was played; null before the first"),
        _TAU_U,
        Column("iterations", WHOLE, "1", update["iterations"].description),
        Column("J", REAL, "1", update["j_effective"].description),
        Column("model_range", WHOLE, "1", outside),
    )


def _updates(process: declaration.Process, maps: Maps) -> tuple[Column, ...]:
    tick, time = _when(process)
    return (
        Column("update", LONG, "1", "Number of the update"),
        tick._replace(description="Tick of the updating instant t_i"),
        time._replace(description="Plant time of the updating instant t_i"),
        _TAU_U,
        *(
            Column(name, REAL if field.kind.label == "float32" else WHOLE, field.unit or "1",
                   field.description, control_plc.Verdict if name == "verdict" else None)
            for name, field in maps.optimizer_plc.block_of(optimizer_plc.Optimization).fields.items()
            if name not in ("update", "tick", "tau_u")
        ),
    )  # fmt: skip


def schema_document(process: declaration.Process, *, station: bool = False) -> dict[str, Any]:
    """Return the content of `schema.json`; with the station's file where there is one."""

    def described(one: Column) -> dict[str, Any]:
        values = {"values": {str(value.value): value.name for value in one.values}} if one.values else {}
        return {"name": one.name, "type": str(one.kind), "unit": one.unit, "description": one.description, **values}

    return {
        "format": FORMAT,
        "files": {
            name: {"description": file.description, "columns": [described(column) for column in file.columns]}
            for name, file in files_of(process).items()
            if station or name != STATION
        },
    }


def excess_keys(process: declaration.Process) -> list[str]:
    """Return the names of what is known of the excess of each output with a band.

    They are the share of the known ticks in which it was beyond by more than its dead band, %; the largest excess over
    the band itself, in its unit; the time integral of that, in its unit times s.
    """
    known = ("outside_dead_band_pct", "largest_excess", "excess_integral")
    return [f"{one.name}_{what}" for one in process.banded for what in known]


def number_array(values: ArrayLike, kind: pa.DataType, unknown: NDArray[np.bool_] | None = None) -> pa.Array:
    """Return N numbers as an array of a numeric type; null where they are unknown."""
    data = np.ascontiguousarray(values, kind.to_pandas_dtype())
    validity = None if unknown is None else pa.py_buffer(np.packbits(~unknown, bitorder="little"))
    return pa.Array.from_buffers(kind, len(data), [validity, pa.py_buffer(data)])


def text_array(texts: Sequence[str | None], places: NDArray[np.int64] | None = None) -> pa.Array:
    """Return texts, null where there is none, as an array with a row each, or with those at `places` in its rows."""
    raw = [(text or "").encode() for text in texts]
    offsets = np.cumsum([0, *map(len, raw)], dtype=np.int32)
    known = np.packbits(np.array([text is not None for text in texts], bool), bitorder="little")
    buffers = [pa.py_buffer(part) for part in (known, offsets, b"".join(raw))]
    array = pa.Array.from_buffers(pa.string(), len(raw), buffers)
    return array if places is None else array.take(number_array(places, pa.int64()))


def numbers_of(column: pa.Array) -> NDArray[np.float64]:
    """Return a numeric column as numbers; null becomes NaN."""
    validity, data = column.buffers()
    rows = slice(column.offset, column.offset + len(column))
    values = np.frombuffer(data, column.type.to_pandas_dtype())[rows].astype(float)
    if column.null_count:
        known = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[rows]
        values[known == 0] = np.nan
    return values
