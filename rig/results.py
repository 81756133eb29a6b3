"""The files of a run: manifest, trace, updates, summary. Each appears whole or not at all."""

import json
import platform
import sys
import tempfile
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from coldloop import __version__
from coldloop.errors import UsageError
from coldloop.process import (
    INPUT_NAMES,
    INPUT_UNITS,
    OUTPUT_NAMES,
    OUTPUT_UNITS,
    STATE_NAMES,
    STATE_UNITS,
    TICK_S,
)
from coldloop.registers.optimizer_plc import Optimization
from rig.recording import Recording

DEPENDENCIES = ("numpy", "scipy", "numba", "pymodbus", "pydantic", "aiomqtt", "osqp", "pyarrow", "matplotlib")


def prepare_folder(folder: Path) -> None:
    """Make the folder of a run.

    Raises:
        UsageError: It cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; choose a folder that can be written to with --out") from None


def whole_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make the file under another name, then give it its own."""
    draft = path.with_name(f".{path.name}.draft")
    try:
        write(draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON document."""
    text = json.dumps(content, indent=2, ensure_ascii=False) + "\n"
    whole_file(path, lambda draft: draft.write_text(text, encoding="utf-8"))


def manifest(
    configuration: Mapping[str, Any], arguments: Mapping[str, Any], hashes: Mapping[str, str]
) -> dict[str, Any]:
    """Return what is needed to repeat a run."""
    return {
        "coldloop": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "dependencies": {name: installed_version(name) for name in DEPENDENCIES},
        "command": sys.argv[1:],
        "arguments": dict(arguments),
        "configuration": dict(configuration),
        "hashes": dict(hashes),
    }


def write_trace(path: Path, recording: Recording) -> None:
    """Write one row a tick: time, load, inputs, outputs, states, and what the optimiser was doing."""
    ticks = len(recording.load)
    columns: list[tuple[str, str, Any]] = [
        ("time", "s", np.arange(ticks) * TICK_S),
        ("load", "W", recording.load),
        *zip(INPUT_NAMES, INPUT_UNITS, recording.u.T, strict=True),
        *zip(OUTPUT_NAMES, OUTPUT_UNITS, recording.y.T, strict=True),
        *((f"x.{name}", unit, x) for name, unit, x in zip(STATE_NAMES, STATE_UNITS, recording.x.T, strict=True)),
        *_held(recording, ticks),
    ]
    fields = [pa.field(name, pa.array(data).type, metadata={"unit": unit}) for name, unit, data in columns]
    table = pa.Table.from_arrays([pa.array(data) for *_, data in columns], schema=pa.schema(fields))
    whole_file(path, lambda draft: pq.write_table(table, draft, compression="zstd"))


def _held(recording: Recording, ticks: int) -> list[tuple[str, str, Any]]:
    """Return the columns that change at updating instants only."""
    update = np.zeros(ticks, dtype=np.int32)
    tau_u, iterations, cost = np.zeros(ticks), np.zeros(ticks, dtype=np.int32), np.zeros(ticks)
    ends = [later.tick for later in recording.updates[1:]] + [ticks]
    for row, end in zip(recording.updates, ends, strict=False):
        here = slice(row.tick, max(row.tick + row.tau_u, end))  # what a load step cut off belongs to the one before
        update[here], tau_u[here], iterations[here] = row.update, row.tau_u * TICK_S, row.iterations
        cost[here] = row.j_effective
    return [("update", "1", update), ("tau_u", "s", tau_u), ("iterations", "1", iterations), ("J", "1", cost)]


def write_updates(path: Path, recording: Recording) -> None:
    """Write one row an update, the columns of the optimiser's history block."""
    data = {name: [getattr(row, name) for row in recording.updates] for name in Optimization._fields}
    table = pa.table(data)
    whole_file(path, lambda draft: pq.write_table(table, draft, compression="zstd"))


def installed_version(name: str) -> str:
    """Return the version of a package, or that it is absent."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
