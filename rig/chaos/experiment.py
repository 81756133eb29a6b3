"""One plan from beginning to end: run it, run the same without faults, evaluate."""

from pathlib import Path
from typing import NamedTuple

from coldloop.errors import LinkError
from coldloop.lti_model import load as load_model
from coldloop.service import run_event_loop
from rig.chaos.evaluation import Evaluation, evaluate
from rig.chaos.plan import Plan
from rig.chaos.runner import conduct
from rig.chaos.sequencer import Progress
from rig.chaos.trace import ChaosTrace
from rig.one_process import OneProcessRig
from rig.recording import Recorder, Recording
from rig.scenario import Scenario
from rig.settings import Settings


class Experiment(NamedTuple):
    """What a plan has led to."""

    trace: ChaosTrace
    undisturbed: Recording
    evaluation: Evaluation
    failure: str | None
    """Why the run ended early, if it did."""


def perform(plan: Plan, settings: Settings, folder: Path, progress: Progress) -> Experiment:
    """Run a plan; a run that fails is evaluated as far as it went.

    Raises:
        LoadFileError: The load of the plan cannot be had.
    """
    scenario = plan.scenario(load_model(settings.model.file).w0)
    trace = ChaosTrace(scenario.ticks)
    failure = None
    try:
        run_event_loop(lambda: _conducted(plan, scenario, settings, folder, trace, progress))
    except LinkError as error:
        failure = str(error)
    reference = undisturbed(settings, scenario)
    return Experiment(trace, reference, evaluate(trace, reference, settings.limits.rate), failure)


async def _conducted(
    plan: Plan, scenario: Scenario, settings: Settings, folder: Path, trace: ChaosTrace, progress: Progress
) -> int:
    await conduct(plan, scenario, settings, folder, trace, progress)
    return 0


def undisturbed(settings: Settings, scenario: Scenario) -> Recording:
    """Return the same run without faults."""
    recorder = Recorder(scenario.ticks)
    OneProcessRig(settings).run(scenario, recorder)
    return recorder.recording()
