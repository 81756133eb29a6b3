"""Trace and events of a run under chaos, in the columns of an ordinary run."""

from functools import partial
from pathlib import Path

import pyarrow.parquet as pq

from rig.chaos.trace import ChaosTrace
from rig.columns import schema_document
from rig.driving import CONTROL, DrivingHistory
from rig.indicators import StageCost
from rig.results import whole_file, write_json
from rig.tables import events_table, trace_table


def write_tables(folder: Path, trace: ChaosTrace, cost: StageCost) -> None:
    """Write trace.parquet, in which ticks that nobody saw are NaN, events.parquet and schema.json.

    What the optimiser did is not read: those columns are null.

    Raises:
        OSError: A file cannot be written.
    """
    events = [(CONTROL, event) for event in trace.events]
    driving = DrivingHistory()
    for service, event in events:
        driving.event(service, event)
    tables = {
        "trace.parquet": trace_table(trace.recording().block, [], cost, driving),
        "events.parquet": events_table(events),
    }
    for name, table in tables.items():
        whole_file(folder / name, partial(pq.write_table, table, compression="zstd"))
    write_json(folder / "schema.json", schema_document())
