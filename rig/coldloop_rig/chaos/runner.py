"""Runs a plan: starts the rig behind proxies, and takes it from fault to fault."""

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

from coldloop.errors import LinkError
from coldloop_rig.chaos.faults import WrongModel
from coldloop_rig.chaos.injection import Injector
from coldloop_rig.chaos.models import WRONG_MODEL, save_wrong_model
from coldloop_rig.chaos.plan import ChaosPlan
from coldloop_rig.chaos.proxied_services import ProxiedServices
from coldloop_rig.chaos.sequencer import FaultSequencer, Progress
from coldloop_rig.chaos.trace import ChaosTrace
from coldloop_rig.cosim.scenario import Scenario, with_copied_load
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.cosim.wiring import START_PATIENCE_S
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

SLOWEST: Final = 20.0
"""Seconds of plant time in a second that lock-step should reach with proxies and all."""


async def conduct(
    plan: ChaosPlan,
    scenario: Scenario,
    settings: Settings,
    folder: Path,
    recorder: Recorder,
    trace: ChaosTrace,
    progress: Progress,
) -> None:
    """Run a plan on three services started for it; `trace`, a sink of the recorder, has what there was.

    Raises:
        LinkError: A service ended by itself, plant time stopped, or the run took too long.
    """
    if any(isinstance(fault, WrongModel) for fault in plan.schedule()):  # not while the clock is running
        await asyncio.to_thread(save_wrong_model, settings.model.file, folder / WRONG_MODEL)
    copied = with_copied_load(settings, scenario.load, folder)
    async with AsyncExitStack() as stack:
        proxied = await stack.enter_async_context(ProxiedServices(copied, folder, str(plan.seed)))
        services = proxied.services
        client = SessionClient(services.endpoints, settings, tolerant=True)
        stack.callback(client.close)
        await services.during(client.connect(START_PATIENCE_S))
        await proxied.connect_links()
        await services.during(client.begin(scenario, recorder))
        injector = Injector(services, proxied.proxies, client.plant, folder)
        driver = FaultSequencer(plan, services, client, injector, trace, progress)
        try:
            async with asyncio.timeout(_patience_s(plan)):
                await services.during(driver.run())
        except TimeoutError:
            raise LinkError(
                f"plan {plan.name} has taken {_patience_s(plan):.0f} s of real time and is at "
                f"{driver.tick * plan.process.tick_s:g} s: see the logs in {folder / 'logs'}"
            ) from None
        finally:
            driver.finish()
            await client.last_look()


def _patience_s(plan: ChaosPlan) -> float:
    schedule = plan.schedule()
    speed = SLOWEST if not plan.realtime else plan.factor / 2
    return 300.0 + plan.duration_s / speed + sum(60.0 + fault.duration_s / speed for fault in schedule)
