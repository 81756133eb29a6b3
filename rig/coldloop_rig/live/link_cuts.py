"""Links of a rig that is up which can be cut for a while: `coldloop fault cut`.

`coldloop up --cuttable` has a proxy in each link, in its own process. Who wants a cut leaves a file in the rig's
private folder, each its own, which that process takes away when it cuts.
"""

import asyncio
import json
import secrets
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple, Self

from coldloop.errors import ColdloopError, UsageError
from coldloop.parsing import parsed_json
from coldloop_rig.chaos.faults import Freeze, Link
from coldloop_rig.chaos.proxied_services import LinkProxies
from coldloop_rig.cosim.kept_up import say
from coldloop_rig.live.private_folder import read_own, write_own
from coldloop_rig.live.started_rigs import find_rig, no_rig, state_folder

CUT_FILES: Final = "cut-*.json"
LOOK_S: Final = 0.2
"""Between two looks for a cut that is wanted, and for one that is taken."""
TAKEN_S: Final = 10.0
"""A rig takes it within this time."""
LONGEST_S: Final = 3600.0


class Cut(NamedTuple):
    """A link through which nothing passes for a while; its connections stay open, as when a cable is pulled."""

    link: Link
    seconds: float
    """By the clock."""

    @classmethod
    def parsed(cls, text: str) -> Self:
        """Return the cut that a file asks for.

        Raises:
            ValueError: It asks for none.
        """
        try:
            link, seconds = parsed_json(text)
            cut = cls(Link(link), float(seconds))
        except (ValueError, TypeError, OverflowError):
            raise ValueError("not what `coldloop fault cut` writes") from None
        if not 0 < cut.seconds <= LONGEST_S:
            raise ValueError(f"not a number of seconds up to {LONGEST_S:g}")
        return cut


class CuttableLinks(LinkProxies):
    """Proxies that pass everything on, but what is cut on request."""

    def __init__(self, folder: Path) -> None:
        super().__init__("up")
        self._folder = folder
        for file in folder.glob(CUT_FILES):
            file.unlink(missing_ok=True)

    async def keep(self) -> None:
        """Cut what is wanted, until cancelled."""
        cuts: set[asyncio.Task[None]] = set()
        try:
            while True:
                await asyncio.sleep(LOOK_S)
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
                    yield Cut.parsed(read_own(file))
                except ValueError as error:
                    say(f"{file}: {error}")
                file.unlink(missing_ok=True)

    async def _cut(self, cut: Cut) -> None:
        proxy = self.by_link[cut.link]
        fault = Freeze(kind="freeze", link=cut.link, at_s=0.0, duration_s=cut.seconds)
        proxy.begin(fault)
        say(f"the {cut.link} link is cut for {cut.seconds:g} s")
        try:
            await asyncio.sleep(cut.seconds)
        finally:
            proxy.end(fault)
        say(f"the {cut.link} link is restored")


async def cut(first_port: int | None, link: Link, seconds: float) -> None:
    """Cut a link of the rig that was started here on these ports, or of the only one; return when it is cut.

    Raises:
        UsageError: There is no such rig, or its links cannot be cut.
        ColdloopError: It does not take it.
    """
    rig = find_rig(first_port)
    if rig is None:
        raise no_rig(first_port)
    if not rig.cuttable:
        raise UsageError("the links of this rig cannot be cut: start it with `coldloop up --cuttable`")
    file = state_folder(rig.ports[0]) / CUT_FILES.replace("*", secrets.token_hex(8))
    write_own(file, json.dumps([link, seconds]))
    deadline = time.monotonic() + TAKEN_S
    try:
        while file.exists():
            if time.monotonic() > deadline:
                raise ColdloopError(f"the rig (process {rig.pid}) has not cut the link within {TAKEN_S:g} s")
            await asyncio.sleep(LOOK_S)
    finally:
        file.unlink(missing_ok=True)
