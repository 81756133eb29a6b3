"""Folders of runs: how they are made, found and read, and exported as CSV, MATLAB or HDF5."""

import contextlib
import json
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import cached_property, partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from coldloop.errors import ResultsError, UsageError, printable
from coldloop.process import declaration, model_file, updating_periods
from coldloop.registers.control_plc import Mode
from coldloop.text import held_file, parsed_json, read_text, whole_file, whole_text
from coldloop_rig.results.columns import EVENTS, FILES, FORMAT, STATION, TRACE, files_of, numbers_of

try:
    import fcntl
except ImportError:  # Windows: two runs may share a folder
    fcntl = None  # type: ignore[assignment]


_LOCKED: Final[dict[tuple[int, int], int]] = {}
"""Descriptors of the folders that this process has claimed, by device and inode; they are held to its end."""


def claim_folder(folder: Path, *, force: bool) -> None:
    """Make the folder of a run, new or empty unless `force` is set, and keep other processes from it to our end.

    Raises UsageError: it has files in it, it cannot be written to, or another process has claimed it.
    """
    if not str(folder).isprintable():
        raise UsageError(f"{str(folder)!a}: a name that cannot be printed; choose another --out")
    try:
        taken = not force and folder.is_dir() and any(folder.iterdir())
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; choose another --out") from None
    if taken:
        raise UsageError(f"{folder}: the folder is not empty; name another one with --out, or overwrite with --force")
    prepare_folder(folder)
    if fcntl is None:
        return
    with contextlib.ExitStack() as unlocked:
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        unlocked.callback(os.close, descriptor)
        status = os.fstat(descriptor)
        key = status.st_dev, status.st_ino
        if key in _LOCKED:
            return
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"{folder}: another run is being written there; name another folder with --out") from None
        except OSError:  # a file system without locks
            return
        _LOCKED[key] = descriptor
        unlocked.pop_all()


def claim_folder_of_now(parent: Path, name: str) -> Path:
    """Make and return a folder named after what is run and when. Raises UsageError: it cannot be written to."""
    prepare_folder(parent)
    of_now = f"{name}-{datetime.now():%Y%m%d-%H%M%S}"  # noqa: DTZ005 the user's clock
    folder = parent / of_now
    for number in count(2):
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            break
        folder = parent / f"{of_now}-{number}"
    return folder


