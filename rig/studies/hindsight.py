"""The best sequence of updating periods in hindsight, by a beam search in the closed loop.

A recorded hour is cut at its load steps and `SETTLING_S` after each. In each segment the updating period is one of
`PERIODS_S`, and a load step always interrupts. A branch is the whole loop: plant, control PLC and optimiser. At the
end of each segment every branch of the beam is continued with every period, and of those whose last period is the same
the `WIDTH` of the lowest cost so far are kept: what a period does shows in the segment after it, so branches are not
compared with each other before. It is dynamic programming with the last period for a state, which the loop's state is
not: a search and no bound. What it gives is the cost of a sequence that exists, and another one may cost less.
"""

import copy
from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Final, Protocol, Self, TypeVar

from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load
from coldloop.process.signals import TICK_S, TICKS_PER_SAMPLE
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import PlantSample, StationSample
from control_plc.program import make_program as make_control_program
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.rules import make_rule
from plant.kinds import plant_maker
from plant.own_model import own_header
from rig.cosim.compiled.stretches import CompiledStretches
from rig.cosim.one_process import Programs, load_table
from rig.cosim.scenario import Scenario
from rig.results.indicators import StageCost
from rig.results.recording import Recorder, SampleBlock
from rig.settings import Settings

PERIODS_S: Final = (1.0, 1.5, 2.5, 5.0)
SETTLING_S: Final = 20.0
WIDTH: Final = 1


class Objective(StrEnum):
    """Cost to be minimised."""

    CLOSED_LOOP = "J_BF"
    OPEN_LOOP = "J_open_mean"


class SearchBranch(Protocol):
    """One candidate run of the search."""

    @property
    def cost(self) -> float:
        """Cost so far."""

    def fork(self) -> Self:
        """Return an independent copy."""

    def advance(self, choice: int, until: int) -> None:
        """Advance to the tick `until` with this choice."""


B = TypeVar("B", bound=SearchBranch)


def beam_search(root: B, choices: int, boundaries: Sequence[int], width: int) -> tuple[tuple[int, ...], B]:
    """Return the choices, one a segment, of the branch that costs least at the end, and this branch.

    Args:
        root: The beginning.
        choices: How many there are in each segment.
        boundaries: Tick at which each segment ends.
        width: Branches kept for each last choice; of equal ones those with the lower choices.
    """
    beam: list[tuple[tuple[int, ...], B]] = [((), root)]
    for until in boundaries:
        longer = []
        for choice in range(choices):
            alike = [((*taken, choice), branch.fork()) for taken, branch in beam]
            for _, branch in alike:
                branch.advance(choice, until)
            longer += sorted(alike, key=_cost_and_choices)[:width]
        beam = longer
    return min(beam, key=_cost_and_choices)


def _cost_and_choices(one: tuple[tuple[int, ...], SearchBranch]) -> tuple[float, tuple[int, ...]]:
    return one[1].cost, one[0]


def segment_ends(load_profile: LoadProfile, ticks: int) -> list[int]:
    """Return the tick at which each segment ends: load steps, `SETTLING_S` after each, and the end of the run.

    No segment is shorter than an updating period of 5 s may be.
    """
    settling = round(SETTLING_S / TICK_S)
    steps = [tick for tick in load_profile.times if tick < ticks]
    ends = sorted({*steps[1:], *(tick + settling for tick in steps)})
    kept = [tick for tick in ends if tick in steps or all(abs(tick - step) >= TICKS_PER_SAMPLE for step in steps)]
    return [*(tick for tick in kept if 0 < tick <= ticks - TICKS_PER_SAMPLE), ticks]


