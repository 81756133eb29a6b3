"""Networked lock-step against the link alone: the same messages between as many processes, without programs."""

import argparse
import asyncio
import os
import sys
import tempfile
import time
from collections.abc import Awaitable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from bare_link import CONTROL, PLANT, client_of

from coldloop.operating.observer import SampleReader
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.lti_model import load
from coldloop.registers.control_plc import Grant
from coldloop.service.start import run_event_loop
from coldloop_plant.load import find_load
from coldloop_rig.cosim.networked_run import LocalServices
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import AHEAD, LONGEST_LOCKSTEP_PAUSE_S, SessionClient
from coldloop_rig.cosim.wiring import SERVICES, ReservedPorts
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

BARE_LINK = Path(__file__).with_name("bare_link.py")


class Cost(NamedTuple):
    """What a tick takes."""

    wall_us: float
    processor_us: Mapping[str, float]
    """By process."""

    def __str__(self) -> str:
        """Return it as a line."""
        each = ", ".join(f"{name} {time_us:.0f}" for name, time_us in self.processor_us.items())
        return f"{self.wall_us:.0f} us a tick; on the processor {sum(self.processor_us.values()):.0f} us ({each})"


def on_processor(pid: int) -> float:
    """Return the time (us) that a process has had on the processor so far (Linux)."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1000


async def cost(pids: Mapping[str, int], work: Awaitable[Any], ticks: int) -> Cost:
    """Return what so many ticks of work cost these processes."""
    before, start = {name: on_processor(pid) for name, pid in pids.items()}, time.perf_counter()
    await work
    elapsed = time.perf_counter() - start
    return Cost(elapsed * 1e6 / ticks, {name: (on_processor(pid) - before[name]) / ticks for name, pid in pids.items()})


async def real(scenario: Scenario) -> tuple[Cost, int]:
    """Return the cost of a run, and its updates."""
    settings = Settings()
    with tempfile.TemporaryDirectory() as folder:
        async with LocalServices(settings, Path(folder)) as services:
            rig, recorder = SessionClient(services.endpoints, settings), Recorder(scenario.ticks)

            async def work() -> Cost:
                await rig.connect(90.0)
                pids = {name: process.pid for name, process in services.processes.items()} | {"recorder": os.getpid()}
                return await cost(pids, rig.run(scenario, recorder), scenario.ticks)

            found = await services.during(work())
    return found, len(recorder.recording().updates)


async def bare(ticks: int, ticks_per_update: int, rows: int) -> Cost:
    """Return the cost of the same messages without programs."""
    ports = ReservedPorts(2)
    at_plant, at_control = ports.numbers
    numbers = ((at_plant,), (at_control, at_plant, ticks_per_update), (at_control, rows))
    processes = {
        service: await asyncio.create_subprocess_exec(
            sys.executable, BARE_LINK, service, *map(str, given), stdin=asyncio.subprocess.PIPE
        )
        for service, given in zip(SERVICES, numbers, strict=True)
    }
    plant, control = client_of(PLANT, at_plant), client_of(CONTROL, at_control)

    async def record(until: int) -> None:
        while reader.read_until < until:
            await control.write(Grant(min(ticks, reader.read_until + AHEAD)))
            await reader.read()
            await asyncio.sleep(LONGEST_LOCKSTEP_PAUSE_S)  # as a run does

    try:
        for client in (plant, control):
            await client.connect(60.0)
        reader = SampleReader(plant, Recorder(ticks), 1, ticks, realtime=False, tolerant=False)
        await record(min(200, ticks))  # the optimiser is there
        pids = {name: process.pid for name, process in processes.items()} | {"recorder": os.getpid()}
        return await cost(pids, record(ticks), ticks - reader.read_until)
    finally:
        for client in (plant, control):
            client.close()
        for process in processes.values():
            process.kill()
            await process.wait()
        ports.release()


async def measure(ticks: int, period_s: float) -> int:
    """Measure both, and print."""
    mean = load(Settings().model.file).w0
    whole, updates = await real(Scenario(ticks, find_load("2h", mean, COLD_BOX), period_s, seed=1))
    ticks_per_update = max(1, round(ticks / updates))
    link = await bare(ticks, ticks_per_update, rows=12)
    print(f"lock-step {whole}\nbare link {link}; an update every {ticks_per_update} ticks")
    shares = sum(link.processor_us.values()) / sum(whole.processor_us.values()), link.wall_us / whole.wall_us
    print("the link is {:.2f} of it on the processor, {:.2f} of its time".format(*shares))
    return 0


def main() -> None:
    """Read the options, and measure."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--ticks", type=int, default=14400)
    parser.add_argument("--updating-period", type=float, default=0.0, help="s; 0 is adaptive")
    options = parser.parse_args()
    run_event_loop(lambda: measure(options.ticks, options.updating_period))


if __name__ == "__main__":
    main()
