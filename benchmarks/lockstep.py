"""Ticks a second of the networked loop in lock-step, against the bare exchange with the plant's rack."""

import argparse
import os
import tempfile
import time
from pathlib import Path

from coldloop.modbus.client import RegisterClient
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.lti_model import load
from coldloop.registers.maps import maps_of
from coldloop.registers.plant import Actuators, Measurement
from coldloop.service.start import run_event_loop
from coldloop_plant.load import find_load
from coldloop_rig.cosim.local_services import LocalServices
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

PLANT_MAP = maps_of(COLD_BOX).plant


async def bare_exchanges(port: int, count: int) -> float:
    """Return exchanges a second with a rack that answers without moving: they are of another session than its own."""
    client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=port, timeout_s=5.0)
    await client.connect(10.0)
    nothing = Actuators(0, (43.0, 75.0, 36.0), session=0xFFFF_FFFF)
    start = time.perf_counter()
    for _ in range(count):
        await client.exchange(nothing, Measurement)
    elapsed = time.perf_counter() - start
    client.close()
    return count / elapsed


def on_processor(pid: int) -> float:
    """Return the time (us) that a process has had on the processor so far (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * 1e6 / os.sysconf("SC_CLK_TCK")


async def measure(ticks: int, period_s: float) -> int:
    """Measure both on one rig, and print."""
    settings = Settings()
    mean = load(settings.model.file).w0
    scenario = Scenario(ticks, find_load("2h", mean, COLD_BOX), period_s, seed=1)
    with tempfile.TemporaryDirectory() as folder:
        async with LocalServices(settings, Path(folder)) as services:
            rig = SessionClient(services.endpoints, settings)

            async def work() -> tuple[float, float, dict[str, float]]:
                await rig.connect(90.0)
                pids = {name: process.pid for name, process in services.processes.items()} | {"recorder": os.getpid()}
                bare = await bare_exchanges(services.endpoints.plant.port, ticks)
                recorder = Recorder(ticks)
                before = {name: on_processor(pid) for name, pid in pids.items()}
                await rig.run(scenario, recorder)
                busy = {name: (on_processor(pid) - before[name]) / ticks for name, pid in pids.items()}
                return bare, ticks / recorder.wall_seconds, busy

            bare, loop, busy = await services.during(work())
    print(f"bare exchange {bare:.0f}/s, lock-step {loop:.0f} ticks/s: ratio {loop / bare:.2f}")
    print("on the processor a tick:", ", ".join(f"{name} {time_us:.0f} us" for name, time_us in busy.items()))
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
