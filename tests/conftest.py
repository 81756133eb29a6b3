"""What all tests share: how Hypothesis searches, coroutines as tests, no configuration from outside, a free port, and
the command line, and Debian's mbpoll.
"""

import asyncio
import inspect
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import pytest
from hypothesis import settings

from coldloop.config import PREFIX
from coldloop.errors import UsageError
from rig import cli
from rig.ports import ReservedPorts
from rig.started_rigs import check_ports

settings.register_profile("quick", deadline=None, print_blob=True)
settings.register_profile("fast", settings.get_profile("quick"), max_examples=20)
settings.register_profile("ci", settings.get_profile("quick"), derandomize=True)
settings.register_profile("thorough", settings.get_profile("quick"), max_examples=5000)
settings.load_profile("ci" if "CI" in os.environ else "quick")
"""Quick looks elsewhere each time, and begins with what failed before; ci tries the same examples always. No example
has a deadline: this machine may be busy with something else. `--hypothesis-profile=thorough` is for a night, fast for
the fast lane; both for tests that do not name a number of examples themselves."""

PATIENCE_S = 120.0
"""A coroutine has failed when it takes longer; the first one on a bus may have to compile the kernels."""


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine, in a loop of its own and within `PATIENCE_S`."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}

    async def story() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await pyfuncitem.obj(**arguments)

    asyncio.run(story())
    return True


@pytest.fixture(autouse=True)
def _no_configuration_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in tuple(os.environ):
        if name.startswith(PREFIX):
            monkeypatch.delenv(name)


def first_of_three_ports() -> int:
    """Return the first of three ports in a row that are free now, as `coldloop up` takes them."""
    for _ in range(100):
        with ReservedPorts(1) as reserved:
            base = reserved.numbers[0]
        try:
            check_ports((base, base + 1, base + 2))
        except UsageError:  # taken by somebody else
            continue
        return base
    raise AssertionError("no three free ports in a row")


@pytest.fixture
def free_port() -> Iterator[int]:
    """A port on localhost that nobody else gets during the test; connections are refused until a server listens."""
    with ReservedPorts(1) as reserved:
        yield reserved.numbers[0]


def install(*packages: str) -> None:
    """Install Debian packages, or skip the test with the reason why that cannot be."""
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        pytest.skip(f"needs {' '.join(packages)}: not installed, and only root on Debian can install it here")
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update"], ["apt-get", "install", "-y", "--no-install-recommends", *packages]):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
        if done.returncode != 0:
            pytest.skip(f"`{' '.join(command)}` failed: {done.stderr.strip().splitlines()[-1:]}")


@pytest.fixture(scope="session")
def mbpoll() -> str:
    if shutil.which("mbpoll") is None:
        install("mbpoll")
    return "mbpoll"


class Outcome(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    complaints: list[str]
    """Lines on standard error."""


Coldloop = Callable[..., Outcome]


@pytest.fixture
def coldloop(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Coldloop:
    """`coldloop` with its arguments, in this process: what it does not report as its own error fails the test."""

    def run(*arguments: object, environment: Mapping[str, str] | None = None) -> Outcome:
        with monkeypatch.context() as context:
            for name, value in (environment or {}).items():
                context.setenv(name, value)
            capsys.readouterr()
            try:
                code: Any = cli.main([str(argument) for argument in arguments])
            except SystemExit as end:
                code = end.code
        out, err = capsys.readouterr()
        return Outcome(code, out, err.splitlines())

    return run
