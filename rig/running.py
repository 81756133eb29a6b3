"""One run into a folder: driven, recorded as it goes on, evaluated, drawn. What is recorded outlives what stops it."""

import asyncio
import signal
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from coldloop.config import Configuration
from coldloop.endpoints import Endpoint
from coldloop.errors import RunInterruptedError, UsageError
from coldloop.lti_model import load as load_model
from coldloop.service import run_event_loop
from coldloop.session import TimeMode
from plant.load import find_load
from rig.handing_back import give_back, look_around
from rig.interruption import INTERRUPTION
from rig.local_services import run_on_localhost
from rig.one_process import OneProcessRig
from rig.recording import Recorder, Sink
from rig.rig_configuration import attached, running_configuration
from rig.rig_endpoints import RigEndpoints
from rig.run_files import RunFiles
from rig.scenario import Scenario, natural_ticks
from rig.session_client import SessionClient
from rig.settings import Settings

ATTACH_PATIENCE_S: Final = 5.0


class Way(StrEnum):
    """How the three programs are connected."""

    IN_PROCESS = "in-process"
    LOCALHOST = "localhost"
    ATTACHED = "attached"
    CHAOS = "chaos"
    """On localhost, with faults on purpose."""


Conduct = Callable[[Recorder, Path], Awaitable[None]]
"""Does a run: takes its recorder and the folder of its results."""


@dataclass(frozen=True)
class Job:
    """A run to be done."""

    effective: Configuration[Settings]
    scenario: Scenario
    way: Way
    endpoints: tuple[Endpoint, ...] = ()
    """Of a rig that is up, to attach to."""
    conduct: Conduct | None = None
    """How it is done, in a way that the others do not describe."""


def make_scenario(settings: Settings, ticks: int | None = None) -> Scenario:
    """Return the scenario of a configuration; without a length it is that of the load."""
    name = settings.plant.load
    load = find_load(name, load_model(settings.model.file).w0)
    return Scenario(
        ticks=ticks or natural_ticks(name, load),
        load=load,
        updating_period_s=settings.optimizer_plc.program.updating_period_s,
        seed=settings.plant.seed,
        realtime=settings.session.mode is TimeMode.REALTIME,
        factor=settings.session.factor,
    )


def as_attached(effective: Configuration[Settings], endpoints: Sequence[Endpoint]) -> Configuration[Settings]:
    """Return a configuration with what a rig that is up really runs.

    Raises:
        UsageError: The user asks for something else, which a client cannot change.
        LinkError: A service does not answer.
    """
    running: dict[str, Any] = {}

    async def read() -> int:
        running.update(await running_configuration(RigEndpoints(*endpoints), effective.settings, ATTACH_PATIENCE_S))
        return 0

    run_event_loop(read)
    return attached(effective, running)


def check_certificates(settings: Settings) -> None:
    """Refuse a rig in which a client could not show its server a certificate.

    Raises:
        UsageError: One has none.
    """
    clients = [
        ("rig", settings.rig.tls, ("plant", "control_plc", "optimizer_plc")),
        ("control_plc.plant", settings.control_plc.plant.tls, ("plant",)),
        ("optimizer_plc.control_plc", settings.optimizer_plc.control_plc.tls, ("control_plc",)),
    ]
    for client, tls, servers in clients:
        for server in servers:
            if tls is None and getattr(settings, server).server.tls is not None:
                raise UsageError(f"{client}.tls is not set, and {server}.server.tls is: name a client certificate")


class _StopRequest:
    """A signal on its way to the run."""

    def __init__(self) -> None:
        self.error: RunInterruptedError | None = None
        self.recorder: Recorder | None = None
        self.cancel: Callable[[], object] | None = None

    def __call__(self, number: signal.Signals) -> None:
        self.error = RunInterruptedError(number.name, number)
        if self.recorder is not None:
            self.recorder.stop(self.error)
        if self.cancel is not None:
            self.cancel()


def run_into(
    folder: Path, job: Job, arguments: Mapping[str, Any], formats: Sequence[str], sinks: Sequence[Sink]
) -> dict[str, Any]:
    """Do a run in a folder that is claimed; return its summary.

    Raises:
        ColdloopError: The run is not complete; what was recorded is in the folder.
    """
    stop = _StopRequest()
    with INTERRUPTION.passed_to(stop):
        files = RunFiles(folder, job.effective, job.scenario, job.way, arguments, sinks)
        stop.recorder = files.recorder
        error: BaseException | None = stop.error
        try:
            if error is None:
                _drive(job, files.recorder, folder, stop)
        except asyncio.CancelledError as cancelled:
            error = stop.error or cancelled
        except BaseException as of_run:  # noqa: BLE001 raised again by `finish`, after the files are closed
            error = of_run
        summary = files.finish(error, formats)
    if stop.error is not None:
        raise stop.error
    return summary


def _drive(job: Job, recorder: Recorder, folder: Path, stop: _StopRequest) -> None:
    if job.way is Way.IN_PROCESS:
        OneProcessRig(job.effective.settings).run(job.scenario, recorder)
    else:
        run_event_loop(lambda: _stoppable(_networked(job, recorder, folder), stop))


def _networked(job: Job, recorder: Recorder, folder: Path) -> Awaitable[None]:
    settings, scenario = job.effective.settings, job.scenario
    if job.conduct is not None:
        return job.conduct(recorder, folder)
    if job.way is Way.ATTACHED:
        return _attached(RigEndpoints(*job.endpoints), settings, scenario, recorder)
    return run_on_localhost(settings, scenario, recorder, folder / "logs")


async def _stoppable(run: Awaitable[None], stop: _StopRequest) -> int:
    task = asyncio.ensure_future(run)
    loop = asyncio.get_running_loop()
    stop.cancel = lambda: loop.call_soon_threadsafe(task.cancel)
    try:
        if stop.error is not None:
            task.cancel()
        await task
    finally:
        stop.cancel = None
    return 0


async def _attached(endpoints: RigEndpoints, settings: Settings, scenario: Scenario, recorder: Recorder) -> None:
    rig = SessionClient(endpoints, settings)
    try:
        await rig.connect(ATTACH_PATIENCE_S)
        found = await look_around(rig)
        try:
            await rig.run(scenario, recorder)
        finally:
            await _to_its_end(give_back(rig, found, rig.session))
    finally:
        rig.close()


async def _to_its_end(work: Coroutine[Any, Any, None]) -> None:
    """Do all of it, also when this task is cancelled meanwhile."""
    task = asyncio.ensure_future(work)
    try:
        await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise
