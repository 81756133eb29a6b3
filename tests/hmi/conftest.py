"""A rig of three processes and its page, a browser that looks at it, and somebody who reads the registers beside it."""

import contextlib
import json
import os
import shutil
import socket
import struct
import subprocess
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from email.message import Message
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import pytest

from coldloop_hmi.users import PageRole, write_user
from coldloop_rig import cli
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.settings import Settings
from tests.harness.processes import END_S, Process, Processes
from tests.harness.waiting import PATIENCE_S, eventually

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SERVICES = ("plant", "control_plc", "optimizer_plc", "hmi")
OPERATOR = ("anna", "cold as helium")
VIEWER = ("lena", "only looks at it")
FACTOR = 2.0
RECORDED_S = 120
"""Length of the run that is replayed."""


class Clock:
    """A clock that is set by hand."""

    def __init__(self, time: float = 0.0) -> None:
        self.time = time

    def __call__(self) -> float:
        return self.time


class Answer(NamedTuple):
    """What the page's server answered."""

    status: int
    document: Any
    headers: Message


class Site:
    """Services and page as processes on ports of their own; each can be killed, stopped and started again."""

    def __init__(self, processes: Processes, folder: Path, overrides: Mapping[str, object], kind: str) -> None:
        ports = [processes.free_port() for _ in SERVICES]
        self.ports = dict(zip(SERVICES, ports, strict=True))
        self.audit = folder / "audit.jsonl"
        users = folder / "users"
        write_user(users, OPERATOR[0], PageRole.OPERATE, OPERATOR[1])
        write_user(users, VIEWER[0], PageRole.VIEW, VIEWER[1])
        plant, control, optimizer, page = ports
        ends = {"plant": {"port": plant}, "control_plc": {"port": control}, "optimizer_plc": {"port": optimizer}}
        self._settings = Settings.model_validate(
            {
                "session": {"autostart": True, "mode": "realtime", "factor": FACTOR},
                "plant": {
                    "kind": kind, "server": {"port": plant}, "load": "a",
                    "retain": {"file": str(folder / "plant.state")},
                },
                "control_plc": {
                    "server": {"port": control}, "plant": {"port": plant},
                    "retain": {"file": str(folder / "control.state")},
                },
                "optimizer_plc": {"server": {"port": optimizer}, "control_plc": {"port": control}},
                "hmi": {
                    "port": page, **ends, "training": True, "poll_s": 0.05, "audit": str(self.audit),
                    "login": {"users": str(users)}, **overrides,
                },
            }
        )  # fmt: skip
        self._processes = processes
        self._running: dict[str, Process] = {}

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://127.0.0.1:{self.ports['hmi']}"

    def start(self, service: str) -> None:
        self._running[service] = self._processes.service(service, port=self.ports[service], settings=self._settings)

    def kill(self, service: str) -> None:
        self._running.pop(service).kill()

    def freeze(self, service: str) -> None:
        self._running[service].pause()

    def thaw(self, service: str) -> None:
        self._running[service].resume()

    def end(self) -> None:
        for process in self._running.values():
            process.popen.terminate()
            process.resume()
        for process in self._running.values():
            assert process.popen.wait(END_S) == 0, process.said

    def ask(
        self, path: str, body: object = None, *, cookie: str = "", origin: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> Answer:  # fmt: skip
        """Ask the page's server; with a body by POST, by default from the page itself."""
        request = urllib.request.Request(self.address + path, headers=dict(headers or {}))  # noqa: S310 our own page
        if body is not None:
            request.data = json.dumps(body).encode()
            request.add_header("Content-Type", "application/json")
            request.add_header("Origin", self.address if origin is None else origin)
        if cookie:
            request.add_header("Cookie", cookie)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:  # noqa: S310
                return _answer(answer.status, answer.read(), answer.headers)
        except urllib.error.HTTPError as refusal:
            with refusal:
                return _answer(refusal.code, refusal.read(), refusal.headers)

    def log_in(self, user: tuple[str, str] = OPERATOR) -> str:
        """Log in; return the cookie."""
        answer = self.ask("/api/login", {"user": user[0], "password": user[1]})
        assert answer.status == 200, answer.document
        return answer.headers["Set-Cookie"].partition(";")[0]

    def audited(self) -> list[dict[str, str]]:
        return [json.loads(line) for line in self.audit.read_text(encoding="utf-8").splitlines()]

    def is_live(self, service: str = "") -> bool:
        """Return whether the page hears a service, or all of them."""
        try:
            answer = self.ask("/healthz")
        except OSError:
            return False
        return bool(answer.document["services"][service]["live"]) if service else answer.status == 200


def _answer(status: int, raw: bytes, headers: Message) -> Answer:
    is_json = headers.get_content_type() == "application/json"
    return Answer(status, json.loads(raw) if is_json else raw.decode(), headers)


@contextlib.contextmanager
def sites(processes: Processes, folders: pytest.TempPathFactory) -> Iterator[Callable[..., Site]]:
    """Start sites with settings of the page that differ; they end with the context."""
    started: list[Site] = []

    def start(*, kind: str = "cold-box", **overrides: object) -> Site:
        one = Site(processes, folders.mktemp("site"), overrides, kind)
        started.append(one)
        for service in SERVICES:
            one.start(service)
        eventually(one.is_live, "all services answer the page")
        return one

    try:
        yield start
    finally:
        for one in started:
            one.end()


@pytest.fixture(scope="module")
def start_site(
    shared_processes: Processes,
    tmp_path_factory: pytest.TempPathFactory,
    realtime: None,  # noqa: ARG001 a mark
) -> Iterator[Callable[..., Site]]:
    """Start sites of one's own, which end with the tests of a file: in real time they never rest."""
    with sites(shared_processes, tmp_path_factory) as start:
        yield start


@pytest.fixture(scope="session")
def site(
    shared_processes: Processes,
    tmp_path_factory: pytest.TempPathFactory,
    realtime: None,  # noqa: ARG001 a mark
) -> Iterator[Site]:
    """One site for all tests; they leave it as they found it."""
    with sites(shared_processes, tmp_path_factory) as start:
        yield start()


# -- registers, read without anything of ours --------------------------------------------------------------------------


def read_registers(port: int, address: int, count: int) -> bytes:
    """Read holding registers with nothing but a socket."""
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as bus:
        bus.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 255, 3, address, count))
        answer = b""
        while len(answer) < 9 + 2 * count:
            part = bus.recv(1024)
            assert part, "the server closed the connection"
            answer += part
    assert answer[7:9] == bytes((3, 2 * count))
    return answer[9:]


