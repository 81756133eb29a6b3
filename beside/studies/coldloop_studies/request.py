"""One run of a study: request and outcome. Both travel between processes as plain data."""

import asyncio
import hashlib
import json
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import cached_property, lru_cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError, UsageError
from coldloop.kernels.reach import digest
from coldloop.process import cold_box, load_profile, lti_model
from coldloop.service.start import main as start_service
from coldloop.text import file_digest, parsed_json
from coldloop_optimizer_plc.solvers import make_solver
from coldloop_plant import kinds, own_plants
from coldloop_plant.settings import PlantKind
from coldloop_rig.cosim import networked_run, one_process, wiring
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Indicators, Recorder, Recording, StageCost, evaluate, has_no_answer
from coldloop_rig.results.run_folder import installed_version
from coldloop_rig.settings import Settings
from coldloop_studies.paired_run import harsh_run, paired_indicators, paired_run, problem_sequence
from coldloop_studies.settings import outside_digests, settings_of

Series = NDArray[np.float64]

PACKAGES_WITH_DATA = ("coldloop", "coldloop_plant", "coldloop_control_plc", "coldloop_optimizer_plc")
DATA_SUFFIXES = (".json", ".npz", ".csv")
T9 = [one.name for one in cold_box.COLD_BOX.outputs].index("T9")
DECISIVE = {"limits", "model", "session", "plant", "control_plc", "optimizer_plc"}
"""Sections of the configuration that a run reads."""
LIBRARIES = ("casadi", "clarabel", "daqp", "numba", "numpy", "osqp", "piqp", "qpalm")
UPDATE_COLUMNS = (
    "tick", "tau_u", "iterations", "j_effective", "j_hot_start", "j_delivered", "j_dev", "j_cst", "violation",
)  # fmt: skip


class Procedure(StrEnum):
    """Procedure of a run: the programs in a loop, or problems solved outside of it."""

    CONFIGURED = "configured"
    """The three programs, as they are configured."""
    PAIRED_PROBLEMS = "paired problems"
    """No loop: the configured solver solves the problems of a converged loop (`coldloop_studies.paired_run`)."""
    HARSH_PROBLEMS = "harsh problems"
    """Paired problems, of which only those with a guess far from the optimum count; all solvers begin at that guess."""
    LINEAR_PLANT = "linear plant"
    """The optimiser and the control PLC with the linear model for a plant (`LinearRig`)."""


class LinearRig(one_process.OneProcessRig):
    """Control PLC and optimiser PLC with a linear plant; its loop is not compiled.

    Raises:
        ConfigurationError: The plant is to differ from its model.
    """

    def __init__(self, settings: Settings) -> None:
        if settings.plant.kind is not PlantKind.COLD_BOX or settings.plant.mismatch != kinds.NO_MISMATCH:
            raise ConfigurationError("plant: the linear plant is a cold box without mismatch")
        super().__init__(settings, compiled=False)

    def _plant(self, load: load_profile.LoadProfile, seed: int) -> own_plants.LinearPlant:
        return own_plants.LinearPlant(
            lti_model.load(self._settings.model.file),
            load=load,
            noise=kinds.noise_of(self._settings.plant.sensors, seed),
        )


@dataclass(frozen=True)
class RunRequest:
    """A run that any worker can do, and that is done once: its digest names its result."""

    load: str
    """Name of the load, for people."""
    times: tuple[int, ...]
    watts: tuple[float, ...]
    ticks: int
    updating_period_s: float
    """0 is adaptive."""
    assignments: tuple[str, ...] = ()
    """Configuration that differs from the paper's preset, as `section.key=value`."""
    draw: int = 1
    """Number of the draw: of a named load, or of the sensors' noise where the load is a file."""
    networked: bool = False
    """Three services on the bus instead of one process."""
    trace_ticks: int = 0
    """Every so many ticks of the trace are kept; 0 is none."""
    procedure: Procedure = Procedure.CONFIGURED

    @cached_property
    def digest(self) -> str:
        """Digest of all that decides the outcome: the same for requests that ask for the same run in other words."""
        return decisive_digest(self, settings_of(self.assignments))


