"""The services as processes on localhost."""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Awaitable, Mapping, Sequence
from pathlib import Path
from typing import IO, Self, TypeVar

from coldloop.config import PREFIX, to_environment
from coldloop.errors import LinkError
from coldloop_rig.cosim.compiling_services import show_compiling
from coldloop_rig.cosim.kept_up import end_of
from coldloop_rig.cosim.ports import ReservedPorts
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session_client import SessionClient
from coldloop_rig.cosim.wiring import SERVICES, START_PATIENCE_S, Detours, endpoints_on, wired
from coldloop_rig.interpreter import PYTHON
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

if sys.platform != "win32":
    import resource

T = TypeVar("T")

STOP_GRACE_S = 5.0
MOST_LOG_BYTES = 2**26
"""Size of a file that a service writes, its log among them: a write beyond it fails."""
EXIT_S = 2.0
"""How long a process may take to end after it has closed its connections."""


class LocalServices:
    """Processes of the services; an async context in which they live.

    Args:
        settings: Their configuration.
        log_folder: Their logs go to `<folder>/<service>.log`.
        detours: Where something is between clients and servers.
        ports: Where they listen; by default on free ports.
        services: Which ones are started; the others are somebody else's.
        optimizer: A program that takes the place of our optimiser, with its options.
    """

    def __init__(
        self,
        settings: Settings,
        log_folder: Path,
        *,
        detours: Detours | None = None,
        ports: Sequence[int] | None = None,
        services: Sequence[str] = SERVICES,
        optimizer: Sequence[str] = (),
    ) -> None:
        self._ports = ReservedPorts(len(SERVICES) if ports is None else 0)
        self.endpoints = endpoints_on(ports or self._ports.numbers, settings)
        placed = wired(settings, self.endpoints, detours)
        self._environment = to_environment(placed)
        self._commands: dict[str, tuple[str, ...]] = {
            service: (*PYTHON, "-m", f"coldloop_{service}") for service in services
        }
        if optimizer:
            control, server = placed.optimizer_plc.control_plc, placed.optimizer_plc.server
            where = ("--host", control.host, "--port", str(control.port), "--listen", str(server.port))
            self._commands["optimizer_plc"] = (*optimizer, *where)
        self._logs = log_folder
        self.services = tuple(services)
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._watchers: set[asyncio.Task[None]] = set()
        self._ended: asyncio.Queue[str] = asyncio.Queue()
        self._showing: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Start them."""
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
        processes, self._processes = self._processes, {}
        for process in processes.values():
            terminate(process)
        for process in processes.values():
            await wait_for_end(process)
        await asyncio.gather(*self._watchers)
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
        self._processes[service] = process
        if may_end:
            return
        watcher = asyncio.create_task(self._watch(service, process), name=f"watch {service}")
        self._watchers.add(watcher)
        watcher.add_done_callback(self._watchers.discard)

    async def stop(self, service: str, number: signal.Signals) -> None:
        """End one of them on purpose, by a signal, and wait until it has ended."""
        process = self._processes.pop(service)
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)
        await wait_for_end(process)

    def ended(self, service: str) -> bool:
        """Return whether a service has ended by itself."""
        return self._processes[service].returncode is not None

    def pause(self, service: str) -> None:
        """Let a process stand still."""
        self._signal(service, signal.SIGSTOP)

    def resume(self, service: str) -> None:
        """Resume it."""
        self._signal(service, signal.SIGCONT)

    def _signal(self, service: str, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._processes[service].send_signal(number)

    @property
    def processes(self) -> Mapping[str, asyncio.subprocess.Process]:
        """The processes by service, of those that are to run."""
        return self._processes

    async def during(self, work: Awaitable[T]) -> T:
        """Return the result of `work`, unless a service ends before by itself.

        Raises:
            LinkError: A service ended; with the last line that it wrote.
        """
        task = asyncio.ensure_future(work)
        death = asyncio.ensure_future(self._ended.get())
        try:
            await asyncio.wait({task, death}, return_when=asyncio.FIRST_COMPLETED)
            if _is_link_error(task):  # a service that ends closes its connections before its process has ended
                await asyncio.wait({death}, timeout=EXIT_S)
            if death.done():  # first: work that needs the service may fail in the same turn
                dead = death.result()
                raise LinkError(f"the {dead} service {self.end_of(dead)}")
            return task.result()
        finally:
            for pending in (task, death):
                pending.cancel()
            await asyncio.gather(task, death, return_exceptions=True)

    async def _watch(self, service: str, process: asyncio.subprocess.Process) -> None:
        await process.wait()
        if self._processes.get(service) is process:
            self._ended.put_nowait(service)

    def log(self, service: str) -> Path:
        """Return the file that a service logs to."""
        return self._logs / f"{service}.log"

    def end_of(self, service: str) -> str:
        """Return how a service has ended, and where its log is."""
        process = self._processes.get(service)
        code = 0 if process is None or process.returncode is None else process.returncode
        return f"{end_of(code, last_line(self.log(service)))} (log: {self.log(service)})"


class KeptService:
    """One of the services, for `coldloop_rig.cosim.kept_up`."""

    def __init__(self, services: LocalServices, service: str) -> None:
        self.name = f"the {service} service"
        self._services = services
        self._service = service

    async def ended(self) -> str:
        """Wait until it has ended; return how."""
        await self._services.processes[self._service].wait()
        return self._services.end_of(self._service)

    async def restart(self) -> None:
        """Start it where it was before."""
        await self._services.start(self._service, may_end=True)


def _is_link_error(task: "asyncio.Future[T]") -> bool:
    return task.done() and not task.cancelled() and isinstance(task.exception(), LinkError)


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
    """Wait for the end of a process; one that does not end is made to."""
    try:
        async with asyncio.timeout(STOP_GRACE_S):
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
        rig = SessionClient(services.endpoints, settings)

        async def work() -> None:
            await rig.connect(START_PATIENCE_S)
            await rig.run(scenario, recorder)

        try:
            await services.during(work())
        finally:
            rig.close()
