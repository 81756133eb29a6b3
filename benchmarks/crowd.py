"""Scan lateness in real time at factor 1, with and without a crowd that polls the control PLC; and who is too many."""

import argparse
import asyncio
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from coldloop.config import load_configuration
from coldloop.lti_model import load as load_model
from coldloop.modbus.client import RegisterClient
from coldloop.process import TICK_S
from coldloop.registers.common import ServerStatistics
from coldloop.registers.control_plc import CONTROL_MAP, Process
from plant.load import find_load
from rig.local_services import LocalServices
from rig.network import NetworkRig
from rig.recording import LinkStatistics, Recorder
from rig.scenario import Scenario
from rig.settings import Settings

OURS = 4
"""Connections of the optimiser and of the rig, and one to spare for the look at the statistics."""
BLOCK = CONTROL_MAP.block_of(Process)
POLL = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, BLOCK.address, BLOCK.end - BLOCK.address)
ANSWER_BYTES = 9 + 2 * (BLOCK.end - BLOCK.address)


async def poll(port: int, period_s: float, phase_s: float, seconds: float) -> int:
    """Poll the process image; return the number of answers."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    began = time.monotonic() + phase_s
    answers = 0
    while (due := began + answers * period_s) < began + seconds:
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        writer.write(POLL)
        await reader.readexactly(ANSWER_BYTES)
        answers += 1
    writer.close()
    return answers


async def crowd(port: int, clients: int, rate: float, seconds: float) -> None:
    """Poll with all of them; print how many answers they got."""
    period_s = 1.0 / rate
    polls = [poll(port, period_s, number * period_s / clients, seconds) for number in range(clients)]
    print(sum(await asyncio.gather(*polls)))


async def measure(seconds: float, clients: int, rate: float, logs: Path) -> tuple[LinkStatistics, str]:
    """Run the loop with so many clients beside it; return how well it kept time, and what the crowd met."""
    settings = load_configuration(
        Settings, environment={}, assignments=[f"control_plc.server.connection_limit={clients + OURS}"]
    ).settings
    ticks = round(seconds / TICK_S)
    scenario = Scenario(ticks, find_load("a", load_model(settings.model.file).w0), 0.0, 1, realtime=True)
    recorder = Recorder(ticks)
    async with LocalServices(settings, logs) as services:
        rig = NetworkRig(services.endpoints, settings)
        await rig.connect(60.0)
        port = services.endpoints.control_plc.port
        arguments = [sys.executable, __file__, "--port", str(port), "--clients", str(clients), "--rate", str(rate),
                     "--seconds", str(seconds - 10)]  # fmt: skip
        others = await asyncio.create_subprocess_exec(*arguments, stdout=subprocess.PIPE) if clients else None
        run = asyncio.create_task(rig.run(scenario, recorder))
        met = await one_too_many(services, clients) if clients else ""
        await run
        rig.close()
        if others is not None:
            answers, _ = await others.communicate()
            met = f"{answers.decode().strip()} answers; {met}"
    return recorder.link, met


async def one_too_many(services: LocalServices, clients: int) -> str:
    """Fill what is left of the connections, and tell what becomes of the next one."""
    end = services.endpoints.control_plc
    statistics = RegisterClient.at(CONTROL_MAP, end)
    await asyncio.sleep(5.0)  # everyone has asked something by now
    before = await statistics.read(ServerStatistics)
    spare = [await asyncio.open_connection("127.0.0.1", end.port) for _ in range(clients + OURS - before.connections)]
    for _, writer in spare:
        writer.write(POLL)
    await asyncio.gather(*[reader.readexactly(ANSWER_BYTES) for reader, _ in spare])
    reader, writer = await asyncio.open_connection("127.0.0.1", end.port)
    said = await reader.read()
    after = await statistics.read(ServerStatistics)
    for _, other in [*spare, (reader, writer)]:
        other.close()
    statistics.close()
    end_of_it = "closed" if not said else "answered"
    refused = after.connection_refused - before.connection_refused
    return f"with {after.connections} connections the next one was {end_of_it}, {refused} counted as refused"


async def main(options: argparse.Namespace) -> None:
    """Measure without and with."""
    with tempfile.TemporaryDirectory() as folder:
        for clients in (0, options.clients):
            link, met = await measure(options.seconds, clients, options.rate, Path(folder))
            print(
                f"{clients} clients: lateness p99 {link.lateness_p99_ms:.2f} ms, max {link.lateness_max_ms:.2f} ms, "
                f"{link.overruns} overruns, {link.deadline_misses} deadline misses. {met}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--rate", type=float, default=10.0, help="polls a second of each client")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--port", type=int, help="be the crowd, on this port")
    options = parser.parse_args()
    if options.port:
        asyncio.run(crowd(options.port, options.clients, options.rate, options.seconds))
    else:
        asyncio.run(main(options))
