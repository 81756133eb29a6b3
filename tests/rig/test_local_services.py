"""Services started on localhost, and what their owner hears when one ends."""

import asyncio
import sys
from pathlib import Path

import pytest

from coldloop.errors import LinkError, PeerUnreachableError
from coldloop_rig.cosim import networked_run
from coldloop_rig.cosim.networked_run import LocalServices
from coldloop_rig.settings import Settings


async def unreachable() -> None:
    raise PeerUnreachableError("nobody answers")


@pytest.mark.usefixtures("processes")
def test_a_service_that_ended_is_named_even_when_the_work_fails_with_it(tmp_path: Path) -> None:
    """The end and its consequence may be known in the same turn of the event loop."""

    async def check() -> None:
        async with LocalServices(Settings(), tmp_path) as services:
            services.processes["plant"].kill()
            await asyncio.wait(services._watchers, return_when=asyncio.FIRST_COMPLETED)  # noqa: SLF001 nothing tells
            with pytest.raises(LinkError, match=r"the plant service was ended by SIGKILL .*plant\.log"):
                await services.during(unreachable())

    asyncio.run(check())


@pytest.mark.usefixtures("programs")
@pytest.mark.skipif(sys.platform != "linux", reason="limits of another process are Linux's")
async def test_the_log_of_a_program_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networked_run, "MOST_LOG_BYTES", 100_000)
    endless = (sys.executable, "-c", "import os\ninput()\nwhile True: os.write(1, bytes(1000))")
    with (tmp_path / "log").open("ab") as log:
        process = await networked_run.start_program(endless, {}, log)
        await process.communicate(b"\n")
    assert process.returncode
    assert 100_000 <= (tmp_path / "log").stat().st_size < 110_000


@pytest.mark.usefixtures("processes")
def test_the_end_of_a_service_is_the_reason_also_when_it_is_known_after_its_connections_have_closed(
    tmp_path: Path,
) -> None:
    async def check() -> None:
        async with LocalServices(Settings(), tmp_path) as services:

            async def unreachable_before_its_end() -> None:
                asyncio.get_running_loop().call_later(0.2, services.processes["plant"].kill)
                await unreachable()

            with pytest.raises(LinkError, match=r"the plant service was ended by SIGKILL"):
                await services.during(unreachable_before_its_end())

    asyncio.run(check())
