"""One plan from beginning to end: run and record it, run the same without faults, evaluate."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from coldloop.config import Configuration
from coldloop.errors import LinkError
from coldloop.process.lti_model import load as load_model
from coldloop_optimizer_plc.qp.design import ControlDesign
from coldloop_rig.chaos.evaluation import Evaluation, evaluate
from coldloop_rig.chaos.plan import ChaosPlan
from coldloop_rig.chaos.runner import conduct
from coldloop_rig.chaos.sequencer import Progress
from coldloop_rig.chaos.trace import ChaosTrace
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Job, Scenario
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.results.recording import Recorder, Recording
from coldloop_rig.results.way import Way
from coldloop_rig.runs.running import run_into
from coldloop_rig.settings import Settings


class Experiment(NamedTuple):
    """What a plan has led to."""

    trace: ChaosTrace
    undisturbed: Recording
    evaluation: Evaluation
    design: ControlDesign
    """Has the bands that it was judged by."""
    failure: str | None
    """Why the run ended early, if it did."""


def perform(
    plan: ChaosPlan,
    effective: Configuration[Settings],
    folder: Path,
    progress: Progress,
    *,
    arguments: Mapping[str, Any],
    formats: Sequence[str],
) -> Experiment:
    """Run a plan into a folder that is claimed; a run that fails is evaluated as far as it went.

    Args:
        plan: What goes wrong in it.
        effective: Configuration of the services; what the plan has too is recorded with the plan's values.
        folder: Gets the files of an ordinary run.
        progress: Takes where the run is.
        arguments: Options of the command.
        formats: Of the run's figure.

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
    reference = undisturbed(settings, scenario)
    design = settings.optimizer_plc.program.design
    return Experiment(trace, reference, evaluate(trace, reference, settings.limits.rate, design), design, failure)


def undisturbed(settings: Settings, scenario: Scenario) -> Recording:
    """Return the same run without faults."""
    recorder = Recorder(scenario.ticks)
    OneProcessRig(settings).run(scenario, recorder)
    return recorder.recording()
