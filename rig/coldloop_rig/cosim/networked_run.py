"""A run over the bus: on services that are started for it, or on a rig that is up, with what that really runs."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

from pydantic import BaseModel

import coldloop_control_plc.settings
import coldloop_optimizer_plc.settings
import coldloop_plant.settings
from coldloop.config import MOST_SHOWN, Configuration, flattened, load_configuration
from coldloop.errors import LinkError, UsageError
from coldloop.modbus.settings import Endpoint
from coldloop.registers.common import ConfigurationDigest, ConfigurationLine, configuration_of, lines_of
from coldloop.service.start import run_event_loop
from coldloop_rig.cosim import session
from coldloop_rig.cosim.local_services import run_on_localhost
from coldloop_rig.cosim.scenario import Job, Scenario, StopRequest, with_copied_load
from coldloop_rig.cosim.wiring import RigEndpoints, answered_in_time
from coldloop_rig.results.recording import Recorder, Way
from coldloop_rig.settings import Settings

T = TypeVar("T")

SHOWN: Final[Mapping[str, Sequence[str]]] = {
    "plant": coldloop_plant.settings.SHOWN,
    "control_plc": coldloop_control_plc.settings.SHOWN,
    "optimizer_plc": coldloop_optimizer_plc.settings.SHOWN,
}
"""Keys of the configuration that each service publishes."""
OF_SESSION: Final = (
    "session.mode", "session.factor", "plant.load", "plant.seed", "optimizer_plc.program.updating_period_s",
)  # fmt: skip
"""Keys that a rig takes from the client that begins a session."""
ATTACH_PATIENCE_S: Final = 5.0


def _files(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of all files and folders."""
    for name, field in model.model_fields.items():
        kinds = get_args(field.annotation) or (field.annotation,)
        if Path in kinds:
            yield prefix + name
        for kind in kinds:
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from _files(kind, f"{prefix}{name}.")


FILES: Final = frozenset(_files(Settings))
"""Keys whose value names a file: the rig's values are compared and never opened."""


def _text(value: object) -> str:
    """Return a value of a rig as a message can show it."""
    text = str(value)
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


async def running_configuration(client: session.SessionClient) -> dict[str, Any]:
    """Return what the services of a rig run by their registers, by dotted key, without what belongs to a session.

    Raises:
        LinkError: A service does not answer, or its text is not whole, or it shows what it has not to.
        UsageError: Two services run different limits.
    """
    running: dict[str, Any] = {}
    for service, one in client.clients.items():
        digest = await one.read(ConfigurationDigest)
        lines = await one.read_rows(ConfigurationLine, 0, lines_of(digest.length))
        try:
            shown = flattened(configuration_of(digest, lines))
        except ValueError as error:
            raise LinkError(f"{one.peer}: its configuration cannot be read: {error}") from None
        for key, value in shown.items():
            if not f"{key}.".startswith(tuple(f"{permitted}." for permitted in SHOWN[service])):
                raise LinkError(f"{one.peer}: its configuration has {_text(key)}, which it has not to show")
            if running.setdefault(key, value) != value:
                others = _text(running[key])
                raise UsageError(
                    f"{one.peer} runs {key} = {_text(value)}, another one {others}: give all of them the same"
                )
    return {key: value for key, value in running.items() if key not in OF_SESSION}


def as_attached(effective: Configuration[Settings], endpoints: Sequence[Endpoint]) -> Configuration[Settings]:
    """Return a configuration with what a rig that is up really runs.

    Raises:
        UsageError: The user asks for something else, which a client cannot change.
        LinkError: A service does not answer.
        ModelFileError: One runs another model than ours.
    """
    running = _read(effective, endpoints, "runs", running_configuration)
    asked = {key: value for key, value, _ in effective.effective()}
    for given, source in effective.sources.items():
        covered = [key for key in running if f"{key}.".startswith(f"{given}.")]
        for key in covered:
            if asked.get(key) != running[key]:
                raise UsageError(
                    f"{source}: the rig runs {key} = {_text(running[key])}, which a client does not change; drop it, "
                    "or start the rig with it"
                )
        # The model of a rig is compared with ours when it is connected to, and `rig` is the client's section.
        if not covered and source.startswith("--") and not given.startswith((*OF_SESSION, "model.", "rig.")):
            raise UsageError(f"{source}: a rig that is up has its own {given}, which a client does not change; drop it")
    for key in FILES & running.keys():
        if asked.get(key) != running[key]:
            raise UsageError(
                f"the rig runs {key} = {_text(running[key])}: name the same file here with --set {key}=FILE"
            )
    values = {key: (value, source) for key, value, source in effective.effective() if value is not None}
    values |= {key: (value, "the rig") for key, value in running.items() if key not in FILES}
    return load_configuration(Settings, environment={}, options=values)


def session_under_way(effective: Configuration[Settings], endpoints: Sequence[Endpoint], ticks: int) -> Scenario:
    """Return what so many ticks of the session of a rig that is up are.

    Raises:
        UsageError: It has none.
        LinkError: A service does not answer, or runs another model.
    """
    return _read(effective, endpoints, "does", partial(session.present_scenario, ticks=ticks))


def _read(
    effective: Configuration[Settings], endpoints: Sequence[Endpoint], what: str,
    work: Callable[[session.SessionClient], Awaitable[T]],
) -> T:  # fmt: skip
    found: list[T] = []

    async def read() -> int:
        with closing(session.SessionClient(RigEndpoints(*endpoints), effective.settings)) as rig:
            async with answered_in_time(f"to read what the rig {what}"):
                await rig.connect(ATTACH_PATIENCE_S)
                found.append(await work(rig))
        return 0

    run_event_loop(read)
    return found[0]


def drive(job: Job, recorder: Recorder, folder: Path, stop: StopRequest) -> None:
    """Do the run of a job.

    Raises:
        ColdloopError: It is not complete.
    """

    async def run() -> int:
        task = asyncio.ensure_future(_run(job, recorder, folder))
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

    run_event_loop(run)


async def _run(job: Job, recorder: Recorder, folder: Path) -> None:
    settings, scenario, recorded = job.effective.settings, job.scenario, job.way is Way.RECORDED
    if job.conduct is not None:
        return await job.conduct(recorder, folder)
    if not (recorded or job.way is Way.ATTACHED):
        settings = with_copied_load(settings, scenario.load, folder)
        return await run_on_localhost(settings, scenario, recorder, folder / "logs", job.optimizer)
    with closing(session.SessionClient(RigEndpoints(*job.endpoints), settings, tolerant=recorded)) as rig:
        await rig.connect(ATTACH_PATIENCE_S)
        if recorded:
            return await session.record_session(rig, scenario, recorder)
        async with answered_in_time("to read what the rig does"):
            saved = await session.save_session(rig)
        try:
            await rig.run(scenario, recorder)
        finally:
            restoring = asyncio.ensure_future(session.restore_session(rig, saved, rig.session))
            try:
                await asyncio.shield(restoring)
            except asyncio.CancelledError:  # all of it is done
                await restoring
                raise
