"""Does the control PLC follow a rack whose clock is off, for hours: breaks of the link, and the skew that it finds."""

import argparse
import asyncio
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from coldloop.config import load_configuration
from coldloop.modbus.client import RegisterClient
from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.registers import maps_of
from coldloop.registers.control_plc import PlantLinkState, PlantLinkStatus, Status
from coldloop.service.start import run_event_loop
from coldloop_plant.kinds import own_header
from coldloop_plant.load import find_load
from coldloop_rig.cosim.networked_run import LocalServices
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.cosim.wiring import START_PATIENCE_S
from coldloop_rig.settings import Settings

CONTROL_MAP = maps_of(COLD_BOX).control_plc


class Followed(NamedTuple):
    """How the link was at the end."""

    link: PlantLinkStatus
    status: Status
    lost: int
    """Looks that found the link out of step."""


async def follow(ppm: float, factor: float, hours: float, folder: Path) -> Followed:
    """Run a session with a rack whose clock is off."""
    settings = load_configuration(Settings, environment={}, assignments=[f"plant.clock_error_ppm={ppm}"]).settings
    ticks = round(hours * 3600 / TICK_S)
    load = find_load("8h", own_header(settings.model.file).w0, COLD_BOX)
    async with LocalServices(settings, folder) as services:
        rig = SessionClient(services.endpoints, settings)
        client = RegisterClient.at(CONTROL_MAP, services.endpoints.control_plc)

        async def work() -> Followed:
            await rig.connect(START_PATIENCE_S)
            await rig.start(Scenario(ticks, load, 0.0, 1, realtime=True, factor=factor))
            lost = 0
            while True:
                await asyncio.sleep(0.5)
                link = await client.read(PlantLinkStatus)
                lost += link.state != PlantLinkState.SYNCHRONISED
                if link.plant_tick >= ticks:
                    return Followed(link, await client.read(Status), lost)

        try:
            return await services.during(work())
        finally:
            rig.close()
            client.close()


def report(ppm: float, factor: float, hours: float) -> None:
    """Run one case, and print."""
    with tempfile.TemporaryDirectory() as folder:
        found: list[Followed] = []

        async def run() -> int:
            found.append(await follow(ppm, factor, hours, Path(folder)))
            return 0

        run_event_loop(run)
    link, status, lost = found[0]
    print(f"{ppm:+g} ppm, factor {factor:g}, {hours:g} h: skew found {link.skew:+.1f} +- {link.skew_error:.1f} ppm, "
          f"phase {link.offset:+.2f} ms, {link.breaks} breaks, {lost} readings not synchronised, "
          f"at tick {link.plant_tick}; "
          f"{status.deadline_misses} misses, lateness p99 {status.lateness_p99:.2f} ms", flush=True)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run each case, and print."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--ppm", type=float, action="append", help="may be repeated (default: 200, -200)")
    parser.add_argument("--factor", type=float, default=50.0)
    parser.add_argument("--hours", type=float, default=6.0, help="of plant time")
    options = parser.parse_args(arguments)
    for ppm in options.ppm or [200.0, -200.0]:
        report(ppm, options.factor, options.hours)


if __name__ == "__main__":
    main()