def write_registers(port: int, address: int, data: bytes) -> None:
    """Write holding registers with nothing but a socket."""
    words = len(data) // 2
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as bus:
        bus.sendall(struct.pack(">HHHBBHHB", 1, 0, 7 + len(data), 255, 16, address, words, len(data)) + data)
        answer = bus.recv(1024)
    assert answer[7:] == struct.pack(">BHH", 16, address, words)


def process_now(port: int) -> tuple[int, tuple[float, ...]]:
    """Read tick, and load, inputs and outputs, from address 100 of the control PLC."""
    tick, *values = struct.unpack(">I26f", read_registers(port, 100, 54))
    return tick, tuple(values)


class Witness:
    """Reads the process again and again in a thread of its own."""

    def __init__(self, port: int) -> None:
        self.seen: dict[int, tuple[float, ...]] = {}
        self._port = port
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _read(self) -> None:
        while not self._end.wait(0.02):
            tick, values = process_now(self._port)
            self.seen[tick] = values


# -- recorded runs -----------------------------------------------------------------------------------------------------


def record(folder: Path, *options: str) -> Path:
    """Run in this process, and draw no figure; return the folder."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("start", "draw"):
            patch.setattr(FigureProcess, name, lambda *_: None)
        assert cli.main(["run", "--in-process", *options, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="session")
def recorded_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "a run"
    return record(folder, "--load", "a", "--duration", f"{RECORDED_S}s")


class Served:
    """`coldloop page` with its arguments, as a process."""

    def __init__(self, processes: Processes, *runs: Path) -> None:
        words = ("page", *runs, "--page-port", processes.free_port())
        self._process = processes.coldloop(*words, stdout=subprocess.PIPE)
        assert self._process.popen.stdout is not None
        self.address = self._process.popen.stdout.readline().strip().rstrip("/")

    def end(self) -> None:
        self._process.popen.terminate()
        self._process.popen.communicate(timeout=END_S)

    def ask(self, path: str, body: object = None) -> Any:  # noqa: ANN401 JSON
        request = urllib.request.Request(self.address + path)  # noqa: S310 our own page
        if body is not None:
            request.data = json.dumps(body).encode()
            request.add_header("Origin", self.address)
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:  # noqa: S310
            return json.loads(answer.read())


@pytest.fixture(scope="session")
def served(shared_processes: Processes, recorded_run: Path) -> Iterator[Served]:
    one = Served(shared_processes, recorded_run)
    yield one
    one.end()


# -- the browser -------------------------------------------------------------------------------------------------------


def chromium() -> str:
    """Return the browser: COLDLOOP_BROWSER, or Debian's."""
    path = os.environ.get("COLDLOOP_BROWSER") or shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        message = "no chromium on PATH: scripts/browser installs it, or COLDLOOP_BROWSER names it"
        if "CI" in os.environ:
            pytest.fail(message)
        pytest.skip(message)
    return path


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    """Headless Chromium; closed with the module, as Playwright's loop is in the way of tests that are coroutines."""
    sync_api = pytest.importorskip("playwright.sync_api")
    path = chromium()
    with sync_api.sync_playwright() as playwright:
        one = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield one
        one.close()


@contextlib.contextmanager
def opened(browser: "Browser", address: str, **context: Any) -> "Iterator[Page]":  # noqa: ANN401 Playwright's own
    """The page in a browser context of its own; an error in its scripts and a request to another host fail the test."""
    look = browser.new_context(**{"viewport": {"width": 1280, "height": 720}, **context})
    page = look.new_page()
    page.set_default_timeout(1000 * PATIENCE_S)
    errors: list[str] = []
    foreign: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda request: foreign.append(request.url) if is_foreign(request.url, address) else None)
    page.goto(address + "/")
    page.wait_for_selector("body[data-tick]")
    yield page
    look.close()
    assert not errors
    assert not foreign


def is_foreign(url: str, address: str) -> bool:
    return not url.startswith((address, "data:", "blob:"))


@pytest.fixture
def page(browser: "Browser", site: Site) -> "Iterator[Page]":
    """The page of the site."""
    with opened(browser, site.address) as one:
        yield one


def log_in_by_clicks(page: "Page", user: tuple[str, str] = OPERATOR) -> None:
    page.click("#login-open")
    page.fill("#login-user", user[0])
    page.fill("#login-password", user[1])
    page.click("#login-form button[type=submit]")
    page.wait_for_selector("#logout:visible")
