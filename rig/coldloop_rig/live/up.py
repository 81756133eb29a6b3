"""A rig that stays up: services on fixed ports, in real time, with the operator's page, until they are ended.

`coldloop up --cuttable` has a proxy in each link, in its own process, and cuts it when `coldloop fault cut` leaves a
file in the rig's private folder, each its own, which that process takes away when it cuts.
"""

import asyncio
import json
import secrets
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple, Self

from pydantic import Field

from coldloop import config, errors
from coldloop.modbus.settings import TlsSettings
from coldloop.process.cold_box import COLD_BOX
from coldloop.registers import common, control_plc, maps_of
from coldloop.registers.plant import Measurement
from coldloop_hmi.settings import HmiSection, HmiSettings
from coldloop_hmi.users import PageRole, write_user
from coldloop_rig import PYTHON
from coldloop_rig.cosim import networked_run, scenario, wiring
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.live import started_rigs
from coldloop_rig.runs.running import make_scenario
from coldloop_rig.settings import Settings

CUT_FILES: Final = "cut-*.json"
CUT_LOOK_S: Final = 0.2
"""Interval at which requested cuts, and taken ones, are polled, s."""
TAKEN_S: Final = 10.0
"""Longest time until a rig takes a cut, s."""
OPERATOR: Final = "operator"
LOOK_S: Final = 0.5
"""Interval at which the load known to the plant, and a restarted service, are polled, s."""


class Cut(NamedTuple):
    """A link through which nothing passes for a while; its connections stay open, as when a cable is pulled."""

    link: Literal["plant", "optimizer"]
    seconds: Annotated[float, Field(gt=0, le=3600)]
    """Duration in real time, s."""


class CuttableLinks:
    """Cuts links on request, by files in the folder of their rig."""

    def __init__(self, folder: Path, proxies: wiring.Links) -> None:
        self._folder, self.proxies = folder, proxies
        for file in folder.glob(CUT_FILES):
            file.unlink(missing_ok=True)

    async def keep(self) -> None:
        """Cut what is wanted, until cancelled."""
        cuts: set[asyncio.Task[None]] = set()
        try:
            while True:
                await asyncio.sleep(CUT_LOOK_S)
                for cut in self._wanted():
                    task = asyncio.create_task(self._cut(cut))
                    cuts.add(task)
                    task.add_done_callback(cuts.discard)
        finally:
            for task in cuts:
                task.cancel()

    def _wanted(self) -> Iterator[Cut]:
        """Take the cuts that are wanted; one that cannot be read is left, and its command says that it was not cut."""
        for file in self._folder.glob(CUT_FILES):
            with suppress(OSError):
                try:
                    yield started_rigs.parsed_as(Cut, started_rigs.read_own(file), "`coldloop fault cut`")
                except ValueError as error:
                    networked_run.say(f"{file}: {error}")
                file.unlink(missing_ok=True)

    async def _cut(self, cut: Cut) -> None:
        with self.proxies.cut(cut.link):
            networked_run.say(f"the {cut.link} link is cut for {cut.seconds:g} s")
            await asyncio.sleep(cut.seconds)
        networked_run.say(f"the {cut.link} link is restored")


async def cut(first_port: int | None, link: str, seconds: float) -> None:
    """Cut a link of the rig that was started here on these ports, or of the only one; return when it is cut.

    Raises:
        UsageError: There is no such rig, or its links cannot be cut.
        ColdloopError: It does not take it.
    """
    rig = started_rigs.require_rig(first_port)
    if not rig.cuttable:
        raise errors.UsageError("the links of this rig cannot be cut: start it with `coldloop up --cuttable`")
    file = started_rigs.state_folder(rig.ports[0]) / CUT_FILES.replace("*", secrets.token_hex(8))
    started_rigs.write_own(file, json.dumps([link, seconds]))
    deadline = time.monotonic() + TAKEN_S
    try:
        while file.exists():
            if time.monotonic() > deadline:
                raise errors.ColdloopError(f"the rig (process {rig.pid}) has not cut the link within {TAKEN_S:g} s")
            await asyncio.sleep(CUT_LOOK_S)
    finally:
        file.unlink(missing_ok=True)


def check_page(section: HmiSection) -> None:
    """Refuse a page that cannot be served, before anything that takes time.

    Raises:
        UsageError: It has no port, its extra is not installed, or its port is in use.
    """
    if not section.port:
        raise errors.UsageError("the page needs a fixed port: give one with --page-port")
    if find_spec("aiohttp") is None:
        raise errors.UsageError("--page needs aiohttp: pip install 'coldloop[hmi]'")
    with socket.socket(socket.AF_INET6 if ":" in section.host else socket.AF_INET) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind((section.host, section.port))
        except OSError as error:
            raise errors.UsageError(
                f"port {section.port} of the page: {error.strerror}; give another one with --page-port"
            ) from None


