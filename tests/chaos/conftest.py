"""Coroutines as tests, and the command line."""

import asyncio
import inspect
import os
from collections.abc import Callable
from typing import NamedTuple

import pytest

from coldloop.config import PREFIX
from rig import cli

PATIENCE_S = 60.0


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


class Outcome(NamedTuple):
    """What a command left behind."""

    code: object
    out: str
    complaints: list[str]
    """Lines on standard error."""


Coldloop = Callable[..., Outcome]


@pytest.fixture
def coldloop(capsys: pytest.CaptureFixture[str]) -> Coldloop:
    """`coldloop` with its arguments, in this process."""

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        try:
            code: object = cli.main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        return Outcome(code, out, err.splitlines())

    return run
