"""A rig that stays up: services on fixed ports, in real time, until they are ended."""

import asyncio
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Final

from coldloop.errors import LinkError, PeerUnreachableError
from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import PlantLinkState, PlantLinkStatus
from coldloop.registers.maps import maps_of
from coldloop.registers.plant import Measurement
from coldloop_rig.cosim.kept_up import keep_up, say
from coldloop_rig.cosim.local_services import KeptService, LocalServices
from coldloop_rig.cosim.scenario import with_copied_load
from coldloop_rig.cosim.session_client import SessionClient
from coldloop_rig.cosim.wiring import RETAINING, SERVICES, START_PATIENCE_S, retaining
from coldloop_rig.live.link_cuts import CuttableLinks
from coldloop_rig.live.page_process import PageProcess
from coldloop_rig.live.private_folder import make_own_folder, make_private
from coldloop_rig.live.started_rigs import DEFAULT_PORTS, STATE_FILE, RunningRig
from coldloop_rig.runs.running import make_scenario
from coldloop_rig.settings import Settings

LOOK_S: Final = 0.5
"""Between two looks at the load that the plant knows of, and at a service that was started again."""
LOOKING: Final = (PlantLinkState.SEARCHING, PlantLinkState.JOINING)
"""A control PLC without a session is looking for the one that it has retained."""


class UpRig:
    """Starts the services, begins a session in real time, and keeps both up until it is cancelled.

    A service or page that ends is started again (`coldloop_rig.cosim.kept_up`), and resumes from its retained state.
    `services` are those that are started; where the optimiser is not one of them, another client takes its place.
    `optimizer` is a program that is started in the place of ours.
    """

    def __init__(
        self,
        settings: Settings,
        ports: Sequence[int],
        tls: Path | None,
        *,
        page: bool = False,
        cuttable: bool = False,
        services: Sequence[str] = SERVICES,
        optimizer: Sequence[str] = (),
    ) -> None:
        self._optimizer = tuple(optimizer)
        self.folder = make_own_folder(str(ports[0]))
        self._settings = retaining(settings, self.folder, always=False)
        self._scenario = make_scenario(settings)
        self._page = page
        self._services = tuple(services)
        self._ports = tuple(ports)
        self._tls = tls
        self._links = CuttableLinks(self.folder) if cuttable else None
        self._sessions = asyncio.Lock()
        """One session is begun at a time."""

    async def run(self, *, announce: bool) -> None:
        """Run until cancelled; load steps beyond the plant's capacity are written as time advances.

        Raises:
            ColdloopError: The session could not begin, or a service has ended again and again.
        """
        links = self._links
        services = LocalServices(
            with_copied_load(self._settings, self._scenario.load, self.folder),
            make_private(self.folder / "logs"),
            ports=self._ports,
            detours=None if links is None else links.detours,
            services=self._services,
            optimizer=self._optimizer,
        )
        async with links or nullcontext(), services:
            if links is not None:
                links.put_before(services.endpoints)
                await links.connect()
            rig = SessionClient(services.endpoints, self._settings, services=self._services)
            page = PageProcess(self._settings, services.endpoints, self.folder) if self._page else None
            try:
                async with page or nullcontext():
                    await services.during(self._begin(services, rig, page, announce=announce))
                    await self._keep(services, rig, page)
            finally:
                rig.close()
                (self.folder / STATE_FILE).unlink(missing_ok=True)

    async def _begin(
        self, services: LocalServices, rig: SessionClient, page: PageProcess | None, *, announce: bool
    ) -> None:
        await rig.connect(START_PATIENCE_S)
        await rig.start(self._scenario)
        if page is not None:
            await page.is_served()
        if announce:
            sys.stdout.write(addresses(self._settings, self._ports, self.folder, self._services))
            sys.stdout.write(page.addresses if page is not None else "")
            sys.stdout.flush()
        self._write_state(services)

    def _write_state(self, services: LocalServices) -> None:
        """Write which processes there are, for the commands that ask for them."""
        tls = "" if self._tls is None else str(self._tls.resolve())
        pids = {service: process.pid for service, process in services.processes.items()}
        RunningRig.of_this_process(self._ports, tls, pids, cuttable=self._links is not None).write()

    async def _keep(self, services: LocalServices, rig: SessionClient, page: PageProcess | None) -> None:
        work = [self._hold(rig), *(self._keep_service(services, service, rig) for service in self._services)]
        if page is not None:
            work.append(_keep_page(page))
        if self._links is not None:
            work.append(self._links.keep())
        tasks = [asyncio.create_task(one) for one in work]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _hold(self, rig: SessionClient) -> None:
        while True:
            try:
                await rig.hold(LOOK_S)
            except PeerUnreachableError:
                pass  # the plant is being started again
            except LinkError as error:
                say(f"the rest of the load is not written: {error}")
            await asyncio.sleep(LOOK_S)

    async def _keep_service(self, services: LocalServices, service: str, rig: SessionClient) -> None:
        async def restarted() -> None:
            try:
                self._write_state(services)
            except OSError as error:  # commands cannot find this process; the rig keeps running
                say(f"{error.filename}: {error.strerror}")
            while service in RETAINING:  # the optimiser learns it from the control PLC
                with suppress(LinkError):  # another one has ended, too
                    await rig.clients[service].connect(START_PATIENCE_S)
                    if await self._goes_on(service, rig):
                        return
                await asyncio.sleep(LOOK_S)

        await keep_up(KeptService(services, service), restarted)

    async def _goes_on(self, service: str, rig: SessionClient) -> bool:
        """Print whether the session was resumed after a restart of a service, or a new one has begun.

        Not yet, while the control PLC is looking for the one that it has retained.
        """
        async with self._sessions:
            looking = (await rig.control.read(PlantLinkStatus)).state in LOOKING
            plant, control = (await rig.plant.read(Identity)).session, (await rig.control.read(Identity)).session
            if plant == control != 0:
                return True
            if plant and looking:
                return False
            session = await rig.start(self._scenario)
            say(f"session {session} has begun: the {service} service had no state to resume")
            return True