def pointed_at(section: HmiSection, endpoints: wiring.RigEndpoints) -> HmiSection:
    """Return the settings of a page of the services at these endpoints.

    Their certificate is an operator's, for commands; for reading the page uses the reader's next to it, if any.
    """
    update: dict[str, object] = {
        service: getattr(section, service).model_copy(
            update={"host": end.host, "port": end.port, "word_order": end.word_order, "tls": readers(end.tls)}
        )
        for service, end in endpoints._asdict().items()
    }
    if endpoints.plant.tls is not None and section.operator_tls is None:
        update["operator_tls"] = endpoints.plant.tls
    return section.model_copy(update=update)


def readers(tls: TlsSettings | None) -> TlsSettings | None:
    """Return the reader's certificate next to the given one, as `coldloop certificates` makes it, or the given one."""
    if tls is None:
        return None
    certificate, key = tls.certificate.with_name("reader.crt"), tls.key.with_name("reader.key")
    if not (certificate.is_file() and key.is_file()):
        return tls
    return tls.model_copy(update={"certificate": certificate, "key": key})


def with_own_files(section: HmiSection, folder: Path) -> tuple[HmiSection, str]:
    """Return the settings of a page with users and an audit in a private folder, where they name none.

    With them comes the line that says how to log in: as a new user with a random password, where they name no users.
    """
    update: dict[str, object] = {}
    login = ""
    if not section.login.users:
        file, password = folder / "page-users", secrets.token_urlsafe(9)
        file.unlink(missing_ok=True)
        write_user(file, OPERATOR, PageRole.OPERATE, password)
        login = f"  to operate     user {OPERATOR}, password {password} (of this run)\n"
        update["login"] = section.login.model_copy(update={"users": file})
    if section.audit is None:
        update["audit"] = folder / "page-audit.jsonl"
    return section.model_copy(update=update), login


class PageProcess:
    """The page; an async context in which it lives.

    Args:
        settings: Its own, and the process of the rig.
        endpoints: Where the services are, with the operator's certificate.
        folder: Where it logs to, and keeps the first login and the audit.
    """

    def __init__(self, settings: HmiSettings | Settings, endpoints: wiring.RigEndpoints, folder: Path) -> None:
        self._log = folder / "logs" / "hmi.log"
        self._section, self._login = with_own_files(pointed_at(settings.hmi, endpoints), folder)
        self._environment = config.to_environment(HmiSettings(model=settings.model, hmi=self._section))
        self._process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        """Start it."""
        await self.restart()
        return self

    async def ended(self) -> str:
        """Wait until it has ended; return how."""
        if self._process is None:
            raise RuntimeError("the page was not started")
        code = await self._process.wait()
        return f"{networked_run.end_of(code, networked_run.last_line(self._log))} (log: {self._log})"

    async def restart(self) -> None:
        """Start it, or start it again."""
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with started_rigs.new_own(self._log) as log:
            self._process = await networked_run.start_program((*PYTHON, "-m", "coldloop_hmi"), self._environment, log)

    async def __aexit__(self, *_: object) -> None:
        """End it."""
        if self._process is not None:
            networked_run.terminate(self._process)
            await networked_run.wait_for_end(self._process)

    async def is_served(self) -> None:
        """Wait until the page answers.

        Raises:
            LinkError: It has ended.
        """
        while True:
            if self._process is not None and self._process.returncode is not None:
                raise errors.LinkError(f"the page {await self.ended()}")
            try:
                _, writer = await asyncio.open_connection(self._section.host, self._section.port)
            except OSError:
                await asyncio.sleep(0.05)
                continue
            writer.close()
            return

    @property
    def addresses(self) -> str:
        """Lines that say where the page is, and who may operate."""
        scheme = "https" if self._section.https else "http"
        return f"  page           {scheme}://{self._section.host}:{self._section.port}/\n{self._login}"


