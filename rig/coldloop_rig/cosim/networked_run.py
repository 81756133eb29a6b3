"""A run over the bus: on services that are started for it, or on a rig that is up."""

import asyncio
from collections.abc import Awaitable, Coroutine, Sequence
from pathlib import Path
from typing import Any, Final

from coldloop.config import Configuration
from coldloop.modbus.endpoints import Endpoint
from coldloop.service.start import run_event_loop
from coldloop_rig.cosim.answer_time import answered_in_time
from coldloop_rig.cosim.endpoints import RigEndpoints
from coldloop_rig.cosim.job import Job, StopRequest
from coldloop_rig.cosim.local_services import run_on_localhost
from coldloop_rig.cosim.rig_configuration import attached, running_configuration
from coldloop_rig.cosim.saved_session import restore_session, save_session
from coldloop_rig.cosim.scenario import Scenario, with_copied_load
from coldloop_rig.cosim.session_client import SessionClient
from coldloop_rig.cosim.session_recording import SessionUnderWay, find_session, record_session
from coldloop_rig.results.recording import Recorder
from coldloop_rig.results.way import Way
from coldloop_rig.settings import Settings

ATTACH_PATIENCE_S: Final = 5.0


def as_attached(effective: Configuration[Settings], endpoints: Sequence[Endpoint]) -> Configuration[Settings]:
    """Return a configuration with what a rig that is up really runs.

    Raises:
        UsageError: The user asks for something else, which a client cannot change.
        LinkError: A service does not answer.
    """
    running: dict[str, Any] = {}

    async def read() -> int:
        rig = RigEndpoints(*endpoints)
        async with answered_in_time("to read what the rig runs"):
            running.update(await running_configuration(rig, effective.settings, ATTACH_PATIENCE_S))
        return 0

    run_event_loop(read)
    return attached(effective, running)


def session_under_way(effective: Configuration[Settings], endpoints: Sequence[Endpoint]) -> SessionUnderWay:
    """Return the session of a rig that is up.

    Raises:
        UsageError: It has none.
        LinkError: A service does not answer, or runs another model.
    """
    found: list[SessionUnderWay] = []

    async def read() -> int:
        rig = SessionClient(RigEndpoints(*endpoints), effective.settings)
        try:
            async with answered_in_time("to read what the rig does"):
                await rig.connect(ATTACH_PATIENCE_S)
                found.append(await find_session(rig))
        finally:
            rig.close()
        return 0

    run_event_loop(read)
    return found[0]


def drive(job: Job, recorder: Recorder, folder: Path, stop: StopRequest) -> None:
    """Do the run of a job.

    Raises:
        ColdloopError: It is not complete.
    """
    run_event_loop(lambda: _stoppable(_run(job, recorder, folder), stop))


def _run(job: Job, recorder: Recorder, folder: Path) -> Awaitable[None]:
    settings, scenario = job.effective.settings, job.scenario
    if job.conduct is not None:
        return job.conduct(recorder, folder)
    if job.way is Way.RECORDED:
        return _looked_at(RigEndpoints(*job.endpoints), settings, scenario, recorder)
    if job.way is Way.ATTACHED:
        return _attached(RigEndpoints(*job.endpoints), settings, scenario, recorder)
    settings = with_copied_load(settings, scenario.load, folder)
    return run_on_localhost(settings, scenario, recorder, folder / "logs", job.optimizer)


async def _stoppable(run: Awaitable[None], stop: StopRequest) -> int:
    task = asyncio.ensure_future(run)
    loop = asyncio.get_running_loop()
    stop.cancel = lambda: loop.call_soon_threadsafe(task.cancel)
    try:
        if stop.error is not None:
            task.cancel()
        await task
    except asyncio.CancelledError:
        if stop.error is None:
            raise
        raise stop.error from None
    finally:
        stop.cancel = None
    return 0


async def _looked_at(endpoints: RigEndpoints, settings: Settings, scenario: Scenario, recorder: Recorder) -> None:
    rig = SessionClient(endpoints, settings, tolerant=True)
    try:
        await rig.connect(ATTACH_PATIENCE_S)
        await record_session(rig, scenario, recorder)
    finally:
        rig.close()


async def _attached(endpoints: RigEndpoints, settings: Settings, scenario: Scenario, recorder: Recorder) -> None:
    rig = SessionClient(endpoints, settings)
    try:
        await rig.connect(ATTACH_PATIENCE_S)
        async with answered_in_time("to read what the rig does"):
            saved = await save_session(rig)
        try:
            await rig.run(scenario, recorder)
        finally:
            await _to_its_end(restore_session(rig, saved, rig.session))
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