async def _keep_page(page: PageProcess) -> None:
    """Keep the page up; the rig keeps running without it once it is given up."""
    try:
        await keep_up(page)
    except LinkError as error:
        say(str(error))


def addresses(settings: Settings, ports: Sequence[int], folder: Path, services: Sequence[str]) -> str:
    """Return where everything is, with a line to paste."""
    process = settings.process
    base = "" if process == COLD_BOX else f" --process {settings.model.file}"
    base += "" if tuple(ports) == DEFAULT_PORTS else f" --port-base {ports[0]}"
    shown = process.banded[-1]
    measured = maps_of(process).plant.block_of(Measurement).registers()
    address = next(one.address for one in measured if one.name == f"y.{shown.name}")
    raised = 420 if process.load.has_named_loads else process.load.span[1]
    load = f"load {raised:g}" if process.has_load else "mode manual"
    which = f"load {settings.plant.load}, " if process.has_load else ""
    more = "load FILE.csv, mode, " if process.has_load else ""
    tls = any(getattr(settings, service).server.tls for service in services)
    places = {
        service: f"127.0.0.1:{port}" if service in services else "yours: a client of the control PLC"
        for service, port in zip(SERVICES, ports, strict=True)
    }
    lines = [
        f"the rig is up: {which}{settings.session.factor:g} x real time",
        *(f"  {service:14} {place}" for service, place in places.items()),
        f"  logs           {folder / 'logs'}",
    ]
    if tls:
        lines += ["Modbus/TCP Security: clients show a certificate; `coldloop certificates` has made some"]
    else:
        lines += [
            f"read {shown.name} ({shown.unit}):",
            f"  mbpoll -0 -1 -m tcp -p {ports[0]} -t 4:float -B -r {address} -c 1 127.0.0.1",
        ]
    lines += [
        f"coldloop status{base} --follow    its status",
        f"coldloop set{base} {load:<15}and {more}setpoint, factor, pause, resume, acknowledge",
    ]
    return "\n".join(lines) + "\n"