class UpRig:
    """Starts the services, begins a session in real time, and keeps both up until it is cancelled.

    A service or page that ends is started again (`cosim.networked_run`), and resumes from its retained state.
    `services` are those that are started; where the optimiser is not one of them, another client takes its place.
    `optimizer` is a program that is started in the place of ours.
    """

    def __init__(
        self, settings: Settings, ports: Sequence[int], tls: Path | None, *, page: bool = False, cuttable: bool = False,
        services: Sequence[str] = wiring.SERVICES, optimizer: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self._optimizer, self._services, self._ports = tuple(optimizer), tuple(services), tuple(ports)
        self.folder = started_rigs.make_own_folder(str(ports[0]))
        self._settings = wiring.retaining(settings, self.folder, always=False)
        self._scenario, self._page, self._tls = make_scenario(settings), page, tls
        self._links = CuttableLinks(self.folder, wiring.fault_injection("links")("up")) if cuttable else None
        self._sessions = asyncio.Lock()
        """One session is begun at a time."""

    async def run(self, *, announce: bool) -> None:
        """Run until cancelled; load steps beyond the plant's capacity are written as time advances.

        Raises:
            ColdloopError: The session could not begin, or a service has ended again and again.
        """
        links = self._links
        settings = scenario.with_copied_load(self._settings, self._scenario.load, self.folder)
        services = networked_run.LocalServices(
            settings, started_rigs.make_private(self.folder / "logs"), links=None if links is None else links.proxies,
            ports=self._ports, services=self._services, optimizer=self._optimizer,
        )  # fmt: skip
        async with services:
            if links is not None:
                await links.proxies.connect()
            rig = SessionClient(services.endpoints, self._settings, services=self._services)
            page = PageProcess(self._settings, services.endpoints, self.folder) if self._page else None
            try:
                async with page or nullcontext():
                    await services.during(self._begin(services, rig, page, announce=announce))
                    await self._keep(services, rig, page)
            finally:
                rig.close()
                (self.folder / started_rigs.STATE_FILE).unlink(missing_ok=True)

    async def _begin(
        self, services: networked_run.LocalServices, rig: SessionClient, page: PageProcess | None, *, announce: bool
    ) -> None:
        await rig.connect(wiring.START_PATIENCE_S)
        await rig.start(self._scenario)
        if page is not None:
            await page.is_served()
        if announce:
            sys.stdout.write(addresses(self._settings, self._ports, self.folder, self._services))
            sys.stdout.write(page.addresses if page is not None else "")
            sys.stdout.flush()
        self._write_state(services)

    def _write_state(self, services: networked_run.LocalServices) -> None:
        """Write which processes there are, for the commands that ask for them."""
        tls = "" if self._tls is None else str(self._tls.resolve())
        pids = {service: process.pid for service, process in services.processes.items()}
        started_rigs.RunningRig.write(self._ports, tls, pids, cuttable=self._links is not None)

    async def _keep(self, services: networked_run.LocalServices, rig: SessionClient, page: PageProcess | None) -> None:
        def unwritten(error: errors.LinkError) -> None:
            if not isinstance(error, errors.PeerUnreachableError):  # else the plant is being started again
                networked_run.say(f"the rest of the load is not written: {error}")

        async def keep_page(page: PageProcess) -> None:
            try:
                await networked_run.keep_up("the page", page.ended, page.restart)
            except errors.LinkError as error:  # the rig keeps running without it
                networked_run.say(str(error))

        work = [rig.hold(LOOK_S, unwritten), *(self._keep_service(services, each, rig) for each in self._services)]
        if page is not None:
            work.append(keep_page(page))
        if self._links is not None:
            work.append(self._links.keep())
        tasks = [asyncio.create_task(one) for one in work]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _keep_service(self, services: networked_run.LocalServices, service: str, rig: SessionClient) -> None:
        async def restarted() -> None:
            try:
                self._write_state(services)
            except OSError as error:  # commands cannot find this process; the rig keeps running
                networked_run.say(f"{error.filename}: {error.strerror}")
            while service in wiring.RETAINING:  # the optimiser learns it from the control PLC
                with suppress(errors.LinkError):  # another one has ended, too
                    await rig.clients[service].connect(wiring.START_PATIENCE_S)
                    if await self._goes_on(service, rig):
                        return
                await asyncio.sleep(LOOK_S)

        ended, restart = partial(services.exit_of, service), partial(services.start, service, may_end=True)
        await networked_run.keep_up(f"the {service} service", ended, restart, restarted)

    async def _goes_on(self, service: str, rig: SessionClient) -> bool:
        """Print whether the session was resumed after a restart of a service, or a new one has begun.

        Not yet, while the control PLC is looking for the one that it has retained.
        """
        async with self._sessions:
            state = (await rig.control.read(control_plc.PlantLinkStatus)).state
            looking = state in (control_plc.PlantLinkState.SEARCHING, control_plc.PlantLinkState.JOINING)
            plant, control = (
                (await rig.plant.read(common.Identity)).session,
                (await rig.control.read(common.Identity)).session,
            )
            if plant == control != 0:
                return True
            if plant and looking:
                return False
            session = await rig.start(self._scenario)
            networked_run.say(f"session {session} has begun: the {service} service had no state to resume")
            return True


def addresses(settings: Settings, ports: Sequence[int], folder: Path, services: Sequence[str]) -> str:
    """Return where everything is, with a line to paste."""
    process = settings.process
    base = "" if process == COLD_BOX else f" --process {settings.model.file}"
    base += "" if tuple(ports) == started_rigs.DEFAULT_PORTS else f" --port-base {ports[0]}"
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
        for service, port in zip(wiring.SERVICES, ports, strict=True)
    }
    lines = [
        f"the rig is up: {which}{settings.session.factor:g} x real time",
        *(f"  {service:14} {place}" for service, place in places.items()),
        f"  logs           {folder / 'logs'}",
    ]
    if tls:
        lines.append("Modbus/TCP Security: clients show a certificate; `coldloop certificates` has made some")
    else:
        lines.append(f"read {shown.name} ({shown.unit}):")
        lines.append(f"  mbpoll -0 -1 -m tcp -p {ports[0]} -t 4:float -B -r {address} -c 1 127.0.0.1")
    lines += [
        f"coldloop status{base} --follow    its status",
        f"coldloop set{base} {load:<15}and {more}setpoint, factor, pause, resume, acknowledge",
    ]
    return "\n".join(lines) + "\n"
