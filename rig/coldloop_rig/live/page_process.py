"""The operator's page as a process of a rig that is up."""

import asyncio
import secrets
import socket
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NamedTuple, Self

from coldloop.config import to_environment
from coldloop.errors import LinkError, UsageError
from coldloop.modbus.settings import TlsSettings
from coldloop_hmi.settings import HmiSection, HmiSettings
from coldloop_hmi.users import PageRole, write_user
from coldloop_rig.cosim.endpoints import RigEndpoints
from coldloop_rig.cosim.kept_up import end_of
from coldloop_rig.cosim.local_services import last_line, start_program, terminate, wait_for_end
from coldloop_rig.interpreter import PYTHON
from coldloop_rig.live.private_folder import new_own
from coldloop_rig.settings import Settings

LOOK_S: Final = 0.05
OPERATOR: Final = "operator"


def check_page(section: HmiSection) -> None:
    """Refuse a page that cannot be served, before anything that takes time.

    Raises:
        UsageError: It has no port, its extra is not installed, or its port is in use.
    """
    if not section.port:
        raise UsageError("the page needs a fixed port: give one with --page-port")
    if find_spec("aiohttp") is None:
        raise UsageError("--page needs aiohttp: pip install 'coldloop[hmi]'")
    with socket.socket(socket.AF_INET6 if ":" in section.host else socket.AF_INET) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind((section.host, section.port))
        except OSError as error:
            raise UsageError(
                f"port {section.port} of the page: {error.strerror}; give another one with --page-port"
            ) from None


def pointed_at(section: HmiSection, endpoints: RigEndpoints) -> HmiSection:
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


class FirstLogin(NamedTuple):
    """The operator of a page whose configuration names no users."""

    file: Path
    password: str

    @classmethod
    def made_in(cls, folder: Path) -> Self:
        """Write a user with a random password into a folder."""
        login = cls(folder / "page-users", secrets.token_urlsafe(9))
        login.file.unlink(missing_ok=True)
        write_user(login.file, OPERATOR, PageRole.OPERATE, login.password)
        return login

    @property
    def line(self) -> str:
        """How to log in."""
        return f"  to operate     user {OPERATOR}, password {self.password} (of this run)\n"


def with_own_files(section: HmiSection, folder: Path) -> tuple[HmiSection, FirstLogin | None]:
    """Return the settings of a page with users and an audit in a private folder, where they name none."""
    update: dict[str, object] = {}
    login = None if section.login.users else FirstLogin.made_in(folder)
    if login is not None:
        update["login"] = section.login.model_copy(update={"users": login.file})
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

    name: Final = "the page"

    def __init__(self, settings: HmiSettings | Settings, endpoints: RigEndpoints, folder: Path) -> None:
        self._log = folder / "logs" / "hmi.log"
        self._section, self._login = with_own_files(pointed_at(settings.hmi, endpoints), folder)
        self._environment = to_environment(HmiSettings(model=settings.model, hmi=self._section))
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
        return f"{end_of(code, last_line(self._log))} (log: {self._log})"

    async def restart(self) -> None:
        """Start it, or start it again."""
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with new_own(self._log) as log:
            self._process = await start_program((*PYTHON, "-m", "coldloop_hmi"), self._environment, log)

    async def __aexit__(self, *_: object) -> None:
        """End it."""
        if self._process is not None:
            terminate(self._process)
            await wait_for_end(self._process)

    async def is_served(self) -> None:
        """Wait until the page answers.

        Raises:
            LinkError: It has ended.
        """
        while True:
            if self._process is not None and self._process.returncode is not None:
                raise LinkError(f"the page {await self.ended()}")
            try:
                _, writer = await asyncio.open_connection(self._section.host, self._section.port)
            except OSError:
                await asyncio.sleep(LOOK_S)
                continue
            writer.close()
            return

    @property
    def addresses(self) -> str:
        """Where it is, and who may operate."""
        scheme = "https" if self._section.https else "http"
        text = f"  page           {scheme}://{self._section.host}:{self._section.port}/\n"
        if self._login is not None:
            text += self._login.line
        return text
