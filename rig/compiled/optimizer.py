"""The optimiser's program, and what ordinary updates change of it."""

import numpy as np

from coldloop.limits import InputLimits
from coldloop.registers.control_plc import Update, Verdict
from coldloop.registers.optimizer_plc import Optimization
from coldloop.sequence import InputSequence
from optimizer_plc.budget import MAX_PERIOD_TICKS
from optimizer_plc.costs import output_maps
from optimizer_plc.estimator import Estimate, KalmanFilter, StateFeedback
from optimizer_plc.prediction import Transition
from optimizer_plc.problem import Situation
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.scheme import ALGORITHM_1, CONTRACTION, FIXED, OPTIMIZER_STATE, Constants, Memory, Rule
from optimizer_plc.session_state import Delivery, Period
from optimizer_plc.solvers.interface import Costs
from optimizer_plc.solvers.kernel_solver import KernelSolver
from optimizer_plc.updating_period import (
    Algorithm1,
    Assessment,
    ContractionParameters,
    ContractionRule,
    FixedPeriod,
    UpdatingRule,
)
from rig.compiled.records import Array, Reports, empty_rows, record

NO_CONTRACTION = ContractionParameters(0, 0, 0, 1.0, 0.0, 1.0)


def is_compiled(program: OptimizerProgram) -> bool:
    """Tell whether the program's updates have a compiled form: double precision, a solver and a rule of our own."""
    if type(program) is not OptimizerProgram:  # who has made another kind of it wants to be asked
        return False
    known_rule = isinstance(program.rule, FixedPeriod | Algorithm1 | ContractionRule)
    return program.problem.Phi.dtype == np.float64 and isinstance(program.solver, KernelSolver) and known_rule


def is_ordinary(program: OptimizerProgram) -> bool:
    """Tell whether the update under way is one of many: what is played is what was sent for it."""
    state = program.state
    played, last = state.playing, state.last
    if played is not state.sent or last is None or played.sequence is None or state.allowance:
        return False
    return played.first_tick == last.update.tick


def constants_of(program: OptimizerProgram, limits: InputLimits) -> Constants:
    """Return what the program computes with in this session."""
    model, problem = program.model, program.problem
    steps = (model.transitions[ticks] for ticks in range(1, MAX_PERIOD_TICKS + 1))
    estimator = program.estimator
    gains = estimator.gains if isinstance(estimator, KalmanFilter) else {1: np.zeros((1, 1))}
    qp = problem.at(program.state.playing.situation)
    return Constants(
        steps=Transition(*(np.array(M) for M in zip(*steps, strict=True))),
        outputs=model.outputs,
        x0=np.array(model.x0), u0=np.array(model.u0), y0=np.array(model.y0), w0=float(model.w0),
        kalman=isinstance(estimator, KalmanFilter),
        load_known=not isinstance(estimator, KalmanFilter) or estimator.load_known,
        gains=np.array([gains[ticks] for ticks in sorted(gains)]),
        Phi=problem.Phi, Gamma=problem.Gamma, maps=problem.maps, shifts=problem.shifts,
        predicted=output_maps(problem),
        weights=problem.knots_to_samples, input_scale=problem.input_scale, rate=problem.rate,
        scaled_rate=problem.scaled_rate,
        rate_shares=np.array([limits.rate_share(ticks) for ticks in range(MAX_PERIOD_TICKS + 1)]),
        n_inputs=problem.n_inputs,
        alpha=program.solver.alpha,
        solver=program.solver.method(qp),
        floor=program.settings.adaptive.cost_floor,
        sequence_ticks=program.settings.sequence_ticks,
        load_step=program.settings.interrupting_load_step_w,
        rule=_rule(program),
    )  # fmt: skip


def _rule(program: OptimizerProgram) -> Rule:
    budget, rule, fixed = program.budget, program.rule, program.fixed_ticks
    most = budget.iterations(MAX_PERIOD_TICKS)
    periods = np.array([fixed or budget.period(iterations) for iterations in range(most + 1)])
    bounds = (rule.first, rule.first, 0)
    if isinstance(rule, Algorithm1):
        bounds = (rule.q_min, rule.q_max, rule.delta)
    contraction = rule.parameters if isinstance(rule, ContractionRule) else NO_CONTRACTION
    return Rule(_kind(rule), fixed, *bounds, contraction, most, periods)


