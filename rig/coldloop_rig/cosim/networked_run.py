"""A run over the bus: on services that it starts (`LocalServices`), or on a rig that is up, as that is set."""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, Self, TypeVar, get_args

from pydantic import BaseModel

import coldloop_control_plc.settings
import coldloop_optimizer_plc.settings
import coldloop_plant.settings
from coldloop.config import MOST_SHOWN, PREFIX, Configuration, flattened, load_configuration, to_environment
from coldloop.errors import LinkError, UsageError
from coldloop.kernels.cache import Kernels, announce
from coldloop.modbus.settings import Endpoint
from coldloop.registers.common import ConfigurationDigest, ConfigurationLine, configuration_of, lines_of
from coldloop.service.start import COMPILING, SERVING, run_event_loop
from coldloop.text import parsed_json
from coldloop_rig import PYTHON
from coldloop_rig.cosim import session, wiring
from coldloop_rig.cosim.scenario import Job, Scenario, StopRequest, with_copied_load
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.results.recording import Recorder, Way
from coldloop_rig.settings import Settings

if sys.platform != "win32":
    import resource

LOOK_S: Final = 0.25
TOGETHER_S: Final = 1.5
"""Services that are started at once say within this time that they compile."""
PAUSES_S: Final = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Pauses before each further start, s; after the last one the service is given up."""
STEADY_S: Final = 60.0
"""Time without an exit after which the pauses start from the first one again, s."""
T = TypeVar("T")
MOST_LOG_BYTES = 2**26
"""Size of a file that a service writes, its log among them: a write beyond it fails."""


async def show_compiling(logs: Sequence[Path]) -> None:
    """Announce what the services with these logs compile, in one line; return when all of them serve."""
    while not any(COMPILING in events for events in map(_events, logs)):
        if all(SERVING in events for events in map(_events, logs)):
            return
        await asyncio.sleep(LOOK_S)
    await asyncio.sleep(TOGETHER_S)
    compiling = [events[COMPILING] for events in map(_events, logs) if COMPILING in events]
    announce(*(Kernels(line["kernels"], line["about_s"]) for line in compiling))


def _events(log: Path) -> dict[str, dict[str, Any]]:
    """Return the lines of a log by what happened, of each the last one."""
    found = {}
    for text in log.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(ValueError):  # the last words of a service, or half a line
            line = parsed_json(text)
            if isinstance(line, dict) and "event" in line:
                found[line["event"]] = line
    return found


async def keep_up(
    name: str, ended: Callable[[], Awaitable[str]], restart: Callable[[], Awaitable[None]],
    restarted: Callable[[], Awaitable[None]] | None = None, pauses_s: tuple[float, ...] = PAUSES_S,
) -> None:  # fmt: skip
    """Start a process again whenever it has ended, until cancelled.

    Args:
        name: What it is, in a message.
        ended: Waits until it has ended; returns how, such as `was ended by SIGKILL`.
        restart: Starts it where it was before.
        restarted: Work after each start, given up when the process ends again.
        pauses_s: Before each start in a row.

    Raises:
        LinkError: It has ended once more than there are pauses.
    """
    loop = asyncio.get_running_loop()
    restarts, since = 0, loop.time()
    work: Callable[[], Awaitable[None]] = partial(asyncio.sleep, 0.0)
    while True:
        how = await _run_until_exit(ended, work)
        if loop.time() - since > STEADY_S:
            restarts = 0
        if restarts == len(pauses_s):
            raise LinkError(f"{name} {how}; given up after {restarts} restarts")
        pause = pauses_s[restarts]
        restarts += 1
        say(f"{name} {how}: started again in {pause:g} s ({restarts} of {len(pauses_s)})")
        await asyncio.sleep(pause)
        since = loop.time()
        await restart()
        work = restarted or work


async def _run_until_exit(ended: Callable[[], Awaitable[str]], work: Callable[[], Awaitable[None]]) -> str:
    """Wait until a process has ended while `work` runs, which is cancelled with it; return how it has ended."""
    exited, running = asyncio.ensure_future(ended()), asyncio.ensure_future(work())
    try:
        await asyncio.wait({exited, running}, return_when=asyncio.FIRST_COMPLETED)
        if not exited.done():
            await running
        return await exited
    finally:
        exited.cancel()
        running.cancel()
        await asyncio.gather(exited, running, return_exceptions=True)


def end_of(code: int, last_words: str) -> str:
    """Return how a process has ended: by which signal, or with which exit code and last line of its log."""
    if code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"
    return f"has ended with exit code {code}: {last_words}"


def say(text: str) -> None:
    """Print a line for the operator or the log; ignore a closed output."""
    with contextlib.suppress(OSError):  # the disk may be full, the terminal closed
        sys.stderr.write(f"coldloop: {text}\n")
        sys.stderr.flush()


class LocalServices:
    """Processes of the services; an async context in which they live.

    Args:
        settings: Their configuration.
        log_folder: Their logs go to `<folder>/<service>.log`.
        links: Proxies between clients and servers, not connected yet; they are closed with the services.
        ports: Where they listen; by default on free ports.
        services: Which ones are started; the others are somebody else's.
        optimizer: The command of a service that takes the place of our optimiser.
    """

    def __init__(
        self, settings: Settings, log_folder: Path, *, links: wiring.Links | None = None,
        ports: Sequence[int] | None = None,
        services: Sequence[str] = wiring.SERVICES, optimizer: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self._ports = wiring.ReservedPorts(len(wiring.SERVICES) if ports is None else 0)
        self.endpoints = wiring.endpoints_on(ports or self._ports.numbers, settings)
        self._links = links
        if links is not None:
            links.put_before(self.endpoints)
        self._environment = to_environment(
            wiring.wired(settings, self.endpoints, None if links is None else links.detours)
        )
        self._commands: dict[str, tuple[str, ...]] = {
            service: (*PYTHON, "-m", f"coldloop_{service}") for service in services
        }
        if optimizer:
            self._commands["optimizer_plc"] = tuple(optimizer)
        self._logs = log_folder
        self.services = tuple(services)
        self.processes: dict[str, asyncio.subprocess.Process] = {}
        """Processes of the services that are to run, by service."""
        self._watchers: set[asyncio.Task[None]] = set()
        self._ended: asyncio.Queue[str] = asyncio.Queue()
        self._showing: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._logs.mkdir(parents=True, exist_ok=True)
        for service in self.services:
            self.log(service).unlink(missing_ok=True)
            await self.start(service)
        logs = [self.log(service) for service in self.services]
        self._showing = asyncio.create_task(show_compiling(logs), name="show compiling")
        return self

    async def __aexit__(self, *_: object) -> None:
        """End them."""
        if self._showing is not None:
            self._showing.cancel()
            await asyncio.gather(self._showing, return_exceptions=True)
        processes, self.processes = self.processes, {}
        for process in processes.values():
            terminate(process)
        for process in processes.values():
            await wait_for_end(process)
        await asyncio.gather(*self._watchers)
        if self._links is not None:
            await self._links.close()
        self._ports.release()

    async def start(self, service: str, environment: Mapping[str, str] | None = None, *, may_end: bool = False) -> None:
        """Start one of them, where it was before.

        Args:
            service: Which one.
            environment: Further variables for this time.
            may_end: Its end by itself does not end the run.
        """
        with self.log(service).open("ab") as log:
            process = await start_program(self._commands[service], {**self._environment, **(environment or {})}, log)
        self.processes[service] = process
        if may_end:
            return

        async def watch() -> None:
            await process.wait()
            if self.processes.get(service) is process:
                self._ended.put_nowait(service)

        watcher = asyncio.create_task(watch(), name=f"watch {service}")
        self._watchers.add(watcher)
        watcher.add_done_callback(self._watchers.discard)

    async def stop(self, service: str, number: signal.Signals) -> None:
        """End one of them on purpose, by a signal, and wait until it has ended."""
        process = self.processes.pop(service)
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)
        await wait_for_end(process)

    def ended(self, service: str) -> bool:
        """Return whether a service has ended by itself."""
        return self.processes[service].returncode is not None

    def send(self, service: str, number: signal.Signals) -> None:
        """Send a signal to one of them, unless it has ended."""
        with contextlib.suppress(ProcessLookupError):
            self.processes[service].send_signal(number)

    async def during(self, work: Awaitable[T]) -> T:
        """Return the result of `work`, unless a service ends before by itself.

        Raises:
            LinkError: A service ended; with the last line that it wrote.
        """
        task = asyncio.ensure_future(work)
        death = asyncio.ensure_future(self._ended.get())
        try:
            await asyncio.wait({task, death}, return_when=asyncio.FIRST_COMPLETED)
            if task.done() and not task.cancelled() and isinstance(task.exception(), LinkError):
                await asyncio.wait({death}, timeout=2.0)  # its service may end, which closes connections first
            if death.done():  # first: work that needs the service may fail in the same turn
                dead = death.result()
                raise LinkError(f"the {dead} service {self.end_of(dead)}")
            return task.result()
        finally:
            for pending in (task, death):
                pending.cancel()
            await asyncio.gather(task, death, return_exceptions=True)

    def log(self, service: str) -> Path:
        """Return the file that a service logs to."""
        return self._logs / f"{service}.log"

    async def exit_of(self, service: str) -> str:
        """Wait until a service has ended; return how, and where its log is."""
        await self.processes[service].wait()
        return self.end_of(service)

    def end_of(self, service: str) -> str:
        """Return how a service has ended, and where its log is."""
        process = self.processes.get(service)
        code = 0 if process is None or process.returncode is None else process.returncode
        return f"{end_of(code, last_line(self.log(service)))} (log: {self.log(service)})"


def last_line(log: Path) -> str:
    """Return the last line of a log."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "no reason given"