class LoopBranch:
    """The three programs in one process, with what they have cost so far."""

    def __init__(
        self,
        settings: Settings,
        scenario: Scenario,
        objective: Objective,
        recorder: Recorder | None = None,
        *,
        compiled: bool = True,
    ) -> None:
        header, model = own_header(settings.model.file), load(settings.model.file)
        program = settings.optimizer_plc.program
        self._programs = Programs(
            plant_maker(header, settings.plant)(load_table(scenario.load), scenario.seed),
            make_control_program(header, settings.control_plc, settings.limits),
            OptimizerProgram(model, program, settings.limits),
        )
        optimizer = self._programs.optimizer
        iterations = (optimizer.budget.iterations(round(period / TICK_S)) for period in PERIODS_S)
        self._rules = [make_rule(program, optimizer.budget, 0).fixed(q) for q in iterations]
        optimizer.restart(0.0, self._rules[0])
        self._programs.control.restart(session=1)
        self._sums = CostSums(StageCost(model, program.design), recorder)
        self._objective = objective
        self._load = load_table(scenario.load)
        self._compiled = compiled
        if recorder is not None:
            recorder.begin()

    @property
    def cost(self) -> float:
        """The objective, so far."""
        return self._sums.closed_loop if self._objective is Objective.CLOSED_LOOP else self._sums.open_loop

    def fork(self) -> Self:
        """Return a copy."""
        return copy.deepcopy(self)

    def advance(self, choice: int, until: int) -> None:
        """Advance to `until`; periods that begin from now on have this choice."""
        plant, control, optimizer = programs = self._programs
        optimizer.rule = self._rules[choice]
        stretches = CompiledStretches(plant, control, optimizer, self._load) if self._compiled else None
        while control.tick < until:
            stretch = stretches.ahead(until) if stretches else None
            if stretch is not None:
                self._sums.stretch(*stretch)
            else:
                programs.tick(self._sums)
        self._sums.settle()


class CostSums:
    """J_BF and J_open_mean of a run so far, as `rig.results.indicators` sums them at its end."""

    def __init__(self, stage_cost: StageCost, recorder: Recorder | None = None) -> None:
        self._stage_cost = stage_cost
        self._recorder = recorder
        self._samples: list[PlantSample] = []
        self._stage_costs = self._weighted = 0.0
        self._delivered = 0
        self._pending: Optimization | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return a copy; stage costs and records never change."""
        twin = copy.copy(self)
        twin._samples = self._samples.copy()  # noqa: SLF001 its own class
        return twin

    @property
    def closed_loop(self) -> float:
        """J_BF up to the last `settle`."""
        return self._stage_costs / TICKS_PER_SAMPLE

    @property
    def open_loop(self) -> float:
        """J_open_mean of the updates that were delivered and not cut off."""
        return self._weighted / self._delivered if self._delivered else 0.0

    def sample(self, sample: PlantSample) -> None:
        """Take a tick."""
        self._samples.append(sample)
        if self._recorder is not None:
            self._recorder.sample(sample)

    def station(self, sample: StationSample) -> None:
        """Pass on what the compression station does: it costs nothing here."""
        if self._recorder is not None:
            self._recorder.station(sample)

    def stretch(self, block: SampleBlock, updates: Sequence[Optimization]) -> None:
        """Take ticks in a row, and the updates among them."""
        self.settle()
        self._stage_costs += float(self._stage_cost.of(block).sum())
        for update in updates:
            self._count(update)
        if self._recorder is not None:
            self._recorder.stretch(block, updates)

    def settle(self) -> None:
        """Add up the ticks taken."""
        if self._samples:
            self._stage_costs += float(self._stage_cost.of(SampleBlock.of(self._samples)).sum())
            self._samples = []

    def update(self, update: Optimization) -> None:
        """Take an update."""
        self._count(update)
        if self._recorder is not None:
            self._recorder.update(update)

    def _count(self, update: Optimization) -> None:
        """Let an update count when the next one shows that it was not cut off."""
        last, self._pending = self._pending, update
        if last is not None and update.tick >= last.tick + last.tau_u:
            end = last.tick + last.tau_u
            self._weighted += (last.j_dev + last.j_cst) * (end - self._delivered)
            self._delivered = end


def run_best_in_hindsight(settings: Settings, scenario: Scenario, recorder: Recorder, objective: Objective) -> None:
    """Search the best sequence of periods of a scenario, then do this run once more for the record."""
    ends = segment_ends(scenario.load, scenario.ticks)
    root = LoopBranch(settings, scenario, objective)
    taken, _ = beam_search(root, len(PERIODS_S), ends, WIDTH)
    best = LoopBranch(settings, scenario, objective, recorder)
    for choice, until in zip(taken, ends, strict=True):
        best.advance(choice, until)
