"""Runs a plan: starts the rig behind proxies, and takes it from fault to fault."""

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

from coldloop.config import PREFIX
from coldloop.errors import LinkError
from coldloop.process import TICK_S
from rig.chaos.faults import Link, WrongModel
from rig.chaos.injection import Injector
from rig.chaos.models import WRONG_MODEL, save_wrong_model
from rig.chaos.plan import Plan
from rig.chaos.proxy import LinkProxy
from rig.chaos.sequencer import FaultSequencer, Progress
from rig.chaos.trace import ChaosTrace
from rig.local_services import LocalServices
from rig.ports import ReservedPorts
from rig.recording import Recorder
from rig.scenario import Scenario
from rig.session_client import SessionClient
from rig.settings import Settings
from rig.wiring import START_PATIENCE_S, Detours

SLOWEST: Final = 20.0
"""Seconds of plant time in a second that lock-step should reach with proxies and all."""


async def conduct(
    plan: Plan,
    scenario: Scenario,
    settings: Settings,
    folder: Path,
    recorder: Recorder,
    trace: ChaosTrace,
    progress: Progress,
) -> None:
    """Run a plan on three services started for it; `trace`, a sink of the recorder, has what there was.

    Raises:
        LinkError: A service ended by itself, the rig stood still, or it all took too long.
    """
    if any(isinstance(fault, WrongModel) for fault in plan.schedule()):  # not while the clock is running
        await asyncio.to_thread(save_wrong_model, settings.model.file, folder / WRONG_MODEL)
    async with AsyncExitStack() as stack:
        reserved = stack.enter_context(ReservedPorts(len(Detours._fields)))
        detours = Detours(*reserved.numbers)
        services = LocalServices(settings, folder / "logs", detours=detours, environment=_retained(folder))
        proxies = {
            Link.PLANT: LinkProxy(detours.plant, services.endpoints.plant.port, f"{plan.seed}/plant"),
            Link.OPTIMIZER: LinkProxy(
                detours.control_plc, services.endpoints.control_plc.port, f"{plan.seed}/optimizer"
            ),
        }
        await stack.enter_async_context(services)
        client = SessionClient(services.endpoints, settings, tolerant=True)
        stack.callback(client.close)
        await services.during(client.connect(START_PATIENCE_S))
        for proxy in proxies.values():  # until now nobody listened there, as nobody did behind
            await proxy.start()
            stack.push_async_callback(proxy.close)
        await services.during(client.begin(scenario, recorder))
        injector = Injector(services, proxies, client, folder)
        driver = FaultSequencer(plan, services, client, injector, trace, progress)
        try:
            async with asyncio.timeout(_patience_s(plan)):
                await services.during(driver.run())
        except TimeoutError:
            raise LinkError(
                f"plan {plan.name} has taken {_patience_s(plan):.0f} s of real time and stands at "
                f"{driver.tick * TICK_S:g} s: see the logs in {folder / 'logs'}"
            ) from None
        finally:
            driver.finish()
            await client.last_look()


def _retained(folder: Path) -> dict[str, str]:
    """Return the variables that let the control PLC and the plant come back where they were killed."""
    files = {service: folder / f"retained_{service}.json" for service in ("control_plc", "plant")}
    for file in files.values():
        file.unlink(missing_ok=True)
    return {f"{PREFIX}{service.upper()}__RETAIN__FILE": str(file) for service, file in files.items()}


def _patience_s(plan: Plan) -> float:
    schedule = plan.schedule()
    speed = SLOWEST if not plan.realtime else plan.factor / 2
    return 300.0 + plan.duration_s / speed + sum(60.0 + fault.duration_s / speed for fault in schedule)
