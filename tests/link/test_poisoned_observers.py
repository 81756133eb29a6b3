"""Services that talk nonsense to who only looks: the page, a recording and commands outlive it, and are right after."""

import asyncio
import json
import os
import subprocess
import urllib.error
import urllib.request
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, Final

import pytest

from coldloop_rig.cosim.wiring import SERVICES
from coldloop_rig.settings import Settings
from tests.harness.processes import Ended, Process, Processes
from tests.harness.records import MAPS
from tests.harness.treated_link import TreatedLink
from tests.link.poison import PoisonedReads

SEED: Final = os.environ.get("POISON_SEED", "1")
SHARE: Final = 0.3
"""Of the answers, while they are poisoned."""
COMMANDS: Final = (("status",), ("events",), ("events", "--service", "plant"), ("set", "factor", "10"))
RECORDED: Final = ("record", "--duration", "60s", "--figures", "svg")
PATIENCE_S: Final = 60.0
END_S: Final = 120.0


class Rig:
    """Three services and their page as processes, the page and all commands behind links that can be poisoned."""

    def __init__(self, processes: Processes) -> None:
        ports = {service: processes.free_port() for service in SERVICES}
        self.settings = Settings.model_validate(
            {
                "session": {"autostart": True, "mode": "realtime", "factor": 10},
                "plant": {"server": {"port": ports["plant"]}, "load": "a"},
                "control_plc": {"server": {"port": ports["control_plc"]}, "plant": {"port": ports["plant"]}},
                "optimizer_plc": {
                    "server": {"port": ports["optimizer_plc"]}, "control_plc": {"port": ports["control_plc"]},
                },
            }
        )  # fmt: skip
        self.processes = processes
        self.running = [processes.service(name, port=ports[name], settings=self.settings) for name in SERVICES]
        self.poison = {name: PoisonedReads(MAPS[name], f"{SEED}/{name}") for name in SERVICES}
        self.links = [TreatedLink(ports[name], self.poison[name]) for name in SERVICES]
        self.page: Process

    def begin_page(self) -> None:
        """Start the page behind the links."""
        places = (f"hmi.{name}.port={link.port}" for name, link in zip(SERVICES, self.links, strict=True))
        self.page = self.processes.service("hmi", "hmi.poll_s=0.05", *places)
        self.running.append(self.page)

    def poisoned(self, share: float) -> None:
        for one in self.poison.values():
            one.share = share

    def command(self, *words: object) -> Process:
        """Start a command behind the links."""
        ends = [f"127.0.0.1:{link.port}" for link in self.links]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return self.processes.coldloop(words[0], "--rig", *ends, *words[1:], **pipes)

    async def ask(self, path: str) -> tuple[int, Any]:
        return await asyncio.to_thread(_asked, f"http://127.0.0.1:{self.page.port}{path}")

    async def is_right(self) -> None:
        """Wait until the page is live and all it shows is current."""
        async with asyncio.timeout(PATIENCE_S):
            while (await self.ask("/healthz"))[0] != 200:  # noqa: ASYNC110 it is another process
                await asyncio.sleep(0.05)


def _asked(url: str) -> tuple[int, Any]:
    try:
        with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:  # noqa: S310 our own page
            return answer.status, answer.read()
    except urllib.error.HTTPError as refusal:
        with refusal:
            return refusal.code, refusal.read()
    except OSError:
        return 0, b""


def assert_in_order(ended: Ended, words: tuple[str, ...]) -> None:
    """It did what it was asked for, or says in one line why not."""
    assert ended.code in (0, 1, 2), (words, ended)
    lines = [line for line in ended.err.splitlines() if line.startswith("coldloop: ")]
    assert "Traceback" not in ended.err, (words, ended)
    assert bool(lines) or ended.code == 0, (words, ended)
    assert len(lines) <= 2, (words, ended)


@pytest.fixture
def rig(processes: Processes, realtime: None) -> Rig:  # noqa: ARG001 a mark
    return Rig(processes)


@pytest.mark.night  # test_lying_rigs.py has each command alone
async def test_who_only_looks_outlives_nonsense(rig: Rig, tmp_path: Path) -> None:
    async with AsyncExitStack() as stack:
        for link in rig.links:
            await stack.enter_async_context(link)
        rig.begin_page()
        await rig.is_right()
        rig.poisoned(SHARE)
        recording = rig.command(*RECORDED, "--out", tmp_path / "poisoned")
        for words in COMMANDS:
            assert_in_order(await asyncio.to_thread(rig.command(*words).ended, END_S), words)
            for path in ("/healthz", "/api/state", "/metrics"):
                assert (await rig.ask(path))[0] in (200, 503), path
        assert_in_order(await asyncio.to_thread(recording.ended, END_S), RECORDED)
        rig.poisoned(0.0)
        await rig.is_right()
        for words in COMMANDS:
            ended = await asyncio.to_thread(rig.command(*words).ended, END_S)
            assert ended.code == 0, ended
        ended = await asyncio.to_thread(rig.command(*RECORDED, "--out", tmp_path / "sound").ended, END_S)
        assert ended.code == 0, ended
        assert json.loads((tmp_path / "sound" / "summary.json").read_text())["complete"]
        assert all(process.alive for process in rig.running)
        assert all(one.made for one in rig.poison.values())
        assert not any("Traceback" in process.said for process in rig.running)
