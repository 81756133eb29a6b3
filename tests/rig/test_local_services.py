"""Services started on localhost, and what their owner hears when one ends."""

import asyncio
from pathlib import Path

import pytest

from coldloop.errors import LinkError, PeerUnreachableError
from rig.cosim.local_services import LocalServices
from rig.settings import Settings


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
