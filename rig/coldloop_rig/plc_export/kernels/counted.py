"""Operations of the calls of an export, counted by executing what is printed (`tree/counting.py`)."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_control_plc.output_limits import GuardState, Limits, beginning
from coldloop_optimizer_plc.computing_settings import Arithmetic
from coldloop_optimizer_plc.decisions import Latched
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.arithmetic import real_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QuadraticProblem
from coldloop_optimizer_plc.session_state import OptimizerState, empty_state
from coldloop_optimizer_plc.settings import ProgramSettings
from coldloop_optimizer_plc.solvers.interface import Costs
from coldloop_optimizer_plc.solvers.ode import OdeMethod, ode_solver
from coldloop_rig.plc_export.kernels.golden_calls import Call, GoldenCall
from coldloop_rig.plc_export.kernels.guard_program import GuardKernels
from coldloop_rig.plc_export.kernels.ode_program import Array, OdeProgram
from coldloop_rig.plc_export.kernels.optimizer_program import OptimizerKernels
from coldloop_rig.plc_export.kernels.recorded_problems import ITERATIONS, GoldenVector
from coldloop_rig.plc_export.kernels.recorded_updates import GoldenUpdate
from coldloop_rig.plc_export.tree.counting import CountedProgram

REAL: Final = real_of(Arithmetic.FLOAT32)
NEAR: Final = REAL(0.01)
"""Of the bounds to the guess, where they are to cut a step."""
FAR: Final = REAL(1e6)
"""Of bounds and rows that have no effect."""
COUNTS: Final = np.arange(1, ITERATIONS + 1)
ITERATION: Final = "descend"
"""The kernel that a call does one iteration by."""


class CallCounts(NamedTuple):
    """Operations of a call of one kind."""

    least: int
    mean: float
    most: int
    """Least, mean and most of the recorded calls."""


class IterationCounts(NamedTuple):
    """Operations of a call that does one iteration."""

    unconstrained: int
    """No row is active, no bound is reached."""
    recorded: CallCounts
    worst: int
    """Every row is active at each point, no variable is held, a bound cuts the step, and the step is taken."""
    total: int
    """Of all recorded ones."""


class Counter:
    """Counts iterations of the solver for the matrices of one problem.

    Args:
        method: Constants of the solver, in single precision.
        problem: One of the problems.
    """

    def __init__(self, method: OdeMethod, problem: QuadraticProblem) -> None:
        self.method, self.problem = method, problem
        ode = OdeProgram(method, problem, COUNTS)
        self._entry, self._program = ode.entry.name, CountedProgram(ode.functions)
        self._noted = self._program.noting(ITERATION)

    def iterations(self, problem: QuadraticProblem, guess: Array) -> list[int]:
        """Return the operations of `ITERATIONS` iterations, each of which is a call."""
        self._noted.clear()
        none = Costs(REAL(np.inf), REAL(np.inf))
        room = (np.zeros((ITERATIONS, len(guess)), REAL), np.zeros(ITERATIONS, REAL), np.zeros_like(COUNTS))
        self._program[self._entry](self.method, problem, guess, COUNTS, none, *room)
        return list(self._noted)

    def unconstrained(self) -> int:
        """Return the operations of an iteration without active rows and bounds."""
        return self._constructed(FAR, FAR)

    def worst(self) -> int:
        """Return the operations of an iteration that does all that an iteration can do."""
        return self._constructed(-FAR, NEAR)

    def _constructed(self, rows: float, bounds: float) -> int:
        qp = self.problem
        n, gamma = len(qp.phi), np.full(len(qp.gamma), rows, REAL)
        guess, high = np.zeros(n, REAL), np.full(n, bounds, REAL)
        return max(self.iterations(qp._replace(gamma=gamma, low=-high, high=high), guess))


def counted_iterations(method: OdeMethod, vectors: Sequence[GoldenVector]) -> IterationCounts:
    """Return the operations of an iteration; the recorded ones are those of golden vectors."""
    counter = Counter(method, vectors[0].problem)
    found = [one for each in vectors for one in counter.iterations(each.problem, each.guess)]
    return IterationCounts(counter.unconstrained(), counts_of(found), counter.worst(), sum(found))


def counter_of(problem: PredictiveProblem, program: ProgramSettings) -> Counter:
    """Return what counts the iterations of the ODE-based solver for a problem in single precision."""
    method = ode_solver(program.ode, program.penalties).method
    m, zero = len(problem.Gamma), np.zeros(problem.size, REAL)
    qp = QuadraticProblem(problem.Phi, zero, problem.Gamma, np.zeros(m, REAL), zero, zero, REAL(0.0))
    return Counter(method(qp), qp)


def counts_of(found: Sequence[int]) -> CallCounts:
    """Return least, mean and most."""
    return CallCounts(min(found), sum(found) / len(found), max(found))


def _empty(optimizer: OptimizerProgram) -> OptimizerState:
    state, process = optimizer.state, optimizer.process
    return empty_state(len(state.belief.x), len(process.inputs), len(process.outputs), len(state.sent.z), REAL)


def counted_updates(optimizer: OptimizerProgram, golden: Iterable[GoldenUpdate]) -> Mapping[str, CallCounts]:
    """Return the operations of the calls that golden updates take beside the iterations: plan, start, finish."""
    kernels = OptimizerKernels(optimizer)
    begin, take, solve, _ = (each.name for each in kernels.entries)
    program = CountedProgram(kernels.functions)
    c, method = kernels.constants["constants"], kernels.constants["method"]
    state = _empty(optimizer)
    noted = {name: program.noting(name) for name in (take, "pose", "warm_start", "deliver")}
    for each in golden:
        if each.fixed_ticks >= 0:
            c = c._replace(fixed_ticks=each.fixed_ticks)
            state = _empty(optimizer)
            program[begin](c, state)
        program[take](c, kernels.rules[c.fixed_ticks], kernels.starts[c.fixed_ticks], state, latched(each))
        if each.sequence:
            program[solve](c, method, state)
    starts = [sum(both) for both in zip(noted["pose"], noted["warm_start"], strict=True)]
    calls = {"plan": noted[take], "start": starts, "finish": noted["deliver"]}
    return {name: counts_of(found) for name, found in calls.items()}


def counted_guard(kernels: GuardKernels, golden: Iterable[GoldenCall]) -> Mapping[str, CallCounts]:
    """Return the operations of the scans and judgements of golden calls of the output guard."""
    program, limits = CountedProgram(kernels.functions, np.float64), kernels.limits
    begin, resume, scan, judge, _ = (each.name for each in kernels.entries)
    state, twin = _guard_state(limits), _guard_state(limits)
    noted = {"scan": program.noting(scan), "judgement": program.noting(judge)}
    for each in golden:
        given = np.array(each.given)
        match each.call:
            case Call.RESTART:
                program[begin](state, limits, given)
            case Call.SCAN:
                program[scan](state, limits, each.tick, given, each.update)
            case Call.RESUME:
                program[resume](state, limits, each.tick, given)
            case Call.JUDGE:
                before, rows = np.array(each.meanwhile), np.array(each.rows)
                ahead = (each.tick, before, 0, len(before), each.first_tick)
                program[judge](state, twin, limits, *ahead, rows, len(rows))
    return {name: counts_of(found) for name, found in noted.items()}


def counted_longest(kernels: GuardKernels) -> int:
    """Return the operations of the judgement of the longest sequence after another one, all rows of which move."""
    program, limits = CountedProgram(kernels.functions, np.float64), kernels.limits
    low, high, rate = map(np.array, (limits.low, limits.high, limits.rate))
    middle, step = (low + high) / 2, np.minimum(rate, high - low) / 1000
    rows = (middle + np.outer(np.arange(2 * SEQUENCE_ROWS + 1) % 2, step)).astype(np.float32).astype(float)
    state, twin = _guard_state(limits), _guard_state(limits)
    program[kernels.begin.name](state, limits, rows[0])
    program.operations()
    meanwhile, offered = rows[1 : SEQUENCE_ROWS + 1], rows[SEQUENCE_ROWS + 1 :]
    ahead = (0, meanwhile, 0, SEQUENCE_ROWS, SEQUENCE_ROWS)
    assert program[kernels.judge.name](state, twin, limits, *ahead, offered, SEQUENCE_ROWS)  # noqa: S101 by construction
    return program.operations()


def _guard_state(limits: Limits) -> GuardState:
    """Return a state of the output guard whose rows are arrays."""
    state = beginning(limits, limits.low)
    for name in ("applied", "anchor", "coming", "moves", "before"):
        setattr(state, name, np.array(getattr(state, name)))
    return state


def latched(golden: GoldenUpdate) -> Latched:
    """Return an update as the kernels take it."""
    update = golden.update
    u_before, u, y, x, ahead = (np.array(each, REAL) for each in (update.u_before, update.u, update.y, update.x, ()))
    return Latched(update.update, update.tick, update.playing, REAL(update.load), u_before, u, y, x, ahead)
