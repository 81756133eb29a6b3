"""One plan from beginning to end: run and record it, run the same without faults, evaluate."""

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

from coldloop.config import Configuration
from coldloop.errors import LinkError
from coldloop.process.lti_model import load as load_model
from coldloop_chaos.evaluation import ChaosTrace, Evaluation, evaluate
from coldloop_chaos.faults import WrongModel
from coldloop_chaos.plan import ChaosPlan
from coldloop_chaos.proxy import LinkProxies
from coldloop_chaos.sequencer import WRONG_MODEL, FaultSequencer, Injector, Progress, save_wrong_model
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.cosim.local_services import LocalServices
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Job, Scenario, with_copied_load
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.cosim.wiring import START_PATIENCE_S, retaining
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.results.recording import Recorder, Recording, Way
from coldloop_rig.runs.running import run_into
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
        links = LinkProxies(str(plan.seed))
        retained = retaining(copied, folder, always=True)
        services = await stack.enter_async_context(LocalServices(retained, folder / "logs", links=links))
        client = SessionClient(services.endpoints, settings, tolerant=True)
        stack.callback(client.close)
        await services.during(client.connect(START_PATIENCE_S))
        await links.connect()
        await services.during(client.begin(scenario, recorder))
        injector = Injector(services, links, client.plant, folder)
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


class Experiment(NamedTuple):
    """A plan, and what it has led to."""

    plan: ChaosPlan
    trace: ChaosTrace
    undisturbed: Recording
    evaluation: Evaluation
    design: ControlDesign
    """Has the bands that it was judged by."""
    failure: str | None
    """Reason why the run ended early; None if it did not."""


def perform(
    plan: ChaosPlan,
    effective: Configuration[Settings],
    folder: Path,
    progress: Progress,
    *,
    arguments: Mapping[str, Any],
    formats: Sequence[str],
) -> Experiment:
    """Run a plan into a folder that is claimed, and the same without faults; a run that fails is evaluated as it is.

    The values of the plan are recorded in the place of those of the configuration.

    Raises:
        LoadFileError: The load of the plan cannot be had.
        ColdloopError: The run was interrupted, or failed before its first tick.
    """
    settings = plan.with_plant(effective.settings)
    scenario = plan.scenario(load_model(settings.model.file).w0)
    trace = ChaosTrace(scenario.ticks, settings.process)
    failure = None

    async def conducted(recorder: Recorder, results: Path) -> None:
        await conduct(plan, scenario, settings, results, recorder, trace, progress)

    try:
        job = Job(plan.configured(effective), scenario, Way.CHAOS, conduct=conducted)
        with FigureProcess(formats) as figure:
            run_into(folder, job, arguments, figure, [trace])
    except LinkError as error:
        if trace.missing == trace.ticks:
            raise
        failure = str(error)
    alone = Recorder(scenario.ticks)
    OneProcessRig(settings).run(scenario, alone)
    undisturbed, design = alone.recording(), settings.optimizer_plc.program.design
    evaluation = evaluate(trace, undisturbed, settings.limits.rate, design)
    return Experiment(plan, trace, undisturbed, evaluation, design, failure)
