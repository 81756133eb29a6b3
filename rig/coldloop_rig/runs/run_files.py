"""The files of a run: written during the run, and completed with its result or the reason of its failure."""

import contextlib
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from coldloop.config import Configuration
from coldloop.errors import ColdloopError, ResultsError, UsageError
from coldloop.process.lti_model import load as load_model
from coldloop_plant.settings import PlantKind
from coldloop_rig.cosim.scenario import INPUTS, Scenario
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.results.columns import FILES, schema_document
from coldloop_rig.results.disk_reserve import DiskReserve
from coldloop_rig.results.file_sinks import EventsSink, StationSink, TraceSink, UpdatesSink
from coldloop_rig.results.folders import write_json
from coldloop_rig.results.indicators import RunEvaluation, StageCost
from coldloop_rig.results.recording import Recorder, Sink
from coldloop_rig.runs.inputs import copy_inputs
from coldloop_rig.runs.manifest import final_manifest, first_manifest
from coldloop_rig.settings import Settings

NAMES: Final = (
    "manifest.json", "summary.json", "schema.json", *FILES, "run.png", "run.pdf", "run.svg",
    "chaos.json", "chaos.md", "chaos.png",
    "report.html", "run.mat", "run.h5", *(f"{Path(name).stem}.csv" for name in FILES),
)  # fmt: skip
"""Files of an earlier run, and what was made of them, which a new one in the same folder replaces."""


class RunFiles:
    """Opens the files of a run; `recorder` fills them, `finish` ends them.

    Args:
        folder: Folder that is claimed; an earlier run in it is replaced.
        effective: Configuration of the run.
        scenario: What is run.
        way: How the programs are connected.
        arguments: Options of the command.
        sinks: Further sinks of the recorder.

    Raises:
        UsageError: The disk is nearly full, or an input of the run lies in the folder.
        OSError: A file cannot be made.
    """

    def __init__(
        self, folder: Path, effective: Configuration[Settings], scenario: Scenario, way: str,
        arguments: Mapping[str, Any], sinks: Sequence[Sink],
    ) -> None:  # fmt: skip
        settings = effective.settings
        for file in (settings.model.file, Path(settings.plant.load)):
            if file.is_file() and file.resolve().is_relative_to((folder / INPUTS).resolve()):
                raise UsageError(f"{file}: the run replaces what is in {folder}; name another --out")
        model, design, process = (
            load_model(settings.model.file),
            settings.optimizer_plc.program.design,
            settings.process,
        )
        self.folder = folder
        self._evaluation = RunEvaluation(model, design)
        self._discard()
        self._reserve = DiskReserve(folder)
        self._realtime = scenario.realtime
        with contextlib.ExitStack() as failed:
            failed.callback(self._reserve.close)
            self._manifest = first_manifest(
                effective, scenario, copy_inputs(settings, scenario.load, folder), way, arguments
            )
            write_json(folder / "manifest.json", self._manifest)
            is_whole = settings.plant.kind is PlantKind.REFRIGERATOR
            write_json(folder / "schema.json", schema_document(process, station=is_whole))
            files = (
                TraceSink(folder, self._reserve, StageCost(model, design)),
                UpdatesSink(folder, self._reserve, process),
                EventsSink(folder, self._reserve, process),
                StationSink(folder, self._reserve, process),
            )
            failed.pop_all()
        self.recorder = Recorder(scenario.ticks, [self._evaluation, *files, *sinks])

    def finish(self, error: BaseException | None, figure: FigureProcess) -> dict[str, Any]:
        """Close the files, and write summary, manifest and figures of what was recorded; return the summary.

        Args:
            error: What ended the run early, if anything did.
            figure: Draws the figure.

        Raises:
            ColdloopError: The run is not complete.
        """
        try:
            self.recorder.close()
        except (OSError, ColdloopError) as of_files:
            error = error or of_files
        finally:
            self._reserve.close()
        recorded = self.recorder.next_tick
        if error is not None and not recorded:
            self._discard()
            with contextlib.suppress(OSError):
                self.folder.rmdir()  # it stays if it has logs
            raise _results_error(error, self.folder)
        reason = None if error is None else _reason(error)
        summary = summary_of(self._evaluation, self.recorder, realtime=self._realtime, reason=reason)
        manifest = final_manifest(self._manifest, reason, recorded, self._evaluation.trace_sha256)
        try:
            write_json(self.folder / "manifest.json", manifest)
            write_json(self.folder / "summary.json", summary)
            figure.draw(self.folder)
        except (OSError, ColdloopError) as of_files:
            error = error or of_files
        if error is not None:
            kept = f"{recorded} of {self.recorder.ticks} ticks are recorded in {self.folder}"
            raise _results_error(error, self.folder, kept)
        return summary

    def _discard(self) -> None:
        for name in NAMES:
            (self.folder / name).unlink(missing_ok=True)
        shutil.rmtree(self.folder / INPUTS, ignore_errors=True)


def summary_of(evaluation: RunEvaluation, recorder: Recorder, *, realtime: bool, reason: str | None) -> dict[str, Any]:
    """Return the summary of a run; without a reason it is complete. What does not exist is None.

    Nothing is late in lock-step, so that lateness exists in real time only.
    """
    wall_s, link = recorder.wall_seconds, recorder.link
    lateness = link._asdict() if realtime else dict.fromkeys(link._fields)
    figures = {
        "complete": reason is None,
        "reason": reason,
        "ticks": evaluation.ticks,
        "missing_ticks": recorder.missing_ticks,
        "updates": evaluation.updates,
        "failed_updates": evaluation.failed_updates,
        "trace_sha256": evaluation.trace_sha256,
        **evaluation.indicators.by_name,
        **evaluation.excesses,
        **lateness,
        "deadline_misses": link.deadline_misses,
        "wall_seconds": round(wall_s, 3),
        "realtime_factor": round(evaluation.ticks * evaluation.process.tick_s / wall_s, 2) if wall_s else None,
    }
    return {name: None if _missing(value) else value for name, value in figures.items()}


def _missing(value: object) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _reason(error: BaseException) -> str:
    if isinstance(error, ColdloopError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.strerror or error}"
    return f"{type(error).__name__}: {error}"


def _results_error(error: BaseException, folder: Path, kept: str = "") -> BaseException:
    """Return the error with what a user needs to know about the files."""
    if isinstance(error, OSError):
        error = ResultsError(f"{error.filename or folder}: {error.strerror or error}; choose another --out")
    if kept and isinstance(error, ColdloopError):
        error.args = (f"{error}; {kept}",)
    return error
