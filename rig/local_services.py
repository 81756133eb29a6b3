"""The three services as processes on localhost."""

import asyncio
import contextlib
import os
import signal
import socket
import sys
from collections.abc import Awaitable, Mapping
from pathlib import Path
from typing import Self, TypeVar

from coldloop.config import PREFIX, to_environment
from coldloop.endpoints import Endpoint
from coldloop.errors import LinkError
from coldloop.modbus.settings import TlsSettings
from rig.network import NetworkRig, RigEndpoints
from rig.recording import Recorder
from rig.scenario import Scenario
from rig.settings import Settings

T = TypeVar("T")

SERVICES = ("plant", "control_plc", "optimizer_plc")
START_PATIENCE_S = 90.0
"""The first start on a machine compiles the kernels."""
STOP_GRACE_S = 5.0


class LocalServices:
    """Processes of the three services; an async context in which they live.

    Their logs go to `<folder>/<service>.log`.
    """

    def __init__(self, settings: Settings, log_folder: Path) -> None:
        self.endpoints = RigEndpoints(
            *[
                _endpoint(settings, service, port)
                for service, port in zip(SERVICES, _free_ports(len(SERVICES)), strict=True)
            ]
        )
        self._environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(PREFIX)},
            **to_environment(_wired(settings, self.endpoints)),
        }
        self._logs = log_folder
        self._processes: dict[str, asyncio.subprocess.Process] = {}

    async def __aenter__(self) -> Self:
        """Start them."""
        self._logs.mkdir(parents=True, exist_ok=True)
        # A session of their own: a Ctrl-C is the rig's to answer, in good order.
        for service in SERVICES:
            with self._log(service).open("wb") as log:
                self._processes[service] = await asyncio.create_subprocess_exec(
                    sys.executable, "-m", service, "--with-parent", env=self._environment, start_new_session=True,
                    stdin=asyncio.subprocess.PIPE, stdout=log, stderr=log,
                )  # fmt: skip
        return self

    async def __aexit__(self, *_: object) -> None:
        """End them."""
        for process in self._processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
        for process in self._processes.values():
            try:
                async with asyncio.timeout(STOP_GRACE_S):
                    await process.wait()
            except TimeoutError:
                process.kill()
                await process.wait()

    @property
    def processes(self) -> Mapping[str, asyncio.subprocess.Process]:
        """The processes by service, while they live."""
        return self._processes

    async def during(self, work: Awaitable[T]) -> T:
        """Return the result of `work`, unless a service ends before.

        Raises:
            LinkError: A service ended; with the last line that it wrote.
        """
        task = asyncio.ensure_future(work)
        deaths = {asyncio.ensure_future(process.wait()): name for name, process in self._processes.items()}
        try:
            await asyncio.wait({task, *deaths}, return_when=asyncio.FIRST_COMPLETED)
            if task.done():
                return task.result()
            dead = next(name for death, name in deaths.items() if death.done())
            raise LinkError(f"the {dead} service has ended: {self._last_words(dead)} (log: {self._log(dead)})")
        finally:
            for pending in (task, *deaths):
                pending.cancel()
            await asyncio.gather(task, *deaths, return_exceptions=True)

    def _log(self, service: str) -> Path:
        return self._logs / f"{service}.log"

    def _last_words(self, service: str) -> str:
        lines = self._log(service).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "without a word"


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


def _wired(settings: Settings, endpoints: RigEndpoints) -> Settings:
    """Return the settings with the servers on these endpoints and the clients pointed at them."""

    def client(endpoint: Endpoint, tls: TlsSettings | None) -> Endpoint:
        return endpoint.model_copy(update={"tls": tls})

    def server(section: str, endpoint: Endpoint) -> object:
        return getattr(settings, section).server.model_copy(update={"host": endpoint.host, "port": endpoint.port})

    return settings.model_copy(
        update={
            "session": settings.session.model_copy(update={"autostart": False}),
            "plant": settings.plant.model_copy(update={"server": server("plant", endpoints.plant)}),
            "control_plc": settings.control_plc.model_copy(
                update={
                    "server": server("control_plc", endpoints.control_plc),
                    "plant": client(endpoints.plant, settings.control_plc.plant.tls),
                }
            ),
            "optimizer_plc": settings.optimizer_plc.model_copy(
                update={
                    "server": server("optimizer_plc", endpoints.optimizer_plc),
                    "control_plc": client(endpoints.control_plc, settings.optimizer_plc.control_plc.tls),
                }
            ),
        }
    )


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]