async def start_program(
    command: Sequence[str], configured: Mapping[str, str], log: IO[bytes]
) -> asyncio.subprocess.Process:  # fmt: skip
    """Start one of our programs, configured by these variables alone; it ends with this process.

    It has a session of its own: a Ctrl-C is the rig's to answer, in good order.
    """
    others = {name: value for name, value in os.environ.items() if not name.startswith(PREFIX)}
    process = await asyncio.create_subprocess_exec(
        *command, "--with-parent", env={**others, **configured}, start_new_session=True,
        stdin=asyncio.subprocess.PIPE, stdout=log, stderr=log,
    )  # fmt: skip
    bound_log(process.pid)
    return process


def bound_log(pid: int) -> None:
    """Let writes of a process beyond `MOST_LOG_BYTES` of a file fail, where the system can."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # it has ended already
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (MOST_LOG_BYTES, MOST_LOG_BYTES))


def terminate(process: asyncio.subprocess.Process) -> None:
    """Ask a process to end; one that is stopped could not."""
    for number in (signal.SIGTERM, signal.SIGCONT):
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)


async def wait_for_end(process: asyncio.subprocess.Process) -> None:
    """Wait for the end of a process; one that has not ended after 5 s is made to."""
    try:
        async with asyncio.timeout(5.0):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()


async def run_on_localhost(
    settings: Settings, scenario: Scenario, recorder: Recorder, log_folder: Path, optimizer: Sequence[str] = ()
) -> None:  # fmt: skip
    """Run a scenario on three services started for it; another program may take the optimiser's place.

    Raises:
        LinkError: A service ended, or one could not be reached.
    """
    async with LocalServices(settings, log_folder, optimizer=optimizer) as services:
        with contextlib.closing(SessionClient(services.endpoints, settings)) as rig:
            await services.during(rig.connect(wiring.START_PATIENCE_S))
            await services.during(rig.run(scenario, recorder))


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
        with closing(session.SessionClient(wiring.RigEndpoints(*endpoints), effective.settings)) as rig:
            async with wiring.answered_in_time(f"to read what the rig {what}"):
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
    with closing(session.SessionClient(wiring.RigEndpoints(*job.endpoints), settings, tolerant=recorded)) as rig:
        await rig.connect(ATTACH_PATIENCE_S)
        if recorded:
            return await session.record_session(rig, scenario, recorder)
        async with wiring.answered_in_time("to read what the rig does"):
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
