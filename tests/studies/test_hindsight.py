"""The search for the best sequence of periods, and what its branches say that they cost."""

from dataclasses import dataclass, field
from itertools import product

import pytest

import rig.studies.hindsight
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load as load_model
from coldloop.process.signals import TICK_S
from coldloop.registers.optimizer_plc import Optimization
from optimizer_plc.qp.design import ControlDesign
from rig.cosim.scenario import Scenario
from rig.results.indicators import StageCost
from rig.settings import Settings
from rig.studies.hindsight import (
    PERIODS_S,
    CostSums,
    LoopBranch,
    Objective,
    beam_search,
    segment_ends,
)
from rig.studies.paper.updating_period import INTERRUPT
from rig.studies.request import Outcome, Procedure, perform
from rig.studies.settings import settings_of
from rig.studies.study import Load, StudyOptions, draw_of

NOTHING = Optimization(*[0] * len(Optimization._fields))
PRICES = {
    (): (5.0, 1.0, 4.0),
    (0,): (1.0, 1.0, 1.0),
    (1,): (9.0, 9.0, 9.0),
    (2,): (0.5, 3.0, 3.0),
    (0, 0): (0.0, 0.0, 0.0),
    (2, 0): (7.0, 7.0, 7.0),
}
"""What each choice costs after the choices before it; whatever is not written costs 2."""


@dataclass
class Toy:
    """A branch whose costs are written down."""

    taken: tuple[int, ...] = ()
    cost: float = 0.0
    ends: list[int] = field(default_factory=list)

    def fork(self) -> "Toy":
        return Toy(self.taken, self.cost, self.ends.copy())

    def advance(self, choice: int, until: int) -> None:
        self.cost += PRICES.get(self.taken, (2.0, 2.0, 2.0))[choice]
        self.taken += (choice,)
        self.ends.append(until)


def total(choices: tuple[int, ...]) -> float:
    toy = Toy()
    for choice in choices:
        toy.advance(choice, 0)
    return toy.cost


def test_the_cheapest_beginning_is_no_trap() -> None:
    """1 + 9 against 4 + 0.5: each choice of the first segment is continued with each of the second."""
    taken, branch = beam_search(Toy(), 3, [10, 20], 1)
    assert taken == (2, 0)
    assert branch.cost == 4.5
    assert branch.ends == [10, 20]


@pytest.mark.parametrize(
    ("width", "expected", "cost"),
    [
        (1, (0, 1, 0), 8.0),  # (2, 0) at 4.5 is kept and (0, 0) at 6 is not; (0, 1) at 6 goes on with 2, (2, 0) with 7
        (2, (0, 0, 0), 6.0),  # both are kept, and (0, 0) goes on for nothing
    ],
)
def test_what_was_dropped_too_early_is_found_by_a_wider_beam(
    width: int, expected: tuple[int, ...], cost: float
) -> None:
    taken, branch = beam_search(Toy(), 3, [10, 20, 30], width)
    assert taken == expected
    assert branch.cost == cost


def test_a_beam_that_holds_everything_finds_the_least_of_all_sequences() -> None:
    _, branch = beam_search(Toy(), 3, [1, 2, 3], 9)
    assert branch.cost == min(total(choices) for choices in product(range(3), repeat=3))


def test_segments_end_at_load_steps_and_twenty_seconds_after() -> None:
    """Steps at 100 and 170 ticks: 100 + 80 is 2.5 s behind the second one, too near to be an end of its own."""
    profile = LoadProfile((0, 100, 170), (400.0, 450.0, 380.0))
    assert segment_ends(profile, 1000) == [80, 100, 170, 250, 1000]
    assert segment_ends(profile, 260) == [80, 100, 170, 260]
    assert segment_ends(LoadProfile((0,), (400.0,)), 60) == [60]


def test_an_update_counts_by_the_time_since_the_last_one_that_was_delivered() -> None:
    """4 for 10 ticks, 8 for 5, one that a step cuts off, 2 for the time lost and its own 10: 100 over 30 ticks."""
    sums = CostSums(StageCost(load_model(Settings().model.file), ControlDesign()))
    for tick, tau_u, cost in ((0, 10, 4.0), (10, 5, 8.0), (15, 20, 99.0), (20, 10, 2.0), (30, 8, 50.0)):
        sums.update(NOTHING._replace(tick=tick, tau_u=tau_u, j_dev=cost - 1.0, j_cst=1.0))
    assert sums.open_loop == pytest.approx((4 * 10 + 8 * 5 + 2 * 15) / 30)


@pytest.fixture(scope="module")
def hour() -> Load:
    """Two minutes of the harshest hour."""
    return draw_of("e", 1, StudyOptions(ticks=640))


def scenario(load: Load) -> Scenario:
    return Scenario(load.ticks, load.profile, 0.0, load.draw)


@pytest.mark.parametrize("objective", list(Objective))
def test_a_branch_of_one_period_costs_what_the_run_with_it_costs(hour: Load, objective: Objective) -> None:
    choice = PERIODS_S.index(1.5)
    branch = LoopBranch(settings_of((INTERRUPT,)), scenario(hour), objective)
    for until in segment_ends(hour.profile, hour.ticks):
        branch = branch.fork()
        branch.advance(choice, until)
    run = Outcome.from_json(perform(hour.request(1.5, INTERRUPT))).indicators
    if objective is Objective.CLOSED_LOOP:
        assert branch.cost == pytest.approx(run.J_BF, rel=1e-6)
    else:
        assert branch.cost == pytest.approx(run.J_open_mean, rel=0.02), "but for the last updates, cut off by the end"


@pytest.mark.parametrize("objective", list(Objective))
def test_a_branch_in_compiled_loops_costs_what_it_costs_in_the_programs(hour: Load, objective: Objective) -> None:
    costs = []
    for compiled in (True, False):
        branch = LoopBranch(settings_of((INTERRUPT,)), scenario(hour), objective, compiled=compiled)
        for number, until in enumerate(segment_ends(hour.profile, hour.ticks)):
            branch = branch.fork()
            branch.advance(number % len(PERIODS_S), until)
        costs.append(branch.cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)


def test_forks_do_not_disturb_each_other(hour: Load) -> None:
    root = LoopBranch(settings_of(()), scenario(hour), Objective.CLOSED_LOOP)
    root.advance(0, 300)
    one, other = root.fork(), root.fork()
    one.advance(3, 600)
    other.advance(0, 600)
    root.advance(0, 600)
    assert other.cost == root.cost != one.cost


def test_the_best_sequence_of_two_segments_is_the_least_of_all(hour: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two segments the search drops nothing: it must find what trying all sixteen finds, and its run costs that."""
    ends = [200, 640]
    monkeypatch.setattr(rig.studies.hindsight, "segment_ends", lambda *_: ends)
    costs = []
    for choices in product(range(len(PERIODS_S)), repeat=2):
        branch = LoopBranch(settings_of((INTERRUPT,)), scenario(hour), Objective.CLOSED_LOOP)
        for choice, until in zip(choices, ends, strict=True):
            branch.advance(choice, until)
        costs.append(branch.cost)
    best = Outcome.from_json(perform(hour.request(0.0, INTERRUPT, procedure=Procedure.BEST_CLOSED_LOOP)))
    assert pytest.approx(min(costs), rel=1e-6) == best.indicators.J_BF
    assert min(costs) < max(costs)
    assert set(best.updates["tau_u"]) <= {period / TICK_S for period in PERIODS_S}