class Happening(NamedTuple):
    """An event of a journal, without who caused it."""

    service: str
    tick: int
    kind: int
    subject: int


@dataclass(frozen=True)
class Outcome:
    """Result of a run."""

    programs: str
    """Digest of the programs that did it."""
    indicators: Indicators
    trace_sha256: str
    deadline_misses: int
    updates: dict[str, list[float]]
    """Columns of the updates, by name."""
    trace: dict[str, list[float]]
    """Columns of the trace, by name; empty unless it was asked for."""
    events: list[Happening] = field(default_factory=list)
    """Events of the journals; empty unless the trace was asked for."""
    failed_updates: int = 0
    """Updates that had no answer."""

    def column(self, name: str) -> Series:
        """Return a column of the updates."""
        return np.asarray(self.updates[name], dtype=float)

    def series(self, name: str) -> Series:
        """Return a column of the trace."""
        return np.asarray(self.trace[name], dtype=float)

    def to_json(self) -> str:
        """Return the outcome as one JSON document."""
        return json.dumps({**asdict(self), "indicators": self.indicators._asdict()})

    @classmethod
    def from_json(cls, text: str) -> "Outcome":
        """Return the outcome of a document. Raises ValueError if it is not one."""
        try:
            content = parsed_json(text)
            events = [Happening(*event) for event in content["events"]]
            return cls(**{**content, "indicators": Indicators(**content["indicators"]), "events": events})
        except (TypeError, KeyError) as error:
            raise ValueError(str(error)) from None