def prepare_folder(folder: Path) -> None:
    """Make the folder of a run. Raises UsageError if it cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; choose a folder that can be written to with --out") from None


@contextlib.contextmanager
def writing(place: Path, remedy: str = "choose another --out") -> Iterator[None]:
    """Have files written in this context. Raises ResultsError, in a line: one cannot be written."""
    try:
        yield
    except OSError as error:
        raise ResultsError(f"{place}: {error.strerror or error}; {remedy}") from None


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON document."""
    whole_text(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def installed_version(name: str) -> str:
    """Return the version of a package, or that it is absent."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


Curves = dict[str, NDArray[np.float64]]
"""Columns by name; null is NaN."""

OLDER: Final[dict[str, Any]] = {
    "optimizer_plc.program.adaptive.rule": "algorithm-1",
    "optimizer_plc.program.estimator.disturbances": [],
    "optimizer_plc.program.cold_end.approach_k": 0.0,
    "optimizer_plc.program.design.band_margin": [0.0, 0.0],
    "optimizer_plc.program.plausibility.sigmas": 0.0,
}
"""Configuration of runs that were recorded before there was a key: what the preset would decide now."""
ADAPTIVE: Final = "optimizer_plc.program.adaptive."
GONE: Final = frozenset(
    f"{ADAPTIVE}contraction.{name}" for name in ("q_busy", "q_quiet", "q_step", "rate", "memory", "surprise")
)
"""Settings of a rule that was replaced, which are in the manifests of runs that did not use it, too."""
TAU_U: Final = "tau_u_s"
DRAWN_TICKS: Final = 60_000  # a longer trace is drawn by the least and the largest value of many ticks
BANDS: Final = ("optimizer_plc.program.design.output_low", "optimizer_plc.program.design.output_high")
BOUNDS: Final = ("limits.low", "limits.high")  # keys that have a number for each output with a band, and for each input
ENDED: Final = "name the folder of a run that has ended"
MOST_BYTES: Final = 2**24
"""Largest size of a JSON document."""
MOST_COLUMNS: Final = 2000
MOST_TEXT: Final = 4096  # bytes of a text in a table
ROW_BYTES: Final = 4096  # largest average size of a row before compression; a file may have `SPARE_BYTES` more
SPARE_BYTES: Final = 2**20
MOST_IN_MEMORY: Final = 2_000_000
"""Rows of a file that is read as a whole: 139 h of ticks."""
MOST_LISTED: Final = 500_000
"""Rows of a file of which each becomes an object of Python: events and updates."""
Ticks = Annotated[int, Field(ge=0, le=updating_periods.LONGEST_TICKS)]


class _Part(BaseModel, extra="allow", strict=True):
    """A part of a manifest, with what those who read it count on."""


class _Hashes(_Part):
    configuration_sha256: str
    model_sha256: str
    trace_sha256: str | None


class _Input(_Part):
    """A file that a run has read, or what took its place."""

    source: str
    file: str | None
    sha256: str = ""
    profile_sha256: str = ""


class _Inputs(_Part, extra="forbid"):
    load: _Input
    model: _Input
    refrigerator: _Input | None = None


class _Configured(_Part):
    """Keys that a figure of any run shows."""

    load: str = Field(alias="plant.load")
    driver: str = Field(alias="control_plc.driver")
    period: float | None = Field(alias="optimizer_plc.program.updating_period_s")
    solver: str = Field(alias="optimizer_plc.program.solver")
    outside: str | None = Field(alias="optimizer_plc.program.outside.solver", default=None)
    band_low: list[FiniteFloat] = Field(alias="optimizer_plc.program.design.output_low")
    band_high: list[FiniteFloat] = Field(alias="optimizer_plc.program.design.output_high")
    low: list[FiniteFloat] = Field(alias="limits.low")
    high: list[FiniteFloat] = Field(alias="limits.high")


class _Manifest(_Part):
    complete: bool
    reason: str | None
    started_utc: str
    coldloop: str
    python: str
    platform: str
    dependencies: dict[str, str]
    way: str
    ticks: Ticks
    recorded_ticks: Ticks
    configuration: _Configured
    inputs: _Inputs
    hashes: _Hashes


class RunFolder:
    """Results on disk. Raises UsageError: there are none, or they are of another version, or damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.manifest = self._document("manifest.json")
        if self.manifest.get("format") != FORMAT:
            raise UsageError(f"{path}: results of another version of Coldloop; this one reads format {FORMAT}")
        try:
            _Manifest.model_validate(self.manifest)
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise UsageError(f"{path / 'manifest.json'}: {place}: {first['msg']}; it has been changed") from None

    def _document(self, name: str) -> dict[str, Any]:
        try:
            document: dict[str, Any] = parsed_json(read_text(self.held(name), ENDED, most=MOST_BYTES))
        except ValueError as error:
            raise UsageError(f"{self.path / name}: {error}; {ENDED}") from None
        if not isinstance(document, dict):
            raise UsageError(f"{self.path / name}: not an object; {ENDED}")
        return document

    def held(self, name: str) -> Path:
        """Return the path of a regular file in the folder, as `held_file` does."""
        return held_file(self.path, name, ENDED)

    @property
    def summary(self) -> dict[str, Any]:
        """The summary."""
        return self._document("summary.json")

    @property
    def configuration(self) -> dict[str, Any]:
        """The configuration by dotted key; of an older run with what held then."""
        configured: dict[str, Any] = OLDER | self.manifest["configuration"]
        if configured.get(f"{ADAPTIVE}rule") == "contraction":
            return configured
        return {key: value for key, value in configured.items() if key not in GONE}

    def file(self, name: str, most: int = updating_periods.LONGEST_TICKS) -> pq.ParquetFile:
        """Return a Parquet file of the run, of `most` rows at most, after a look at its footer and at its texts.

        Raises UsageError: it cannot be read, or is larger than a run of so many ticks makes it, or has other types.
        """
        path, kinds = self.held(name), {one.name: one.kind for one in files_of(self.process)[name].columns}
        try:
            file = pq.ParquetFile(path)
            wrong = self._excess(name, file.metadata, most)
            for field in () if wrong else file.schema_arrow:
                if field.type not in ({kinds[field.name]} if field.name in kinds else {*kinds.values()}):
                    wrong = f"{printable(field.name[:MOST_TEXT])} is {str(field.type)[:80]}"
                    break
            if not wrong and _has_long_text(path, file.schema_arrow):
                wrong = f"a text of more than {MOST_TEXT} bytes"
        except (OSError, pa.ArrowException) as error:
            wrong = str(error).splitlines()[0]
        if wrong:
            raise UsageError(f"{path}: damaged, or of something else: {wrong}")
        return file

    def _excess(self, name: str, footer: pq.FileMetaData, most: int) -> str:
        rows, ticks = footer.num_rows, self.manifest["recorded_ticks"]
        size = sum(footer.row_group(group).total_byte_size for group in range(footer.num_row_groups))
        if name != EVENTS and rows > ticks:
            return f"{rows} rows, and manifest.json says {ticks} ticks"
        if not rows and name == TRACE:
            return "no rows"
        if rows > most:
            return f"{rows} rows; {most} at most are read into memory"
        if footer.num_columns > MOST_COLUMNS or size > SPARE_BYTES + ROW_BYTES * rows:
            return f"{footer.num_columns} columns of {size} bytes in {rows} rows"
        return ""

    @cached_property
    def process(self) -> declaration.Process:
        """The process that was run. Raises UsageError: its declaration is none that this version makes."""
        place = f"{self.path / str(self.manifest['inputs']['model']['file'])}: process"
        return model_file.process_in(
            self.model.get("process", {}), place, "use the version of Coldloop that made this run"
        )

    @property
    def model(self) -> dict[str, Any]:
        """The copy of its model file; empty where there is none, as of the cold box that is shipped."""
        place: str | None = self.manifest["inputs"]["model"]["file"]
        return model_file.read_document(self.held(place), "restore it") if place else {}

    @contextmanager
    def reading(self, name: str, most: int = updating_periods.LONGEST_TICKS) -> Iterator[pq.ParquetFile]:
        """Open a Parquet file of the run. Raises UsageError, in a line: it cannot be read, or has other columns."""
        try:
            with self.file(name, most) as file:
                yield file
        except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise UsageError(f"{self.path / name}: damaged, or of something else: {reason}") from None

    def series(self, columns: Sequence[str], longest: int = DRAWN_TICKS, file_name: str = TRACE) -> Curves:
        """Return columns of the trace, or of another file with a row a tick, for drawing, in constant memory.

        They are `time_s` and those named. The updating period is NaN in other modes than MPC, where it is not in force.
        A trace of more than `longest` ticks is reduced to two points for each of `longest / 2` intervals.
        """
        names = ["time_s", *columns]
        with self.reading(file_name) as file:
            every = max(1, math.ceil(file.metadata.num_rows / (longest / 2))) if file.metadata.num_rows > longest else 1
            batches = file.iter_batches(batch_size=every * 4096, columns=[*names, "mode"] if TAU_U in names else names)
            parts = []
            for part in (_in_force(batch, names) for batch in batches):
                if every > 1:  # the least and the largest value of each interval
                    starts = np.arange(0, len(part["time_s"]), every)
                    for name, values in part.items():
                        ends = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
                        part[name] = np.column_stack(ends).ravel()
                parts.append(part)
            series = {name: np.concatenate([part[name] for part in parts] or [np.empty(0)]) for name in names}
            if not np.isfinite(series["time_s"]).all() or (np.diff(series["time_s"]) < 0).any():
                raise ValueError("time_s does not rise")
        for keys, signals in ((BANDS, self.process.banded), (BOUNDS, self.process.inputs)):
            for key in keys:
                if len(self.configuration[key]) != len(signals):
                    raise UsageError(f"{self.path / 'manifest.json'}: {key} is not of {len(signals)} numbers")
        return series

    def events(self) -> list[dict[str, Any]]:
        """Return the events."""
        with self.reading(EVENTS, MOST_LISTED) as file:
            table = file.read(columns=[column.name for column in files_of(self.process)[EVENTS].columns])
            missing = [name for name in table.column_names if name != "value" and table[name].null_count]
            if missing:
                raise ValueError(f"{missing[0]} is missing in a row")
            rows: list[dict[str, Any]] = table.to_pylist()
        return rows


def _has_long_text(path: Path, schema: pa.Schema) -> bool:
    """Return whether a text is too long; a few bytes may stand for the same long text in millions of rows."""
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        return any(
            len(column.dictionary) and pc.max(pc.binary_length(column.dictionary)).as_py() > MOST_TEXT
            for batch in file.iter_batches(columns=texts) for column in batch.columns
        )  # fmt: skip


def _in_force(batch: pa.RecordBatch, names: Sequence[str]) -> Curves:
    """Return columns as numbers; the updating period only where MPC was active, or the mode is not known."""
    series = batch_series(batch.select(names))
    if TAU_U in series:
        is_mpc = pc.fill_null(pc.equal(batch["mode"], Mode.MPC.word), fill_value=True)
        series[TAU_U] = np.where(is_mpc.to_numpy(zero_copy_only=False), series[TAU_U], np.nan)
    return series


def batch_series(batch: pa.RecordBatch) -> Curves:
    """Return the columns of a batch as numbers."""
    return {name: numbers_of(batch[name]) for name in batch.schema.names}


def export(run: Path, kind: str, out: Path, *, force: bool) -> list[Path]:
    """Write a run as `csv`, `mat` or `hdf5` into a folder; return the files.

    Raises UsageError: there is no run, a file exists, or h5py is not installed; ResultsError: a file cannot be written.
    """
    folder = RunFolder(run)
    paths = {out / name: write for name, write in _WRITERS[kind](folder).items()}
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


Writers = dict[str, Callable[[Path], object]]  # functions that write a file, by the file's name
ABOUT: Final = ("complete", "started_utc", "coldloop", "way")
"""Keys of the manifest that a MATLAB or HDF5 file has, too."""


def _tables(run: RunFolder, most: int = updating_periods.LONGEST_TICKS) -> dict[str, pq.ParquetFile]:
    present = [name for name in FILES if name != STATION or (run.path / name).exists()]
    return {name.removesuffix(".parquet"): run.file(name, most) for name in present}


def _csv(run: RunFolder) -> Writers:
    """Return writers of CSV files: a header of names with units follows `schema.json`, null is an empty field."""

    def write(file: pq.ParquetFile, path: Path) -> None:
        with pyarrow.csv.CSVWriter(path, file.schema_arrow) as target:
            for batch in file.iter_batches():
                target.write_batch(batch)

    return {f"{name}.csv": partial(write, file) for name, file in _tables(run).items()}


def _mat(run: RunFolder) -> Writers:
    """Return the writer of a MATLAB file, version 5: structures `trace`, `updates`, `events`, `units`, `run`."""
    from scipy.io import savemat  # noqa: PLC0415 only MATLAB needs it

    def shown(column: pa.ChunkedArray) -> Any:  # noqa: ANN401 an array of numbers, null is NaN, or of texts
        is_text = pa.types.is_string(column.type)
        return np.array(column.fill_null("").to_pylist(), dtype=object) if is_text else column.to_numpy()

    def write(path: Path) -> None:
        tables = {name: file.read() for name, file in _tables(run, MOST_IN_MEMORY).items()}
        content: dict[str, Any] = {}
        for name, table in tables.items():
            content[name] = {column: shown(table[column]) for column in table.column_names}
        content["units"] = {name: units_of(table.schema) for name, table in tables.items()}
        content["run"] = {name: run.manifest[name] for name in ABOUT}
        with path.open("wb") as file:
            savemat(file, content, do_compression=True, long_field_names=True, oned_as="column")

    return {"run.mat": write}


def _hdf5(run: RunFolder) -> Writers:
    """Return the writer of an HDF5 file: a group a table, a dataset a column, with unit and description."""
    try:
        h5py = import_module("h5py")
    except ImportError:
        raise UsageError("--hdf5 needs h5py: install it with pip install 'coldloop[hdf5]'") from None

    def write(path: Path) -> None:
        with h5py.File(path, "w") as target:
            for name in ABOUT:
                target.attrs[name] = run.manifest[name]
            for name, file in _tables(run).items():
                for field in file.schema_arrow:
                    fill(target.require_group(name), file, field)

    def fill(group: Any, file: pq.ParquetFile, field: pa.Field) -> None:  # noqa: ANN401 h5py has no types
        kind = h5py.string_dtype() if (is_text := pa.types.is_string(field.type)) else field.type.to_pandas_dtype()
        if field.name in ("update", "iterations"):  # whole numbers that may be missing become numbers with NaN
            kind = np.float64
        dataset, first = group.create_dataset(field.name, shape=(file.metadata.num_rows,), dtype=kind), 0
        for key in ("unit", "description"):
            dataset.attrs[key] = field.metadata[key.encode()].decode()
        for batch in file.iter_batches(columns=[field.name]):
            values = batch[field.name].fill_null("") if is_text else batch[field.name]
            dataset[first : first + len(values)] = values.to_numpy(zero_copy_only=False)
            first += len(values)

    return {"run.h5": write}


def units_of(schema: pa.Schema) -> dict[str, str]:
    """Return the unit of each column."""
    return {field.name: field.metadata[b"unit"].decode() for field in schema}


_WRITERS: Final = {"csv": _csv, "mat": _mat, "hdf5": _hdf5}
