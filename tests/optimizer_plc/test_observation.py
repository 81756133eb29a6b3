"""What the program tells its updating rule, against costs computed here from matrices: in time, late, interrupted.

The optimiser's solver is one whose answers are known, its estimator believes the simulated state, and its rule notes
what it is told. Every update shows another state than the model predicts, so that no two costs are equal by chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import coldloop_optimizer_plc.program
from coldloop.kernels.compiled import kernel
from coldloop.process.cold_box import TICK_S
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Plan, Update
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from coldloop.safety.writers import InputSequence
from coldloop_optimizer_plc import solvers
from coldloop_optimizer_plc.computing_settings import EstimatorKind, EstimatorSettings
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.rules import Assessment, Observation, decides_by
from coldloop_optimizer_plc.settings import Preset, ProgramSettings

pytestmark = pytest.mark.usefixtures("compiles")

Array = NDArray[np.float64]

ALPHA = 50.0
FLOOR = 1.0
FIRST, NEXT, INTERRUPTED = 3, 4, 5
"""Iterations that the rule asks for: periods of 4, 5 and 6 ticks."""


def cost(qp: QuadraticProblem, z: Array) -> float:
    """J of a profile: its quadratic form, its penalties, the problem's constant and the floor."""
    excess = np.maximum(qp.Gamma @ z - qp.gamma, 0.0)
    return float(z @ qp.Phi @ z + qp.phi @ z + ALPHA * excess @ excess + qp.constant + FLOOR)


class KnownSolver:
    """Each iteration moves the knots of CV155 and of the heater by known amounts, later knots by more."""

    alpha, tau_1_s = ALPHA, 0.25
    move = np.concatenate([np.outer(np.arange(1, 8), [0.004, -0.03, 0.0]).ravel(), np.zeros(28)])

    def reset(self) -> None:
        pass

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> solvers.Answer:
        path = [np.clip(guess, problem.low, problem.high)]
        for _ in range(counts[-1]):
            path.append(np.clip(path[-1] + self.move, problem.low, problem.high))
        costs = [cost(problem, z) - problem.constant - FLOOR for z in path]
        chosen = list(counts)
        return solvers.Answer(costs[0], np.array(path)[chosen], np.array(costs)[chosen], np.array(chosen), np.zeros(94))


class NotingRule(NamedTuple):
    """Notes what it is told."""

    count: NDArray[np.int64]
    notes: Array

    @property
    def told(self) -> list[Observation]:
        rows = self.notes[: self.count[0]].tolist()
        return [Observation(int(q), int(iterations), *others) for q, iterations, *others in rows]

    @property
    def first(self) -> int:
        return FIRST

    @property
    def status(self) -> UpdatingRuleStatus:
        return UpdatingRuleStatus(UpdatingRuleKind.FIXED)

    def after_interruption(self) -> int:
        return INTERRUPTED


@decides_by(NotingRule)
@kernel
def decide(rule: NotingRule, memory: Array, o: Observation, a: Assessment) -> int:  # noqa: ARG001 a kernel
    note = rule.notes[rule.count[0]]
    note[0], note[1], note[2], note[3] = o.q, o.iterations, o.period_s, o.effective_before
    note[4], note[5], note[6], note[7] = o.hot_start, o.last_but_one, o.delivered, o.effective
    rule.count[0] += 1
    return NEXT


