"""The columns of the files of a run: names, types, units, descriptions; `tables.py` fills them, in the same order."""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple

import pyarrow as pa

from coldloop.process.load_profile import LOAD_COLUMN
from coldloop.process.loaded import PROCESS
from coldloop.process.signals import OUTPUT_NAMES, OUTPUT_UNITS, STATE_NAMES, STATE_UNITS, TICK_UNIT
from coldloop.process.station import STATION_SIGNAL_NAMES, STATION_SIGNAL_UNITS
from coldloop.registers.audit import Event
from coldloop.registers.control_plc import Verdict
from coldloop.registers.maps import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import ModelRangeStatus, PlantSample, StationMode, StationSample
from rig.results.driving import SHOWN

FORMAT: Final = 2
"""Version of the files of a run."""


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


_TICK: Final = Column("tick", pa.int64(), "1", f"Tick since the start of the session, of {TICK_UNIT}")
_TIME: Final = Column("time_s", pa.float64(), "s", "Plant time since the start of the session")
_TAU_U: Final = Column("tau_u_s", pa.float64(), "s", "Updating period t_{i+1} - t_i")
_UPDATE: Final = OPTIMIZER_MAP.block_of(Optimization).fields
_EVENT: Final = CONTROL_MAP.block_of(Event).fields

MODEL_RANGE_COLUMN: Final = Column(
    "model_range", pa.int32(), "1", PLANT_MAP.block_of(ModelRangeStatus).fields["outside"].description
)

PHYSICAL_COLUMNS: Final = (
    Column(
        LOAD_COLUMN, pa.float32(), PROCESS.load.unit or "1", PLANT_MAP.block_of(PlantSample).fields["load"].description
    ),
    *(
        Column(one.name, pa.float32(), one.unit, f"{one.description}; applied from this tick on")
        for one in PROCESS.inputs
    ),
    *(
        Column(name, pa.float32(), unit, f"Output {name}: with the noise of its sensor, without a sensor fault")
        for name, unit in zip(OUTPUT_NAMES, OUTPUT_UNITS, strict=True)
    ),
    *(
        Column(f"x_{name}", pa.float32(), unit, f"Simulated state {name}")
        for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True)
    ),
)
"""Load, inputs, outputs and states, in the order of the digest of a trace."""

HELD_COLUMNS: Final = (
    Column("update", pa.int64(), "1", "Last update whose sequence was played; null before the first"),
    _TAU_U,
    Column("iterations", pa.int32(), "1", _UPDATE["iterations"].description),
    Column("J", pa.float32(), "1", _UPDATE["j_effective"].description),
)
"""What the optimiser was doing."""

DRIVING_COLUMNS: Final = (
    Column("mode", pa.string(), "", "Mode of the fail-safe ladder: mpc, rest, hold, classical, manual"),
    Column("cause", pa.string(), "", "Why the control PLC is in this mode"),
    Column("driver", pa.string(), "", "Whose inputs are applied: optimizer, loops, operator, or nobody (held)"),
    Column("bad_sensors", pa.string(), "", "Outputs whose measurement the control PLC substitutes; empty when none"),
)
"""What the control PLC was doing, by its events."""

MEASURED_COLUMNS: Final = tuple(
    Column(f"{OUTPUT_NAMES[output]}_measured", pa.float32(), OUTPUT_UNITS[output],
           f"What the sensor of {OUTPUT_NAMES[output]} showed, with its faults; null when it was no number")
    for output in SHOWN
)  # fmt: skip

TRACE: Final = (
    _TICK,
    _TIME,
    *PHYSICAL_COLUMNS,
    *MEASURED_COLUMNS,
    *DRIVING_COLUMNS,
    Column("stage_cost", pa.float64(), "1", "Stage cost of what was reached: deviations and violations of the bands"),
    *HELD_COLUMNS,
    MODEL_RANGE_COLUMN,
)

UPDATES: Final = (
    Column("update", pa.int64(), "1", "Number of the update"),
    _TICK._replace(description="Tick of the updating instant t_i"),
    _TIME._replace(description="Plant time of the updating instant t_i"),
    _TAU_U,
    *(
        Column(name, pa.float32() if field.kind.label == "float32" else pa.int32(), field.unit or "1",
               field.description, Verdict if name == "verdict" else None)
        for name, field in _UPDATE.items() if name not in ("update", "tick", "tau_u")
    ),
)  # fmt: skip

EVENTS: Final = (
    Column("service", pa.string(), "", "Whose journal: control_plc or plant"),
    Column("number", pa.int64(), "1", _EVENT["number"].description),
    Column("boot", pa.int32(), "1", _EVENT["boot"].description),
    Column("utc", pa.string(), "", "UTC, ISO 8601 with milliseconds"),
    _TICK,
    _TIME,
    Column("kind", pa.string(), "", "What happened: mode, alarm raised, setpoint, ..."),
    Column("subject", pa.string(), "", "The new mode, the alarm, the input, ...: depends on the kind"),
    Column("cause", pa.string(), "", "Why; empty when there is no cause"),
    Column("value", pa.float32(), "", "A value; null when the kind has none"),
    Column("unit", pa.string(), "", "Unit of the value; empty when it has none"),
    Column("who", pa.string(), "", "Client that made the request: address, role, certificate; empty if there is none"),
)

FILES: Final = {
    "trace.parquet": (f"One row a tick of {TICK_UNIT}", TRACE),
    "updates.parquet": ("One row an update that no load step cut off; `verdict` says whether it was played", UPDATES),
    "events.parquet": ("One row an event of the journals: modes, alarms, commands", EVENTS),
}

_STATION: Final = PLANT_MAP.block_of(StationSample).fields
STATION: Final = (
    _TICK,
    _TIME,
    *(
        Column(name, pa.float32(), unit, _STATION["signals"].description)
        for name, unit in zip(STATION_SIGNAL_NAMES, STATION_SIGNAL_UNITS, strict=True)
    ),
    Column("mode", pa.int32(), "1", _STATION["mode"].description, StationMode),
    Column("alarms", pa.int32(), "1", _STATION["alarms"].description),
)
STATION_FILE: Final = "station.parquet"
STATION_FILES: Final = {
    STATION_FILE: ("One row a tick: compression station and nitrogen; only where the plant is a refrigerator", STATION)
}
ALL_FILES: Final = {**FILES, **STATION_FILES}


def arrow_schema(columns: Sequence[Column]) -> pa.Schema:
    """Return the Arrow schema of a file."""
    return pa.schema([column.field for column in columns], metadata={"coldloop_format": str(FORMAT)})


def schema_document(*, station: bool = False) -> dict[str, Any]:
    """Return the content of `schema.json`; with the station's file where there is one."""
    files = ALL_FILES if station else FILES
    return {
        "format": FORMAT,
        "files": {
            name: {"description": description, "columns": [_described(column) for column in columns]}
            for name, (description, columns) in files.items()
        },
    }


def _described(column: Column) -> dict[str, Any]:
    text: dict[str, Any] = {
        "name": column.name, "type": str(column.kind), "unit": column.unit, "description": column.description,
    }  # fmt: skip
    if column.values is not None:
        text["values"] = {str(value.value): value.name for value in column.values}
    return text
