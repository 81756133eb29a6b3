"""Scan lateness in real time at factor 1, alone, with the operator's page, and with so many browsers at it.

A browser is one stream of changes and two trends a second, as the view of the trends asks for them.

    .venv/bin/python benchmarks/page_crowd.py                 # five minutes
    .venv/bin/python benchmarks/page_crowd.py --seconds 20    # in short
"""

import argparse
import asyncio
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import aiohttp

from coldloop.config import load_configuration
from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.process.lti_model import load as load_model
from coldloop_hmi.settings import HmiSettings
from coldloop_plant.load import find_load
from coldloop_rig.cosim.networked_run import LocalServices
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.cosim.wiring import ReservedPorts
from coldloop_rig.live.up import PageProcess
from coldloop_rig.results.recording import LinkStatistics, Recorder
from coldloop_rig.settings import Settings

TREND = "api/trend?names=L1,T5,CV155,NCR22_A,CV156,load&seconds=300&points=900"
TREND_S = 0.5


async def browse(session: aiohttp.ClientSession, address: str, seconds: float) -> tuple[int, int]:
    """Be a browser; return how many messages and trends it got."""
    messages = trends = 0

    async def listen() -> None:
        nonlocal messages
        async with session.get(f"{address}api/stream") as stream:
            async for line in stream.content:
                messages += line.startswith(b"data:")

    listening = asyncio.create_task(listen())
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        async with session.get(f"{address}{TREND}") as answer:
            await answer.read()
            trends += answer.ok
        await asyncio.sleep(TREND_S)
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    return messages, trends


async def crowd(options: argparse.Namespace) -> None:
    """Be all browsers; print what they got."""
    async with aiohttp.ClientSession(
        connector=aiohttp.TCPConnector(limit=0), timeout=aiohttp.ClientTimeout(total=None), read_bufsize=1 << 20
    ) as session:
        got = await asyncio.gather(
            *[browse(session, options.address, options.seconds) for _ in range(options.browsers)]
        )
    messages, trends = (sorted(column) for column in zip(*got, strict=True))
    print(f"each browser got {messages[0]} to {messages[-1]} messages and {trends[0]} to {trends[-1]} trends")


async def measure(options: argparse.Namespace, browsers: int | None, folder: Path) -> tuple[LinkStatistics, str]:
    """Run the loop under so many browsers, or without the page; return its timing and what they received."""
    settings = load_configuration(Settings, environment={}).settings
    ticks = round(options.seconds / TICK_S)
    scenario = Scenario(ticks, find_load("a", load_model(settings.model.file).w0, COLD_BOX), 0.0, 1, realtime=True)
    recorder = Recorder(ticks)
    async with LocalServices(settings, folder) as services:
        rig = SessionClient(services.endpoints, settings)
        await rig.connect(60.0)
        if browsers is None:
            await rig.run(scenario, recorder)
            rig.close()
            return recorder.link, ""
        with ReservedPorts(1) as reserved:
            page_settings = HmiSettings(hmi=settings.hmi.model_copy(update={"port": reserved.numbers[0]}))
        async with PageProcess(page_settings, services.endpoints, folder) as page:
            await page.is_served()
            others = await start_crowd(options, browsers, page_settings.hmi.port) if browsers else None
            await rig.run(scenario, recorder)
            rig.close()
            met = (await others.communicate())[0].decode().strip() if others else ""
    return recorder.link, met


async def start_crowd(options: argparse.Namespace, browsers: int, port: int) -> asyncio.subprocess.Process:
    """Start the browsers as a separate process; they leave before the run ends."""
    return await asyncio.create_subprocess_exec(
        sys.executable, __file__, "--address", f"http://127.0.0.1:{port}/", "--browsers", str(browsers),
        "--seconds", str(0.8 * options.seconds), stdout=subprocess.PIPE,
    )  # fmt: skip


async def main(options: argparse.Namespace) -> None:
    """Measure without the page, with it, and with browsers."""
    with tempfile.TemporaryDirectory() as folder:
        for browsers in (None, 0, options.browsers):
            link, met = await measure(options, browsers, Path(folder))
            who = "no page" if browsers is None else f"the page and {browsers} browsers"
            print(
                f"{who}: lateness p99 {link.lateness_p99_ms:.2f} ms, max {link.lateness_max_ms:.2f} ms, "
                f"{link.overruns} overruns, {link.deadline_misses} deadline misses. {met}",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--browsers", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=90.0, help="of each of the three runs, 15 or more")
    parser.add_argument("--address", help="be the browsers, of the page at this address")
    options = parser.parse_args()
    asyncio.run(crowd(options) if options.address else main(options))
