"""The three services as processes on localhost."""

import asyncio
import contextlib
import os
import signal
import socket
import sys
from collections.abc import Awaitable, Mapping
from pathlib import Path
from typing import NamedTuple, Self, TypeVar

from coldloop.config import PREFIX, to_environment
from coldloop.endpoints import Endpoint
from coldloop.errors import LinkError
from rig.network import NetworkRig, RigEndpoints
from rig.recording import Recorder
from rig.scenario import Scenario
from rig.settings import Settings

T = TypeVar("T")

SERVICES = ("plant", "control_plc", "optimizer_plc")
START_PATIENCE_S = 90.0
"""The first start on a machine compiles the kernels."""
STOP_GRACE_S = 5.0


class Detours(NamedTuple):
    """Ports that clients are pointed at instead of those of their servers."""

    plant: int
    """For the control PLC."""
    control_plc: int
    """For the optimiser."""


class LocalServices:
    """Processes of the three services; an async context in which they live.

    Args:
        settings: Their configuration.
        log_folder: Their logs go to `<folder>/<service>.log`.
        detours: Where something stands between clients and servers.
        environment: Further variables for all of them.
    """

    def __init__(
        self,
        settings: Settings,
        log_folder: Path,
        *,
        detours: Detours | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.endpoints = RigEndpoints(
            *[
                _endpoint(settings, service, port)
                for service, port in zip(SERVICES, free_ports(len(SERVICES)), strict=True)
            ]
        )
        self._environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(PREFIX)},
            **to_environment(_wired(settings, self.endpoints, detours)),
            **(environment or {}),
        }
        self._logs = log_folder
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._watchers: set[asyncio.Task[None]] = set()
        self._ended: asyncio.Queue[str] = asyncio.Queue()

    async def __aenter__(self) -> Self:
        """Start them."""
        self._logs.mkdir(parents=True, exist_ok=True)
        for service in SERVICES:
            self.log(service).unlink(missing_ok=True)
            await self.start(service)
        return self

    async def __aexit__(self, *_: object) -> None:
        """End them."""
        processes, self._processes = self._processes, {}
        for process in processes.values():
            for number in (signal.SIGTERM, signal.SIGCONT):  # one that is stopped could not end
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(number)
        for process in processes.values():
            await _ended(process)
        await asyncio.gather(*self._watchers)

    async def start(self, service: str, environment: Mapping[str, str] | None = None, *, may_end: bool = False) -> None:
        """Start one of them, where it was before.

        Args:
            service: Which one.
            environment: Further variables for this time.
            may_end: Its end by itself does not end the run.
        """
        # A session of their own: a Ctrl-C is the rig's to answer, in good order.
        with self.log(service).open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", service, "--with-parent",
                env={**self._environment, **(environment or {})}, start_new_session=True,
                stdin=asyncio.subprocess.PIPE, stdout=log, stderr=log,
            )  # fmt: skip
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
        await _ended(process)

    def pid(self, service: str) -> int | None:
        """Return the process id of a service; None while it is not to run."""
        process = self._processes.get(service)
        return process.pid if process is not None else None

    def ended(self, service: str) -> bool:
        """Tell whether a service has ended by itself."""
        return self._processes[service].returncode is not None

    def pause(self, service: str) -> None:
        """Let a process stand still."""
        self._signal(service, signal.SIGSTOP)

    def resume(self, service: str) -> None:
        """Let it go on."""
        self._signal(service, signal.SIGCONT)

    def _signal(self, service: str, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._processes[service].send_signal(number)

    async def during(self, work: Awaitable[T]) -> T:
        """Return the result of `work`, unless a service ends before by itself.

        Raises:
            LinkError: A service ended; with the last line that it wrote.
        """
        task = asyncio.ensure_future(work)
        death = asyncio.ensure_future(self._ended.get())
        try:
            await asyncio.wait({task, death}, return_when=asyncio.FIRST_COMPLETED)
            if task.done():
                return task.result()
            dead = death.result()
            raise LinkError(f"the {dead} service has ended: {self._last_words(dead)} (log: {self.log(dead)})")
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

    def _last_words(self, service: str) -> str:
        lines = self.log(service).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "without a word"


async def _ended(process: asyncio.subprocess.Process) -> None:
    """Wait for the end of a process; one that does not end is made to."""
    try:
        async with asyncio.timeout(STOP_GRACE_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()


async def run_on_localhost(settings: Settings, scenario: Scenario, recorder: Recorder, log_folder: Path) -> None:
    """Run a scenario on three services started for it.

    Raises:
        LinkError: A service ended, or one could not be reached.
    """
    async with LocalServices(settings, log_folder) as services:
        rig = NetworkRig(services.endpoints, settings)

        async def work() -> None:
            await rig.connect(services.endpoints.plant.patience_s)
            await rig.run(scenario, recorder)

        try:
            await services.during(work())
        finally:
            rig.close()


def _endpoint(settings: Settings, service: str, port: int) -> Endpoint:
    section = getattr(settings, service)
    return Endpoint(
        port=port,
        patience_s=START_PATIENCE_S,
        word_order=section.word_order,
        tls=settings.rig.tls if section.server.tls else None,
    )


def _wired(settings: Settings, endpoints: RigEndpoints, detours: Detours | None) -> Settings:
    """Return the settings with the servers on these endpoints and the clients pointed at them, or at the detours."""

    def server(section: str, endpoint: Endpoint) -> object:
        return getattr(settings, section).server.model_copy(update={"host": endpoint.host, "port": endpoint.port})

    def client(endpoint: Endpoint, configured: Endpoint, detour: int | None) -> Endpoint:
        port = endpoint.port if detour is None else detour
        return endpoint.model_copy(update={"port": port, "timeout_s": configured.timeout_s, "tls": configured.tls})

    plant, control_plc = detours or (None, None)
    return settings.model_copy(
        update={
            "session": settings.session.model_copy(update={"autostart": False}),
            "plant": settings.plant.model_copy(update={"server": server("plant", endpoints.plant)}),
            "control_plc": settings.control_plc.model_copy(
                update={
                    "server": server("control_plc", endpoints.control_plc),
                    "plant": client(endpoints.plant, settings.control_plc.plant, plant),
                }
            ),
            "optimizer_plc": settings.optimizer_plc.model_copy(
                update={
                    "server": server("optimizer_plc", endpoints.optimizer_plc),
                    "control_plc": client(endpoints.control_plc, settings.optimizer_plc.control_plc, control_plc),
                }
            ),
        }
    )


def free_ports(count: int) -> list[int]:
    """Return ports that nobody listens on."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]