def _kind(rule: UpdatingRule) -> int:
    if isinstance(rule, ContractionRule):
        return CONTRACTION
    return ALGORITHM_1 if isinstance(rule, Algorithm1) else FIXED


def memory_of(program: OptimizerProgram) -> tuple[Memory, Array]:
    """Return the state of the program after a `plan`, and the four numbers of its assessment that are reported."""
    state, numbers = program.state, record(OPTIMIZER_STATE)
    played, last, n = state.playing, state.last, numbers[0]
    if last is None or played.sequence is None:
        raise RuntimeError("an ordinary update has a period and a sequence")
    n["update_tick"], n["iterations"], n["ticks"] = last.update.tick, last.iterations, last.ticks
    n["effective"], n["w"], n["mismatch"] = last.effective, last.estimate.w, last.estimate.mismatch
    n["hot_start"], n["last_but_one"], n["delivered"] = played.hot_start, played.last_but_one, played.delivered
    n["played_w"], n["played_ticks"] = played.situation.w, played.situation.elapsed_ticks
    n["played_share"] = program.problem.limits.rate_share(played.situation.elapsed_ticks)
    n["sequences"] = state.sequences
    n["since"] = program.estimator.since if isinstance(program.estimator, KalmanFilter) else 1
    if isinstance(program.rule, ContractionRule):
        n["contraction"], n["contraction_delivered"] = program.rule.contraction, program.rule.delivered
    rows = empty_rows()
    rows[: len(played.sequence.rows)] = played.sequence.rows
    x = np.array(last.estimate.x)
    situation = played.situation
    memory = Memory(
        numbers, x, x.copy(), situation.x.copy(), played.z.copy(), played.z.copy(), situation.u_before.copy(), rows,
        rows.copy(),
    )  # fmt: skip
    a = last.assessment
    return memory, np.array([a.efficiency, a.mismatch, a.contraction, a.gamma])


def give_back(program: OptimizerProgram, m: Memory, update: Update, sequence: InputSequence, assessment: Array) -> None:
    """Let the program go on after updates, of which the last one was planned.

    Args:
        program: What goes on.
        m: The state.
        update: The update under way.
        sequence: What is played from there on.
        assessment: Four numbers of the decision; the others are not needed any more.
    """
    n, state = m.numbers[0], program.state
    E, D, K, gamma = assessment.tolist()
    estimate = Estimate(m.x.copy(), np.float64(n["w"]), np.float64(n["mismatch"]))
    situation = Situation(m.x_solved.copy(), float(n["played_w"]), m.u_before.copy(), int(n["played_ticks"]))
    state.playing = state.sent = Delivery(
        m.z.copy(), situation, sequence.header.first_tick, sequence, program.problem.at(situation),
        float(n["hot_start"]), float(n["last_but_one"]), float(n["delivered"]), int(n["done"]),
    )  # fmt: skip
    state.last = Period(
        update, estimate, int(n["iterations"]), int(n["ticks"]), float(n["effective"]),
        Assessment(E, D, K, np.nan, np.nan, np.nan, np.nan, gamma),
    )  # fmt: skip
    state.sequences = int(n["sequences"])
    if isinstance(program.estimator, KalmanFilter):
        program.estimator.x, program.estimator.mismatch = m.x.copy(), np.float64(n["mismatch"])
        program.estimator.since = int(n["since"])
    if isinstance(program.estimator, KalmanFilter | StateFeedback):
        program.estimator.estimate = estimate
    program.solver.before = Costs(float(n["hot_start"]), float(n["delivered"]))
    if isinstance(program.rule, ContractionRule):
        program.rule.contraction = float(n["contraction"])
        program.rule.delivered = float(n["contraction_delivered"])


def optimizations(reports: Reports, solved: int) -> list[Optimization]:
    """Return what was reported, as the recorder takes it."""
    counts, values = reports.counts[:solved].tolist(), reports.values[:solved].tolist()
    rows = ([*row, int(Verdict.ACCEPTED), *of_row] for row, of_row in zip(counts, values, strict=True))
    return [Optimization(*row) for row in rows]