class Bench:
    """The program, and beside it all that it should know."""

    def __init__(self, model: LtiModel, problem: PredictiveProblem, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rule = NotingRule(np.zeros(1, np.int64), np.zeros((20, 8)))
        self.model, self.problem = model, problem
        monkeypatch.setattr(coldloop_optimizer_plc.program, "make_rule", lambda *_: self.rule)
        monkeypatch.setattr(coldloop_optimizer_plc.program, "make_solver", lambda _: KnownSolver())
        settings = ProgramSettings(
            preset=Preset.PAPER, interrupting_load_step_w=10.0,
            estimator=EstimatorSettings(kind=EstimatorKind.STATE_FEEDBACK),
        )  # fmt: skip
        self.program = OptimizerProgram(model, settings, InputLimits())
        self.program.restart(0.0)
        self.rule.count[0] = 0
        self._updates = 0

    def update(self, tick: int, playing: int, x: Array, watts: float = 0.0) -> Plan:
        """Latch an update with these deviations of state and load, and plan."""
        u, y = tuple(self.model.u0.tolist()), tuple(self.model.y0.tolist())
        latched = Update(
            1, self._updates, tick, playing, load=self.model.w0 + watts, u_before=u, u=u, y=y,
            x=tuple((self.model.x0 + x).tolist()),
        )  # fmt: skip
        self._updates += 1
        return self.program.plan(latched)

    def predicted(self, x: Array, watts: float, moves: "list[Array]") -> Array:
        """Return the state after a tick of each of these input deviations."""
        for u in moves:
            x = self.model.A_tick @ x + self.model.B_tick @ u + self.model.F_tick * watts
        return x

    def answer(self, x: Array, watts: float, u_before: Array, ticks: int, guess: Array, iterations: int) -> "Answer":
        """Return what the solver makes of a problem at a state, a load, an input before it and a guess."""
        qp = self.problem.at(QpParameters(x, watts, u_before, ticks))
        z = np.clip(guess, qp.low, qp.high)
        costs = [cost(qp, z)]
        for _ in range(iterations):
            z = np.clip(z + KnownSolver.move, qp.low, qp.high)
            costs.append(cost(qp, z))
        return Answer(z, costs[0], costs[-2], costs[-1], u_before, ticks)

    def reached(self, answer: "Answer", z: Array, x: Array, watts: float = 0.0) -> float:
        """Return J of a profile, in the situation of its answer, at another state and load."""
        return cost(self.problem.at(QpParameters(x, watts, answer.u_before, answer.ticks)), z)


@dataclass(frozen=True)
class Answer:
    """What a solve should have come to."""

    z: Array
    hot_start: float
    last_but_one: float
    delivered: float
    u_before: Array
    ticks: int


@pytest.fixture
def bench(model: LtiModel, problem: PredictiveProblem, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(model, problem, monkeypatch)


@pytest.fixture
def states(model: LtiModel) -> list[Array]:
    """Five states, some hundred pascal, tenths of a per cent and tenths of a kelvin away."""
    rng = np.random.default_rng(31)
    scale = np.full(len(model.x0), 0.3)
    scale[0], scale[1] = 300.0, 0.2 / model.C[0, 1]
    return [scale * rng.normal(size=len(scale)) for _ in range(5)]


AT_REST = np.zeros(3)
NOTHING = np.zeros(49)


def played(model: LtiModel, sequence: InputSequence, ticks: range) -> list[Array]:
    """Return the input deviations that a sequence has for these ticks, as the bus carries them."""
    return [np.array(sequence.rows[tick - sequence.header.first_tick]) - model.u0 for tick in ticks]


def told(observation: Observation) -> list[float]:
    o = observation
    return [o.effective_before, o.hot_start, o.last_but_one, o.delivered, o.effective]


def test_at_rest_every_cost_is_the_floor(bench: Bench) -> None:
    """All deviations are zero: the hot start costs nothing, and the first answer is what the solver's move costs."""
    still = np.zeros_like(bench.model.x0)
    assert bench.update(0, 0, still).next_update_tick == 4, "a slot and three iterations of a tick each"
    bench.program.solve()
    bench.update(4, 1, still)
    (o,) = bench.rule.told
    assert (o.iterations, o.period_s) == (FIRST, 4 * TICK_S)
    assert (o.effective_before, o.hot_start) == (1.0, 1.0)
    qp = bench.problem.at(QpParameters(still, 0.0, AT_REST, 4))
    assert [o.last_but_one, o.delivered] == pytest.approx(
        [cost(qp, 2 * KnownSolver.move), cost(qp, 3 * KnownSolver.move)]
    )
    assert o.effective == pytest.approx(o.delivered, rel=1e-6), "the plant is where the model said"


def test_in_time_the_five_costs_are_those_of_the_paper(bench: Bench, states: list[Array]) -> None:
    model, problem = bench.model, bench.problem
    bench.update(0, 0, states[0], 5.0)
    first = bench.program.solve()
    there = bench.predicted(states[0], 5.0, [AT_REST] * 4)
    one = bench.answer(there, 5.0, AT_REST, 4, NOTHING, FIRST)
    bench.update(4, 1, states[1], 5.0)
    before = cost(problem.at(QpParameters(states[0], 5.0, AT_REST)), NOTHING)
    expected = [before, one.hot_start, one.last_but_one, one.delivered, bench.reached(one, one.z, states[1], 5.0)]
    assert told(bench.rule.told[0]) == pytest.approx(expected, rel=1e-9)

    bench.program.solve()
    moves = played(model, first, range(4, 9))
    two = bench.answer(bench.predicted(states[1], 5.0, moves), 5.0, moves[-1], 5, problem.shifted(one.z, 5), NEXT)
    bench.update(9, 2, states[2], 5.0)
    assert (bench.rule.told[1].iterations, bench.rule.told[1].period_s) == (NEXT, 1.25)
    expected = [
        bench.reached(one, one.z, states[1], 5.0), two.hot_start, two.last_but_one, two.delivered,
        bench.reached(two, two.z, states[2], 5.0),
    ]  # fmt: skip
    assert told(bench.rule.told[1]) == pytest.approx(expected, rel=1e-6)
    assert len({round(value, 6) for value in expected}) == 5, "none of them equals another by chance"


def test_an_answer_that_came_late_teaches_nothing_and_the_old_profile_goes_on_shifted(
    bench: Bench, states: list[Array]
) -> None:
    model, problem = bench.model, bench.problem
    bench.update(0, 0, states[0])
    first = bench.program.solve()
    one = bench.answer(bench.predicted(states[0], 0.0, [AT_REST] * 4), 0.0, AT_REST, 4, NOTHING, FIRST)
    bench.update(4, 1, states[1])
    bench.program.solve()
    bench.update(9, 1, states[2])  # the control PLC still plays the first sequence: the second came late
    assert len(bench.rule.told) == 1
    bench.program.solve()
    bench.update(14, 3, states[3])
    old = problem.shifted(one.z, 5)
    moves = played(model, first, range(9, 14))
    three = bench.answer(bench.predicted(states[2], 0.0, moves), 0.0, moves[-1], 5, problem.shifted(old, 5), NEXT)
    expected = [
        bench.reached(one, old, states[2]), three.hot_start, three.last_but_one, three.delivered,
        bench.reached(three, three.z, states[3]),
    ]  # fmt: skip
    assert bench.rule.told[1].iterations == NEXT, "the late period was repeated"
    assert told(bench.rule.told[1]) == pytest.approx(expected, rel=1e-6)


def test_a_load_step_cuts_a_period_off_and_the_next_one_begins_with_what_was_left(
    bench: Bench, states: list[Array]
) -> None:
    model, problem = bench.model, bench.problem
    bench.update(0, 0, states[0])
    first = bench.program.solve()
    one = bench.answer(bench.predicted(states[0], 0.0, [AT_REST] * 4), 0.0, AT_REST, 4, NOTHING, FIRST)
    bench.update(4, 1, states[1])
    bench.program.solve()
    plan = bench.update(6, 1, states[2], 20.0)
    assert len(bench.rule.told) == 1, "the period that was cut off teaches nothing"
    assert plan.next_update_tick == 12, "a slot and five iterations"
    assert plan.load_step == 0.0, "it is not cut off again"
    bench.program.solve()
    bench.update(12, 3, states[3], 20.0)
    left = problem.shifted(one.z, 2)
    moves = played(model, first, range(6, 12))
    three = bench.answer(
        bench.predicted(states[2], 20.0, moves), 20.0, moves[-1], 6, problem.shifted(left, 6), INTERRUPTED
    )
    expected = [
        bench.reached(one, left, states[2], 20.0), three.hot_start, three.last_but_one, three.delivered,
        bench.reached(three, three.z, states[3], 20.0),
    ]  # fmt: skip
    assert (bench.rule.told[1].iterations, bench.rule.told[1].period_s) == (INTERRUPTED, 1.5)
    assert told(bench.rule.told[1]) == pytest.approx(expected, rel=1e-6)


def test_an_instant_that_came_late_finds_the_profile_that_far_on(bench: Bench, states: list[Array]) -> None:
    """Scans were missed: the sequence of tick 4 began there, and the update was latched two ticks after."""
    model, problem = bench.model, bench.problem
    bench.update(0, 0, states[0])
    first = bench.program.solve()
    one = bench.answer(bench.predicted(states[0], 0.0, [AT_REST] * 4), 0.0, AT_REST, 4, NOTHING, FIRST)
    bench.update(6, 1, states[1])
    assert bench.rule.told == [], "a period of another length than planned teaches nothing"
    bench.program.solve()
    bench.update(10, 2, states[2])
    on = problem.shifted(one.z, 2)
    moves = played(model, first, range(6, 10))
    two = bench.answer(bench.predicted(states[1], 0.0, moves), 0.0, moves[-1], 4, problem.shifted(on, 4), FIRST)
    expected = [
        bench.reached(one, on, states[1]), two.hot_start, two.last_but_one, two.delivered,
        bench.reached(two, two.z, states[2]),
    ]  # fmt: skip
    assert told(bench.rule.told[0]) == pytest.approx(expected, rel=1e-6)


def test_after_others_have_driven_nothing_is_told_of_before(bench: Bench, states: list[Array]) -> None:
    bench.update(0, 0, states[0])
    bench.program.solve()
    bench.update(4, 1, states[1])
    bench.program.solve()
    bench.update(9, 77, states[2])  # a sequence that was never ours
    assert len(bench.rule.told) == 1
    bench.program.solve()
    bench.update(13, 78, states[3])
    assert bench.rule.told[1].iterations == FIRST
    hold = cost(bench.problem.at(QpParameters(states[2], 0.0, AT_REST)), bench.problem.hold(AT_REST))
    assert bench.rule.told[1].effective_before == pytest.approx(hold)
