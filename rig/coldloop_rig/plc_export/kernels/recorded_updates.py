"""Updates of runs with the plans and sequences that the optimiser answers: golden vectors of the whole of it."""

from typing import NamedTuple

from coldloop.errors import UsageError
from coldloop.process.lti_model import load as load_model
from coldloop.registers.codec import as_transmitted
from coldloop.registers.control_plc import Plan, Update, control_map
from coldloop.safety.sequence import InputSequence
from coldloop_optimizer_plc.computing_settings import Arithmetic
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.rules import UpdatingRule
from coldloop_optimizer_plc.settings import ProgramSettings
from coldloop_plant.load import find_load
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings


class GoldenUpdate(NamedTuple):
    """An update with what it was answered by."""

    fixed_ticks: int
    """Of a session that begins with it; -1 in a session."""
    update: Update
    plan: Plan
    sequence: InputSequence | None
    """None if it was interrupted before."""


def integers_of(golden: GoldenUpdate) -> tuple[int, ...]:
    """Return its integers: session, update, plan, header of the sequence, which is 0 if there is none."""
    update, plan = golden.update, golden.plan
    sent = golden.sequence.header if golden.sequence else None
    answered = (sent.number, sent.first_tick, sent.tau_u, sent.length) if sent else (0, 0, 0, 0)
    return (golden.fixed_ticks, update.update, update.tick, update.playing, plan.next_update_tick, plan.suspects,
            *answered)  # fmt: skip


def reals_of(golden: GoldenUpdate) -> tuple[float, ...]:
    """Return its numbers with a point, without the rows of the sequence."""
    update, plan = golden.update, golden.plan
    return (update.load, *update.u_before, *update.u, *update.y, *update.x, plan.load_step, plan.shortage)


def refuse(settings: ProgramSettings) -> None:
    """Refuse what cannot be exported.

    Raises:
        UsageError: It is asked for.
    """
    if settings.arithmetic is not Arithmetic.FLOAT32:
        raise UsageError("export plc: in single precision alone: --set optimizer_plc.program.arithmetic=float32")


class _ListeningOptimizer(OptimizerProgram):
    """Keeps every update with its answers."""

    def restart(self, updating_period_s: float, rule: UpdatingRule | None = None) -> None:
        """Reset."""
        self.heard: list[GoldenUpdate] = []
        self._begun = round(updating_period_s / self.process.tick_s)
        super().restart(updating_period_s, rule)

    def plan(self, update: Update) -> Plan:
        """Keep the update and its plan."""
        plan = super().plan(update)
        self.heard.append(GoldenUpdate(self._begun, update, as_transmitted(plan, control_map(self.process)), None))
        self._begun = -1
        return plan

    def solve(self) -> InputSequence:
        """Keep the sequence."""
        sequence = super().solve()
        self.heard[-1] = self.heard[-1]._replace(sequence=sequence)
        return sequence


class UpdateRecorder:
    """Records runs of an optimiser that can be exported.

    Args:
        settings: Of the run.

    Raises:
        UsageError: They ask for something that is not exported.
    """

    def __init__(self, settings: Settings) -> None:
        refuse(settings.optimizer_plc.program)
        self.model = load_model(settings.model.file)
        self.optimizer = _ListeningOptimizer(self.model, settings.optimizer_plc.program, settings.limits)
        self._rig = OneProcessRig(settings, compiled=False)
        self._rig.optimizer = self.optimizer

    def record(self, ticks: int, load: str, updating_period_s: float) -> list[GoldenUpdate]:
        """Return the updates of a run of so many ticks under a named load."""
        scenario = Scenario(ticks, find_load(load, self.model.w0, self.optimizer.process), updating_period_s, seed=1)
        self._rig.run(scenario, Recorder(ticks, []))
        return self.optimizer.heard
