"""A rig that stays up: three services on fixed ports, in real time, until they are ended."""

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Final

from rig.local_services import LocalServices
from rig.page_process import PageProcess
from rig.private_folder import make_own_folder, make_private
from rig.running import make_scenario
from rig.session_client import SessionClient
from rig.settings import Settings
from rig.started_rigs import DEFAULT_PORTS, STATE_FILE, RunningRig
from rig.wiring import SERVICES, START_PATIENCE_S

LOOK_S: Final = 0.5
"""Between two looks at the load that the plant knows of."""


class UpRig:
    """Starts the services, begins a session in real time, and follows it until it is cancelled."""

    def __init__(self, settings: Settings, ports: Sequence[int], tls: Path | None, *, page: bool = False) -> None:
        self._settings = settings
        self._page = page
        self._ports = tuple(ports)
        self._tls = tls
        self.folder = make_own_folder(str(ports[0]))

    async def run(self, *, announce: bool) -> None:
        """Run until cancelled; load steps beyond what the plant holds are written as time goes on.

        Raises:
            ColdloopError: A service ended, or the session could not begin.
        """
        services = LocalServices(self._settings, make_private(self.folder / "logs"), ports=self._ports)
        async with services:
            rig = SessionClient(services.endpoints, self._settings)
            page = PageProcess(self._settings.hmi, services.endpoints, self.folder) if self._page else None
            try:
                async with page or nullcontext():
                    await services.during(self._serve(rig, page, announce=announce))
            finally:
                rig.close()
                (self.folder / STATE_FILE).unlink(missing_ok=True)

    async def _serve(self, rig: SessionClient, page: PageProcess | None, *, announce: bool) -> None:
        scenario = make_scenario(self._settings)
        await rig.connect(START_PATIENCE_S)
        session = await rig.start(scenario)
        tls = "" if self._tls is None else str(self._tls.resolve())
        if page is not None:
            await page.is_served()
        if announce:
            sys.stdout.write(whereabouts(self._settings, self._ports, self.folder))
            sys.stdout.write(page.whereabouts if page is not None else "")
            sys.stdout.flush()
        RunningRig.of_this_process(self._ports, tls).write()
        await rig.hold(session, LOOK_S)


def whereabouts(settings: Settings, ports: Sequence[int], folder: Path) -> str:
    """Return where everything is, with a line to paste."""
    base = "" if tuple(ports) == DEFAULT_PORTS else f" --port-base {ports[0]}"
    tls = any(getattr(settings, service).server.tls for service in SERVICES)
    lines = [
        f"the rig is up: load {settings.plant.load}, {settings.session.factor:g} x real time",
        *(f"  {service:14} 127.0.0.1:{port}" for service, port in zip(SERVICES, ports, strict=True)),
        f"  logs           {folder / 'logs'}",
    ]
    if tls:
        lines += ["Modbus/TCP Security: clients show a certificate; `coldloop certificates` has made some"]
    else:
        lines += [
            "read T5 (K):",
            f"  mbpoll -0 -1 -m tcp -p {ports[0]} -t 4:float -B -r 216 -c 1 127.0.0.1",
        ]
    lines += [
        f"coldloop status{base} --follow    what it does",
        f"coldloop set{base} load 420       and load FILE.csv, mode, setpoint, factor, pause, resume, acknowledge",
    ]
    return "\n".join(lines) + "\n"
