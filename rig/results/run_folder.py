"""A folder that a run has left behind, and how it is read."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from coldloop.errors import UsageError
from coldloop.parsing import parsed_json
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.declaration import Process
from coldloop.process.loaded import PROCESS
from coldloop.process.model_file import read_document
from coldloop.registers.control_plc import Mode
from coldloop.service.event_text import word
from rig.results.arrow_arrays import numbers_of
from rig.results.columns import FORMAT

Curves = dict[str, NDArray[np.float64]]
"""Columns by name; what is null is NaN."""

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
DRAWN_TICKS: Final = 60_000
"""A longer trace is drawn by the least and the largest value of many ticks."""


class _Hashes(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)

    configuration_sha256: str
    model_sha256: str
    trace_sha256: str | None


class _Manifest(BaseModel):
    """What all who read a manifest count on."""

    model_config = ConfigDict(extra="allow", strict=True)

    complete: bool
    reason: str | None
    started_utc: str
    coldloop: str
    python: str
    platform: str
    dependencies: dict[str, str]
    way: str
    ticks: int
    recorded_ticks: int
    configuration: dict[str, Any]
    inputs: dict[str, dict[str, Any]]
    hashes: _Hashes


class RunFolder:
    """Results on disk, of the present format.

    Raises:
        UsageError: There are none, or they are of another version, or damaged.
    """

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
            document: dict[str, Any] = parsed_json((self.path / name).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise UsageError(f"{self.path / name}: {reason}; name the folder of a run that has ended") from None
        if not isinstance(document, dict):
            raise UsageError(f"{self.path / name}: not an object; name the folder of a run that has ended")
        return document

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

    def file(self, name: str) -> pq.ParquetFile:
        """Return a Parquet file of the run.

        Raises:
            UsageError: It cannot be read.
        """
        try:
            return pq.ParquetFile(self.path / name)
        except (OSError, pa.ArrowException) as error:
            raise UsageError(f"{self.path / name}: {str(error).splitlines()[0]}") from None

    @property
    def process(self) -> Process:
        """The process that was run, as it was then.

        Raises:
            UsageError: Its declaration is none that this version makes.
        """
        try:
            return Process.of(self._process) if self._process else COLD_BOX
        except (KeyError, TypeError, ValueError) as error:
            raise UsageError(
                f"{self.path / str(self._model)}: process: {error}; use the version of Coldloop that made this run"
            ) from None

    @property
    def remedy(self) -> str:
        """What to do where it is not the one that is loaded."""
        if not self._process:
            return "leave out --process"
        return "name its file with --process; rerun --trust executes the plant that the folder holds"

    @property
    def model_digest(self) -> str | None:
        """Digest of the copy of its model; None for the shipped one of the cold box."""
        return self._document_of_model.get("digest")

    @property
    def _process(self) -> dict[str, Any]:
        """Declaration of the process, from the copy of its model; empty for the cold box."""
        found: dict[str, Any] = self._document_of_model.get("process", {})
        return found

    @property
    def _document_of_model(self) -> dict[str, Any]:
        return read_document(self.path / self._model, "restore it") if self._model else {}

    @property
    def _model(self) -> str | None:
        """Place of the copy of its model; None for the shipped one of the cold box."""
        place: str | None = self.manifest["inputs"].get("model", {}).get("file")
        return place

    @contextmanager
    def reading(self, name: str) -> Iterator[pq.ParquetFile]:
        """Open a Parquet file of the run; a damaged one is a one-line error.

        Raises:
            UsageError: It cannot be read, or has other columns.
        """
        try:
            with self.file(name) as file:
                yield file
        except (OSError, pa.ArrowException, KeyError) as error:
            if self.process.name != PROCESS.name:
                raise UsageError(
                    f"{self.path}: a run of {self.process.name}, and not of {PROCESS.name}; {self.remedy}"
                ) from None
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise UsageError(f"{self.path / name}: damaged, or of something else: {reason}") from None

    def series(self, columns: Sequence[str], longest: int = DRAWN_TICKS, file_name: str = "trace.parquet") -> Curves:
        """Return columns of the trace, or of another file with a row a tick, for drawing: `time_s` and these.

        It takes constant memory.

        The updating period is drawn while it was in force: in other modes than MPC it is NaN.

        A trace of more than `longest` ticks is reduced to two points for each of `longest / 2` intervals.
        """
        names = ["time_s", *columns]
        with self.reading(file_name) as file:
            every = max(1, math.ceil(file.metadata.num_rows / (longest / 2))) if file.metadata.num_rows > longest else 1
            batches = file.iter_batches(batch_size=every * 4096, columns=[*names, "mode"] if TAU_U in names else names)
            parts = [_reduced(_in_force(batch, names), every) for batch in batches]
            return {name: np.concatenate([part[name] for part in parts] or [np.empty(0)]) for name in names}

    def events(self) -> list[dict[str, Any]]:
        """Return the events."""
        with self.reading("events.parquet") as file:
            rows: list[dict[str, Any]] = file.read().to_pylist()
        return rows


def _in_force(batch: pa.RecordBatch, names: Sequence[str]) -> Curves:
    """Return columns as numbers; the updating period only where MPC was active, or the mode is not known."""
    series = batch_series(batch.select(names))
    if TAU_U in series:
        is_mpc = pc.fill_null(pc.equal(batch["mode"], word(Mode.MPC)), fill_value=True)
        series[TAU_U] = np.where(is_mpc.to_numpy(zero_copy_only=False), series[TAU_U], np.nan)
    return series


def batch_series(batch: pa.RecordBatch) -> Curves:
    """Return the columns of a batch as numbers."""
    return {name: numbers_of(batch[name]) for name in batch.schema.names}


def _reduced(series: Curves, every: int) -> Curves:
    """Return for each interval of so many ticks the least and the largest value of each column."""
    if every == 1:
        return series
    starts = np.arange(0, len(series["time_s"]), every)
    reduced: Curves = {}
    for name, values in series.items():
        pair = [np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)]
        reduced[name] = np.stack(pair, axis=1).ravel()
    return reduced
