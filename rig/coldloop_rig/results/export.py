"""A recorded run in other formats. CSV and HDF5 are written in constant memory."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from coldloop.errors import UsageError
from coldloop.whole_file import whole_file
from coldloop_rig.durations import LONGEST_TICKS
from coldloop_rig.results.columns import FILES, STATION
from coldloop_rig.results.folders import prepare_folder, writing
from coldloop_rig.results.run_folder import MOST_IN_MEMORY, RunFolder

Tables = dict[str, pq.ParquetFile]
"""Files of a run by the name of their table."""


def export(run: Path, kind: str, out: Path, *, force: bool) -> list[Path]:
    """Write a run as `csv`, `mat` or `hdf5` into a folder; return the files.

    Raises:
        UsageError: There is no run, a file exists, or h5py is not installed.
        ResultsError: A file cannot be written.
    """
    folder = RunFolder(run)
    writers = _WRITERS[kind](folder)
    paths = {out / name: write for name, write in writers.items()}
    for path in paths:
        if path.exists() and not force:
            raise UsageError(f"{path}: exists; name another folder with --out, or overwrite with --force")
    prepare_folder(out)
    for path, write in paths.items():
        try:
            with writing(path):
                whole_file(path, write)
        except (pa.ArrowException, KeyError, TypeError, ValueError) as error:
            raise UsageError(f"{folder.path}: a damaged file: {str(error).splitlines()[0]}") from None
    return list(paths)


Writers = dict[str, Callable[[Path], object]]
"""What writes a file, by the file's name."""


def _tables(run: RunFolder, most: int = LONGEST_TICKS) -> Tables:
    present = [name for name in FILES if name != STATION or (run.path / name).exists()]
    return {name.removesuffix(".parquet"): run.file(name, most) for name in present}


def _csv(run: RunFolder) -> Writers:
    """Return writers of CSV files: a header of names with units follows `schema.json`, null is an empty field."""

    def writer(file: pq.ParquetFile) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            with pyarrow.csv.CSVWriter(path, file.schema_arrow) as target:
                for batch in file.iter_batches():
                    target.write_batch(batch)

        return write

    return {f"{name}.csv": writer(file) for name, file in _tables(run).items()}


def _mat(run: RunFolder) -> Writers:
    """Return the writer of a MATLAB file, version 5: structures `trace`, `updates`, `events`, `units`, `run`."""
    from scipy.io import savemat  # noqa: PLC0415 only MATLAB needs it

    def write(path: Path) -> None:
        tables = {name: file.read() for name, file in _tables(run, MOST_IN_MEMORY).items()}
        content: dict[str, Any] = {
            name: {column: _for_matlab(table[column]) for column in table.column_names}
            for name, table in tables.items()
        }
        content["units"] = {name: _units(table.schema) for name, table in tables.items()}
        content["run"] = {name: run.manifest[name] for name in ("complete", "started_utc", "coldloop", "way")}
        with path.open("wb") as file:
            savemat(file, content, do_compression=True, long_field_names=True, oned_as="column")

    return {"run.mat": write}


def _for_matlab(column: pa.ChunkedArray) -> Any:  # noqa: ANN401 an array of numbers or of texts
    if pa.types.is_string(column.type):
        return np.array(column.fill_null("").to_pylist(), dtype=object)
    return column.to_numpy()  # null becomes NaN


def _hdf5(run: RunFolder) -> Writers:
    """Return the writer of an HDF5 file: a group a table, a dataset a column, with unit and description."""
    try:
        h5py = import_module("h5py")
    except ImportError:
        raise UsageError("--hdf5 needs h5py: install it with pip install 'coldloop[hdf5]'") from None

    def write(path: Path) -> None:
        with h5py.File(path, "w") as target:
            for name in ("complete", "started_utc", "coldloop", "way"):
                target.attrs[name] = run.manifest[name]
            for name, file in _tables(run).items():
                _fill(h5py, target.create_group(name), file)

    return {"run.h5": write}


def _fill(h5py: Any, group: Any, file: pq.ParquetFile) -> None:  # noqa: ANN401 h5py has no types
    schema, rows = file.schema_arrow, file.metadata.num_rows
    for field in schema:
        kind = h5py.string_dtype() if pa.types.is_string(field.type) else _hdf5_type(field)
        dataset = group.create_dataset(field.name, shape=(rows,), dtype=kind)
        dataset.attrs["unit"] = field.metadata[b"unit"].decode()
        dataset.attrs["description"] = field.metadata[b"description"].decode()
    first = 0
    for batch in file.iter_batches():
        for field in schema:
            values = batch[field.name]
            column = (values.fill_null("") if pa.types.is_string(field.type) else values).to_numpy(zero_copy_only=False)
            group[field.name][first : first + len(column)] = column
        first += batch.num_rows


def _hdf5_type(field: pa.Field) -> Any:  # noqa: ANN401 a numpy type
    """Return the type of a dataset: whole numbers that may be missing become numbers with NaN."""
    nullable = field.name in ("update", "iterations")
    return np.float64 if nullable else field.type.to_pandas_dtype()


def _units(schema: pa.Schema) -> dict[str, str]:
    return {field.name: field.metadata[b"unit"].decode() for field in schema}


_WRITERS: Final = {"csv": _csv, "mat": _mat, "hdf5": _hdf5}
