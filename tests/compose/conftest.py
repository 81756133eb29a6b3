"""Composed rigs, each brought up once for the tests of a file; they are skipped where no container engine runs."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from coldloop_rig import cli
from coldloop_rig.cosim.wiring import ReservedPorts

ROOT = Path(__file__).parents[2]
SERVICES = ("plant", "control-plc", "optimizer-plc")
PORTS = ("PLANT", "CONTROL_PLC", "OPTIMIZER_PLC", "MQTT", "PAGE")
WITH_PAGE = {"COMPOSE_PROFILES": "page"}
HEALTHY_WITHIN_S = 420


@dataclass(frozen=True)
class ComposedRig:
    """A composed rig that is up, on ports of its own."""

    environment: dict[str, str]
    plant: int
    control_plc: int
    optimizer_plc: int
    mqtt: int
    page: int

    def compose(self, *arguments: str, check: bool = True) -> str:
        """Run `docker compose` and return what it prints."""
        done = subprocess.run(
            ["docker", "compose", *arguments], cwd=ROOT, env=self.environment, check=False, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        if check and done.returncode:
            pytest.fail(f"docker compose {' '.join(arguments)}:\n{done.stdout[-4000:]}", pytrace=False)
        return done.stdout

    def inside(self, service: str, *command: str) -> str:
        """Run a command in a service's container and return what it prints."""
        return self.compose("exec", "-T", service, *command).strip()

    def inspect(self, service: str) -> dict[str, Any]:
        """Return what the engine knows of a service's container."""
        container = self.compose("ps", "--quiet", service).strip()
        done = subprocess.run(["docker", "inspect", container], env=self.environment, check=True, capture_output=True)
        described: dict[str, Any] = json.loads(done.stdout)[0]
        return described


@contextmanager
def composed(network: str, files: Sequence[str] = ("docker-compose.yml",), **environment: str) -> Iterator[ComposedRig]:
    """Bring a rig up, on networks whose addresses begin so; take it down with all that it has left."""
    with ReservedPorts(len(PORTS)) as reserved:
        own = {
            **{f"COLDLOOP_{name}_PORT": str(port) for name, port in zip(PORTS, reserved.numbers, strict=True)},
            "COMPOSE_PROJECT_NAME": f"coldloop-test-{os.getpid()}",
            "COMPOSE_FILE": os.pathsep.join(files),
            "COLDLOOP_NETWORK": network,
        }
        rig = ComposedRig({**os.environ, **own, **environment}, *reserved.numbers)
        try:
            rig.compose("build")
            _bring_up(rig)
            yield rig
        finally:
            rig.compose("down", "--volumes", "--timeout", "5", check=False)


@pytest.fixture(scope="session")
def _engine() -> Iterator[None]:
    """A container engine, which keeps the images of this run no longer than it takes."""
    if not _engine_runs():
        if "CONTAINER_ENGINE_REQUIRED" in os.environ:
            pytest.fail("no container engine runs, or it has no `docker compose`", pytrace=False)
        pytest.skip("no container engine runs here")
    yield
    names = [f"coldloop-test-{os.getpid()}-{service}" for service in (*SERVICES, "page")]
    subprocess.run(["docker", "image", "rm", "--force", *names], check=False, capture_output=True)


@pytest.fixture(scope="module")
def rig(_engine: None) -> Iterator[ComposedRig]:
    """The rig as it comes."""
    with composed("172.29") as one:
        yield one


@pytest.fixture(scope="module")
def certificate_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates for the rig; the containers' user can read the keys."""
    folder = tmp_path_factory.mktemp("certificates") / "site"
    asked_by_the_page = [f"{service}.operators" for service in SERVICES]
    hosts = [f"--host={name}" for name in ("plant.field", "control-plc.control", *asked_by_the_page)]
    assert cli.main(["certificates", "--out", str(folder), *hosts]) == 0
    for file in folder.glob("*.key"):
        file.chmod(0o644)
    return folder


@pytest.fixture(scope="module")
def secured_rig(_engine: None, certificate_folder: Path) -> Iterator[ComposedRig]:
    """The rig with TLS, and its page."""
    files = ("docker-compose.yml", "docker-compose.tls.yml")
    with composed("172.29", files, COLDLOOP_CERTIFICATES=str(certificate_folder), **WITH_PAGE) as one:
        yield one


@pytest.fixture(scope="module")
def refrigerator_rig(_engine: None) -> Iterator[ComposedRig]:
    """The rig with the whole refrigerator, and its page."""
    with composed("172.29", COLDLOOP_PLANT_KIND="refrigerator", **WITH_PAGE) as one:
        yield one


def _bring_up(rig: ComposedRig) -> None:
    started = rig.compose("up", "--wait", "--wait-timeout", str(HEALTHY_WITHIN_S), check=False)
    states = rig.compose("ps", "--all", "--format", "{{.Service}}: {{.Status}}")
    if states.count("(healthy)") != len(SERVICES) + 1 + ("COMPOSE_PROFILES" in rig.environment):
        logs = rig.compose("logs", "--no-color", "--tail", "20")
        pytest.fail(f"not all became healthy\n{started}\n{states}\n{logs}", pytrace=False)


def _engine_runs() -> bool:
    if shutil.which("docker") is None:
        return False
    questions = (["docker", "compose", "version"], ["docker", "version"])
    try:
        return all(
            subprocess.run(question, check=False, capture_output=True, timeout=20).returncode == 0
            for question in questions
        )
    except (OSError, subprocess.TimeoutExpired):
        return False


@pytest.fixture
def coldloop() -> Callable[..., None]:
    """`coldloop run` with its arguments; its last words are the failure if it fails."""

    def run(*arguments: str) -> None:
        done = subprocess.run(
            [sys.executable, "-m", "coldloop_rig", "run", *arguments], cwd=ROOT, check=False, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600,
        )  # fmt: skip
        if done.returncode:
            pytest.fail(f"coldloop run {' '.join(arguments)} ended with {done.returncode}:\n{done.stdout[-4000:]}")

    return run