def decisive_digest(request: RunRequest, settings: Settings) -> str:
    """Return a digest of the load, of the settings that have an effect on a run, and of the programs that do it."""
    asked = asdict(request)
    for name in ("load", "assignments"):
        del asked[name]
    configured = _plain(settings.model_dump(include=DECISIVE))
    outside = outside_digests(settings.optimizer_plc.program.outside)
    content = json.dumps([asked, configured, programs_digest(), outside], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()[:20]


def _plain(value: object) -> object:
    """Return settings as plain data; a file counts by what is in it, wherever it is."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, Path):
        return _file_digest(value)
    return value


@lru_cache(maxsize=16)
def _file_digest(path: Path) -> str:
    try:
        return file_digest(path)
    except UsageError:
        return str(path)  # the run will say what is wrong with it


def programs() -> tuple[Any, ...]:
    """Return what does a run: `perform`, the services that it may start and the further plants, known by name."""
    services = (import_module(f"coldloop_{service}.runtime").serve for service in wiring.SERVICES)
    return (perform, start_service, *services, *(point.load() for point in kinds_of_plants()))


def kinds_of_plants() -> list[EntryPoint]:
    """Return the entry points of plants that packages bring, in the order of their names."""
    return sorted(entry_points(group=kinds.GROUP), key=lambda point: point.name)


@lru_cache(maxsize=1)
def programs_digest() -> str:
    """Return a digest of all that decides what a run gives: code, data files, versions of Python and of libraries."""
    plants = (point.module.partition(".")[0] for point in kinds_of_plants())
    folders = (Path(folder) for name in (*PACKAGES_WITH_DATA, *plants) for folder in import_module(name).__path__)
    files = [file for folder in folders for file in sorted(folder.rglob("*")) if file.suffix in DATA_SUFFIXES]
    versions = [(library, installed_version(library)) for library in LIBRARIES]
    return digest(programs(), files, versions, sys.implementation.cache_tag)[:16]


SHORTEST_TICKS = 60
"""Three of the longest updating periods: with less, no update ever takes effect."""


def check(request: RunRequest) -> None:
    """Find out, before any run is done, what would make one fail.

    Raises UsageError if a run is too short, or a solver is not there.
    """
    program = settings_of(request.assignments).optimizer_plc.program
    if request.ticks < SHORTEST_TICKS:
        duration_s, least_s = (ticks * program.process.tick_s for ticks in (request.ticks, SHORTEST_TICKS))
        raise UsageError(f"{duration_s:g} s are too short for a study: choose a --duration of {least_s:g} s or more")
    make_solver(program)


def perform(request: RunRequest) -> str:
    """Do a run; return its outcome as JSON."""
    settings = settings_of(request.assignments)
    scenario = Scenario(
        request.ticks, load_profile.LoadProfile(request.times, request.watts), request.updating_period_s, request.draw
    )
    recorder = Recorder(request.ticks)
    match request.procedure:
        case Procedure.PAIRED_PROBLEMS | Procedure.HARSH_PROBLEMS:
            sequence = problem_sequence(scenario, request.assignments)
            run = paired_run if request.procedure is Procedure.PAIRED_PROBLEMS else harsh_run
            columns = run(sequence, settings.optimizer_plc.program)
            indicators = paired_indicators(columns, request.updating_period_s)
            return Outcome(programs_digest(), indicators, "", 0, columns, {}).to_json()
        case Procedure.LINEAR_PLANT:
            LinearRig(settings).run(scenario, recorder)
        case Procedure.CONFIGURED if request.networked:
            with tempfile.TemporaryDirectory(prefix="coldloop-logs-") as logs:
                asyncio.run(networked_run.run_on_localhost(settings, scenario, recorder, Path(logs)))
        case Procedure.CONFIGURED:
            _rig(request.assignments).run(scenario, recorder)
    return _outcome(recorder.recording(), settings, request.trace_ticks).to_json()


_rig = lru_cache(maxsize=1)(lambda assignments: one_process.OneProcessRig(settings_of(assignments)))


def _outcome(recording: Recording, settings: Settings, trace_ticks: int) -> Outcome:
    model, design = lti_model.load(settings.model.file), settings.optimizer_plc.program.design
    trace_sha256 = recording.trace_sha256
    sensors, gauge = settings.plant.sensors, settings.plant.mismatch.level_gauge
    if any(sensors.biases) or gauge != 1.0:  # costs are those of what was reached, not of what was shown
        true_y = recording.y - np.array(sensors.biases, dtype=np.float32)
        true_y[:, cold_box.L1] /= gauge
        recording = recording._replace(y=true_y)
    return Outcome(
        programs=programs_digest(),
        indicators=evaluate(recording, model, design),
        trace_sha256=trace_sha256,
        deadline_misses=recording.link.deadline_misses,
        updates={name: [float(getattr(row, name)) for row in recording.updates] for name in UPDATE_COLUMNS},
        trace=_trace(recording, StageCost(model, design).of(recording.block), trace_ticks) if trace_ticks else {},
        events=[Happening(service, event.tick, event.kind, event.subject) for service, event in recording.events]
        if trace_ticks
        else [],
        failed_updates=sum(map(has_no_answer, recording.updates)),
    )


def _trace(recording: Recording, cost: Series, every: int) -> dict[str, list[float]]:
    kept: dict[str, Any] = {
        "time_s": np.arange(len(recording.load)) * cold_box.TICK_S,
        "load": recording.load,
        "L1": recording.y[:, cold_box.L1],
        "T5": recording.y[:, cold_box.T5],
        "T9": recording.y[:, T9],
        "CV155": recording.u[:, 0],
        "NCR22_A": recording.u[:, 1],
        "CV156": recording.u[:, 2],
        "cost": cost,
    }
    if recording.station.size:
        kept |= dict(zip((*cold_box.STATION_SIGNAL_NAMES, "mode", "alarms"), recording.station.T, strict=True))
    return {name: [float(value) for value in column[::every]] for name, column in kept.items()}
