"""Scan lateness in real time at factor 1, with and without a crowd that polls the control PLC; and who is too many.

With `--flood` another client sends requests without waiting for answers, as fast as they are accepted. Crowd
and flood have no role, unless `--with-role` is given.

    .venv/bin/python benchmarks/crowd.py --flood                                      # two minutes
    .venv/bin/python benchmarks/crowd.py --flood --clients 20 --seconds 20            # in short
"""

import argparse
import asyncio
import json
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from coldloop.config import load_configuration
from coldloop.modbus.client import RegisterClient
from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.process.lti_model import load as load_model
from coldloop.registers import maps_of
from coldloop.registers.common import ServerStatistics, WatchdogStatus
from coldloop.registers.control_plc import ProcessNow
from coldloop_plant.load import find_load
from coldloop_rig.cosim.networked_run import LocalServices
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.results.recording import LinkStatistics, Recorder
from coldloop_rig.settings import Settings

PLANT_MAP, CONTROL_MAP, _ = maps_of(COLD_BOX)

OURS = 4
"""Connections of the optimiser and of the rig, and one to spare for the look at the statistics."""
BLOCK = CONTROL_MAP.block_of(ProcessNow)
POLL = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, BLOCK.address, BLOCK.end - BLOCK.address)
ANSWER_BYTES = 9 + 2 * (BLOCK.end - BLOCK.address)
OURSELVES, STRANGER = "127.0.0.1", "127.0.0.2"
FLOOD = POLL * 5461
"""64 KB of requests."""


async def poll(port: int, source: str, period_s: float, phase_s: float, seconds: float) -> int:
    """Poll the process image; return the number of answers."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(source, 0))
    began = time.monotonic() + phase_s
    answers = 0
    while (due := began + answers * period_s) < began + seconds:
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        writer.write(POLL)
        await reader.readexactly(ANSWER_BYTES)
        answers += 1
    writer.close()
    return answers


async def flood(port: int, source: str, seconds: float) -> int:
    """Send requests without waiting for their answers; return the number of answers."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(source, 0))
    received = 0

    async def take() -> None:
        nonlocal received
        while data := await reader.read(1 << 18):
            received += len(data)

    taking = asyncio.create_task(take())
    try:
        async with asyncio.timeout(seconds):
            while True:
                writer.write(FLOOD)
                await writer.drain()
    except TimeoutError:
        writer.transport.abort()
    await taking
    return received // ANSWER_BYTES


async def crowd(options: argparse.Namespace) -> None:
    """Poll with all of them, and flood where asked to; print how many answers they got."""
    period_s = 1.0 / options.rate
    polls = [
        poll(options.port, options.source, period_s, number * period_s / options.clients, options.seconds)
        for number in range(options.clients)
    ]
    floods = [flood(options.port, options.source, options.seconds)] if options.flood else []
    answers = await asyncio.gather(*polls, *floods)
    print(f"{sum(answers[: len(polls)])} answers" + (f", {answers[-1]} to the flood" if floods else ""))


async def measure(options: argparse.Namespace, clients: int, logs: Path) -> tuple[LinkStatistics, str]:
    """Run the loop under so many clients; return its timing and the clients' results."""
    source = (OURSELVES if options.with_role else STRANGER, 0)
    ours = json.dumps([OURSELVES])
    roles = [f"control_plc.server.access.{role}={ours}" for role in ("control", "optimizer", "operator")]
    limit = f"control_plc.server.connection_limit={clients + OURS + options.flood}"
    settings = load_configuration(Settings, environment={}, assignments=[limit, *roles]).settings
    ticks = round(options.seconds / TICK_S)
    scenario = Scenario(ticks, find_load("a", load_model(settings.model.file).w0, COLD_BOX), 0.0, 1, realtime=True)
    recorder = Recorder(ticks)
    async with LocalServices(settings, logs) as services:
        rig = SessionClient(services.endpoints, settings)
        await rig.connect(60.0)
        others = await start_crowd(options, services.endpoints.control_plc.port) if clients else None
        run = asyncio.create_task(rig.run(scenario, recorder))
        met = await one_too_many(services, clients + options.flood, source) if clients else ""
        await run
        met = f"{met}{await watchdog_trips(services)}"
        rig.close()
        if others is not None:
            answers, _ = await others.communicate()
            met = f"{answers.decode().strip()}; {met}"
    return recorder.link, met


async def start_crowd(options: argparse.Namespace, port: int) -> asyncio.subprocess.ProcessNow:
    """Start the crowd as a separate process; it ends before the run does."""
    arguments = [
        sys.executable, __file__, "--port", str(port), "--clients", str(options.clients), "--rate", str(options.rate),
        "--seconds", str(0.8 * options.seconds), "--source", OURSELVES if options.with_role else STRANGER,
        *(["--flood"] if options.flood else []),
    ]  # fmt: skip
    return await asyncio.create_subprocess_exec(*arguments, stdout=subprocess.PIPE)


async def watchdog_trips(services: LocalServices) -> str:
    """Print how often the watchdogs of the rack and the control PLC have expired."""
    trips = []
    for register_map, endpoint in (
        (PLANT_MAP, services.endpoints.plant),
        (CONTROL_MAP, services.endpoints.control_plc),
    ):
        client = RegisterClient.at(register_map, endpoint)
        trips.append((await client.read(WatchdogStatus)).trips)
        client.close()
    return "watchdog trips: rack {}, control PLC {}".format(*trips)


async def one_too_many(services: LocalServices, clients: int, source: tuple[str, int]) -> str:
    """Fill the remaining connections, and print the result of the next one."""
    end = services.endpoints.control_plc
    statistics = RegisterClient.at(CONTROL_MAP, end)
    await asyncio.sleep(5.0)  # everyone has asked something by now
    before = await statistics.read(ServerStatistics)
    spare = [
        await asyncio.open_connection("127.0.0.1", end.port, local_addr=source)
        for _ in range(clients + OURS - before.connections)
    ]
    for _, writer in spare:
        writer.write(POLL)
    await asyncio.gather(*[reader.readexactly(ANSWER_BYTES) for reader, _ in spare])
    reader, writer = await asyncio.open_connection("127.0.0.1", end.port, local_addr=source)
    said = await reader.read()
    after = await statistics.read(ServerStatistics)
    for _, other in [*spare, (reader, writer)]:
        other.close()
    statistics.close()
    end_of_it = "closed" if not said else "answered"
    refused = after.connection_refused - before.connection_refused
    return f"with {after.connections} connections the next one was {end_of_it}, {refused} counted as refused; "


async def main(options: argparse.Namespace) -> None:
    """Measure without and with."""
    with tempfile.TemporaryDirectory() as folder:
        for clients in (0, options.clients):
            link, met = await measure(options, clients, Path(folder))
            flooded = " and a flood" if clients and options.flood else ""
            print(
                f"{clients} clients{flooded}: lateness p99 {link.lateness_p99_ms:.2f} ms, max "
                f"{link.lateness_max_ms:.2f} ms, {link.overruns} overruns, {link.deadline_misses} deadline misses. "
                f"{met}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--rate", type=float, default=10.0, help="polls a second of each client")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of the two runs, 15 or more")
    parser.add_argument("--flood", action="store_true", help="and one client that does not wait for its answers")
    parser.add_argument("--with-role", action="store_true", help="crowd and flood have all roles, and no request limit")
    parser.add_argument("--port", type=int, help="be the crowd, on this port")
    parser.add_argument("--source", default=STRANGER, help="address of the crowd")
    options = parser.parse_args()
    asyncio.run(crowd(options) if options.port else main(options))
