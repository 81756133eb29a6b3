"""The implementation scheme as kernels: steps (2) to (5) of the paper's section II on the state of a session.

`plan` are steps (4), (5) and (2); `solve`, which is `pose`, a solver and `deliver`, is step (3). They take single and
double precision alike. Decisions outside the arithmetic are in `decisions.py`.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc.budget import PlcBudget
from coldloop_optimizer_plc.estimator import Belief, Estimator, begin_prediction, correct, predict
from coldloop_optimizer_plc.idle_input import ROOM, TurbineWatch, idle_valve, stands, turbine_watch
from coldloop_optimizer_plc.plausibility import USED, are_finite, suspects_of
from coldloop_optimizer_plc.qp.costs import OutputMaps, augmented_cost, output_maps, predicted_indicators
from coldloop_optimizer_plc.qp.instance import Maps, instance, keep_first_rate
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QuadraticProblem
from coldloop_optimizer_plc.qp.profile import shifted, write_inputs
from coldloop_optimizer_plc.qp.target import TargetSearch, bounds_at, find_target, least_warm_load, loads_held
from coldloop_optimizer_plc.rules.assessment import Assessment, Observation, assessed
from coldloop_optimizer_plc.rules.interface import UpdatingRule, decide_by
from coldloop_optimizer_plc.session_state import Delivery, OptimizerState
from coldloop_optimizer_plc.settings import ProgramSettings, RuleName
from coldloop_optimizer_plc.solvers.interface import Answer, Costs
from coldloop_optimizer_plc.solvers.kernel_solver import solve_by

Array = NDArray[np.float64]

BY_THE_RULE: Final = 0
"""The q that `plan` is given when the rule is to decide it."""
LARGEST: Final = 1e38
"""What registers carry, in single precision."""


class Constants(NamedTuple):
    """What an optimiser computes with that does not change in a session, in the on-line floating-point type."""

    estimator: Estimator
    target: TargetSearch
    Phi: Array
    Gamma: Array
    maps: Maps
    shifts: Array
    """Shape (ticks + 1, knots, knots)."""
    knots: Array
    """Decision instants, shape (knots,)."""
    rest: Array
    """`rest_map`."""
    predicted: OutputMaps
    weights: Array
    """Of the knots in each sample, shape (horizon, knots)."""
    input_scale: Array
    rate: Array
    scaled_rate: Array
    """Over `input_scale`, shape (3,)."""
    rate_shares: Array
    """Share of the rate limit after 0, 1, ... ticks, shape (ticks + 1,)."""
    n_inputs: int
    alpha: float
    """Penalty weight."""
    floor: float
    """Constant added to J."""
    least_load: float
    """That can be held, as a deviation, W."""
    largest_load: float
    reserve: float
    """Of what the model holds, W."""
    least_load_error: float
    """Taken off the model's least load with the turbine's outlet in its band: it is too high until the constant error
    of that has followed, W."""
    approach: float
    """How much warmer than the bath helium before the feed is at which that is opened no further, K; infinite is any.
    """
    following_s: float
    """Time constant with which the limit of the feed follows that."""
    level: int
    """Which output is the level of the bath, ..."""
    temperature: int
    """... which its temperature, ..."""
    feed_temperature: int
    """... and which that before its feed."""
    opening_per_k: float
    opening_from: float
    """A deviation, %."""
    turbine: TurbineWatch
    load_step: float
    """What the load may move by until an updating period is interrupted, W; 0 is never."""
    sequence_ticks: int
    fixed_ticks: int
    """Fixed updating period; 0 is adaptive."""
    most: int
    """Largest q, that of the longest period."""
    periods: NDArray[np.int64]
    """Updating period in ticks for each q, shape (most + 1,); there is no q = 0."""
    fitting: NDArray[np.int64]
    """Iterations that fit into each number of ticks up to the longest period, a sampling period; shape (ticks + 1,)."""


def constants_of(
    estimator: Estimator,
    problem: PredictiveProblem,
    target: TargetSearch,
    alpha: float,
    settings: ProgramSettings,
    budget: PlcBudget,
    rest: Array,
) -> Constants:  # fmt: skip
    """Return the constants of a session with adaptive periods."""
    real, process, every = problem.Phi.dtype.type, settings.process, range(budget.longest_ticks + 1)
    bath, level, temperature, feed_temperature = process.bath, 0, 0, 0
    if bath is not None:
        named = bath.level, bath.temperature, bath.feed_temperature
        level, temperature, feed_temperature = map(process.output_names.index, named)
    return Constants(
        estimator=estimator, target=target,
        Phi=problem.Phi, Gamma=problem.Gamma, maps=problem.maps, shifts=problem.shifts,
        knots=problem.knots, rest=rest,
        predicted=output_maps(problem),
        weights=problem.knots_to_samples, input_scale=problem.input_scale, rate=problem.rate,
        scaled_rate=problem.scaled_rate,
        rate_shares=np.array([problem.limits.rate_share(ticks) for ticks in every], real),
        n_inputs=problem.n_inputs,
        alpha=real(alpha), floor=real(settings.adaptive.cost_floor),
        least_load=real(settings.holdable_load_w[0] - estimator.w0),
        largest_load=real(settings.holdable_load_w[1] - estimator.w0),
        reserve=real(settings.capacity_reserve_w),
        least_load_error=real(bath.least_load_error if bath else 0.0),
        approach=real(settings.cold_end.approach_k or np.inf), following_s=real(settings.cold_end.following_s),
        level=level, temperature=temperature, feed_temperature=feed_temperature,
        opening_per_k=real(settings.cold_end.opening_per_k),
        opening_from=real(settings.cold_end.opening_from - estimator.u0[target.feed]),
        turbine=turbine_watch(process, estimator.y0, real),
        load_step=real(settings.interrupting_load_step_w), sequence_ticks=shortest_sequence(settings, budget),
        fixed_ticks=0, most=len(budget.ladder), periods=np.array([0, *budget.ladder]),
        fitting=np.array([budget.iterations(ticks) for ticks in every]),
    )  # fmt: skip


def shortest_sequence(settings: ProgramSettings, budget: PlcBudget) -> int:
    """Return the rows that a sequence has at least, so that it lasts until the next one can arrive.

    All sequences last for two updating periods. Where the rule may choose one more than twice as long as the one
    before they last for that; where a load step may interrupt, in the last tick of a period, for another one after it.
    """
    if settings.interrupting_load_step_w:
        return min(max(settings.sequence_ticks, 2 * budget.longest_ticks - 1), SEQUENCE_ROWS)
    ladder, adaptive = budget.ladder, settings.adaptive
    leap, most = len(ladder), len(ladder)
    if not settings.outside.rule:
        own = adaptive.rule is RuleName.CONTRACTION
        leap, most = (1, adaptive.contraction.q_max) if own else (adaptive.delta, adaptive.q_max)
    last = min(most, len(ladder)) - 1
    followed = ((ticks, ladder[min(place + leap, last)]) for place, ticks in enumerate(ladder[:last]))
    return max(settings.sequence_ticks, *(longest for ticks, longest in followed if longest > 2 * ticks), 0)


@kernel
def with_floor(cost: float, constant: float, floor: float) -> float:
    """Return J with its constant and its floor; rounding, in single precision, must not take it below the floor."""
    return max(cost + (constant + floor), floor)


@kernel
def problem_at(
    c: Constants, x: Array, w: float, u_before: Array, share: float, target: Array, most_open: float, idle: int
) -> QuadraticProblem:  # fmt: skip
    """Return the instance of the problem at a state, a load and the input before, about a target.

    With a limit of the feed; all are deviations. The input that is `idle`, unless it is -1, stays where it is.
    """
    phi, gamma, low, high, constant = instance(c.maps, x, w, u_before, share, target)
    feed = c.target.feed
    for i in range(feed, c.n_inputs, u_before.shape[0]):
        high[i] = min(high[i], max(most_open, low[feed]))  # the first knot's low is as far as the rate lets it close
    if idle >= 0:
        held, real = u_before[idle] / c.input_scale[idle], x.dtype.type
        for i in range(idle, c.n_inputs, u_before.shape[0]):
            low[i] = max(held - real(ROOM), c.maps.low[i])
            high[i] = min(held + real(ROOM), c.maps.high[i])
    return QuadraticProblem(c.Phi, phi, c.Gamma, gamma, low, high, constant)


# -- step (3): during the updating period ------------------------------------------------------------------------------


@kernel
def predict_played(c: Constants, m: OptimizerState, ticks: int) -> Array:
    """Predict so many ticks on from the update under way under what is played; return the last input, (3,)."""
    begin_prediction(m.belief)
    p, rows = m.playing.numbers[0], m.playing.rows
    u = m.u.copy()
    if p.length == 0:
        predict(c.estimator, m.belief, u, ticks)
        return u
    tick, end = m.numbers[0].tick, m.numbers[0].tick + ticks
    while tick < end:
        row = rows[row_at(tick, p.first_tick, p.length)]
        until = tick + 1
        while until < end and same_inputs(row, rows[row_at(until, p.first_tick, p.length)]):
            until += 1
        for i in range(u.shape[0]):
            u[i] = u.dtype.type(row[i]) - c.estimator.u0[i]
        predict(c.estimator, m.belief, u, until - tick)
        tick = until
    return u


@kernel
def row_at(tick: int, first_tick: int, length: int) -> int:
    """Return the row that is played at a tick; after the last one it holds."""
    return max(0, min(tick - first_tick, length - 1))


@kernel
def same_inputs(one: NDArray[np.float32], other: NDArray[np.float32]) -> bool:
    """Return whether two rows (inputs,) are the same."""
    same = True
    for i in range(one.shape[0]):
        same = same and one[i] == other[i]
    return same


@kernel
def pose(c: Constants, m: OptimizerState) -> tuple[QuadraticProblem, Array]:
    """Predict the state at t_{k+1}; return the problem there and the guess, the shifted profile."""
    ticks, sent = m.numbers[0].ticks, m.sent
    sent.u_before[:] = predict_played(c, m, ticks)
    sent.x[:] = m.belief.predicted
    s = sent.numbers[0]
    s.w, s.share, s.ticks = m.belief.numbers[0].w, c.rate_shares[ticks], ticks
    idle = idle_valve(c.turbine, m.numbers[0].suspects)
    qp = problem_at(c, sent.x, s.w, sent.u_before, s.share, m.target, m.numbers[0].most_open, idle)
    return qp, shifted(c.shifts[ticks], m.playing.z, c.n_inputs)


@kernel
def is_answer(m: OptimizerState) -> bool:
    """Return whether estimate, profile and rows are finite, and costs numbers; all but J_i may be infinite."""
    sent = m.sent
    s, rows, effective = sent.numbers[0], sent.rows, m.numbers[0].effective
    costs = effective + s.hot_start + s.last_but_one + s.delivered + s.j_dev + s.j_cst + s.violation
    finite = not math.isnan(costs) and effective <= m.u.dtype.type(LARGEST)
    finite = finite and np.isfinite(s.w) and are_finite(sent.x) and are_finite(sent.z)
    for tick in range(s.length):
        for i in range(rows.shape[1]):
            finite = finite and np.isfinite(rows[tick, i])
    return finite


@kernel
def deliver(c: Constants, m: OptimizerState, qp: QuadraticProblem, answer: Answer) -> None:
    """Make the sequence of an answer after q - 1 and q iterations, and judge its profile.

    There are no rows where it is none (`is_answer`).
    """
    now, sent = m.numbers[0], m.sent
    s = sent.numbers[0]
    s.hot_start = with_floor(answer.guessed, qp.constant, c.floor)
    s.last_but_one = with_floor(answer.costs[0], qp.constant, c.floor)
    s.delivered = with_floor(answer.costs[1], qp.constant, c.floor)
    s.iterations = answer.iterations[1]
    sent.z[:] = answer.points[1]
    idle = idle_valve(c.turbine, now.suspects)
    if idle >= 0:
        for i in range(idle, c.n_inputs, sent.u_before.shape[0]):
            sent.z[i] = sent.u_before[idle] / c.input_scale[idle]
    keep_first_rate(c.maps, c.scaled_rate, sent.u_before, s.share, sent.z)
    s.j_dev, s.j_cst, s.violation = predicted_indicators(c.predicted, qp, sent.z, sent.x, s.w, c.n_inputs)
    s.number, s.first_tick = now.sequences + 1, now.tick + now.ticks
    s.length = write_rows(c, sent.z, now.ticks, sent.rows)
    if not is_answer(m):
        s.length = 0
    now.solved = True


@kernel
def solve(c: Constants, method: Any, m: OptimizerState) -> None:  # noqa: ANN401 of any solver of our own
    """Pose the problem, do q iterations by the method of a solver of our own, deliver the answer."""
    now = m.numbers[0]
    qp, guess = pose(c, m)
    counts = np.empty(2, np.int64)
    counts[0], counts[1] = now.iterations - 1, now.iterations
    deliver(c, m, qp, solve_by(method, qp, guess, counts, Costs(now.guessed_before, now.delivered_before)))


@kernel
def write_rows(c: Constants, z: Array, ticks: int, rows: NDArray[np.float32]) -> int:
    """Write the sequence of a profile, in single precision and a row a tick, into `rows`; return its length."""
    length = max(c.sequence_ticks, 2 * ticks)
    per_sample = c.fitting.shape[0] - 1
    samples = (length + per_sample - 1) // per_sample
    inputs = np.empty(((rows.shape[0] + per_sample - 1) // per_sample, rows.shape[1]), z.dtype)
    write_inputs(c.weights, z, c.input_scale, c.estimator.u0, c.rate, samples, inputs)
    for sample in range(samples):
        for tick in range(sample * per_sample, min((sample + 1) * per_sample, length)):
            for i in range(inputs.shape[1]):
                rows[tick, i] = inputs[sample, i]
    return length


# -- steps (4), (5) and (2): at an updating instant --------------------------------------------------------------------


@kernel
def begin_sent(m: OptimizerState) -> None:
    """Let the last answer be what is played: its sequence begins."""
    copy_delivery(m.sent, m.playing)


@kernel
def copy_delivery(source: Delivery, target: Delivery) -> None:
    """Make `target` the same as `source`."""
    target.numbers[0] = source.numbers[0]
    target.x[:], target.u_before[:], target.z[:] = source.x, source.u_before, source.z
    target.rows[:] = source.rows


@kernel
def shortage(
    c: Constants, x: Array, w: float, load: float, most_open: float, idle: int, at: float, before: float, none: float
) -> float:  # fmt: skip
    """Return what the load is above what can be held, W; negative: below what is needed; `none`, that is 0, otherwise.

    The estimate w (a deviation) has what the plant lacks beside its model, so it is compared with what the model holds
    at rest within the inputs' bounds and the limit of the feed, less a reserve, and with the least that it holds
    without the turbine's outlet getting too cold, by the constant error of that. The load itself (W), where it is
    measured, is compared with what the plant holds that is as its model. A shortage of the sign that was `before` ends
    where the estimate has twice the reserve: noise does not end it and begin it anew.
    """
    if not c.target.limited:
        return none
    measured = load - c.estimator.w0 if c.estimator.load_known else w
    low, high = bounds_at(c.target, x, most_open, idle, at)
    _, most = loads_held(c.target, low, high)
    more = c.reserve if before > none else none
    less = c.reserve if before < none else none
    too_much = max(w + c.reserve + more - most, measured - c.largest_load)
    warm = least_warm_load(c.target, low, high) - c.least_load_error
    too_little = min(w - warm - less, min(w, measured) - c.least_load)
    return max(too_much, none) + min(too_little, none)


@kernel
def believed(c: Constants, belief: Belief, u: Array, y: Array, output: int) -> float:
    """Return an output by the estimate, for inputs u (3,), deviations; by its reading where no constant is estimated.

    One without a constant is as the model has it while its reading is left out.
    """
    e, reading = c.estimator, belief.readings[output]
    if e.plausible.constants[output] < 0 and reading.state == USED and np.isfinite(y[output]):
        shown: float = y[output]
        return shown
    maps = e.outputs
    value: float = e.y0[output] + maps.F[0, output] * belief.numbers[0].w
    for j in range(belief.x.shape[0]):
        value += maps.A[j, output] * belief.x[j]
    for j in range(u.shape[0]):
        value += maps.B[j, output] * u[j]
    return value


@kernel
def most_open(c: Constants, u: Array, approach: float) -> float:
    """Return how far the feed may be opened, a scaled deviation, by inputs (3,), deviations, and an approach, K."""
    feed = c.target.feed
    limit: float = max(u[feed] + c.opening_per_k * (c.approach - approach), c.opening_from) / c.input_scale[feed]
    return limit


@kernel
def limit_of_feed(c: Constants, m: OptimizerState, y: Array) -> float:
    """Return `most_open` by the estimate, followed from that of the update before; y (22,) are the outputs."""
    before, belief = m.numbers[0].most_open, m.belief
    if np.isinf(c.approach):
        return c.approach
    warmer = believed(c, belief, m.u, y, c.feed_temperature) - believed(c, belief, m.u, y, c.temperature)
    elapsed = y.dtype.type(belief.numbers[0].since) * c.estimator.tick_s
    share = min(elapsed / c.following_s, y.dtype.type(1.0)) if m.numbers[0].planned else y.dtype.type(1.0)
    moved = (most_open(c, m.u, warmer) - before) * share
    if not np.isfinite(moved):  # by an estimate that leads to no answer
        moved = y.dtype.type(0.0)
    limit: float = max(before + moved, c.opening_from / c.input_scale[c.target.feed])
    return limit


@kernel
def plan(
    c: Constants,
    rule: UpdatingRule,
    m: OptimizerState,
    wanted: int,
    update: int,
    tick: int,
    u_before: Array,
    load: float,
    y: Array,
    x: Array,
) -> None:
    """Take the update latched at `tick`, in physical units and the on-line type; decide the updating period.

    `wanted` is its q, or BY_THE_RULE where what is played is the answer to the update before, in time. The program does
    the same step by step where estimator or rule are not ours.
    """
    end_period(m)
    correct(c.estimator, m.belief, u_before, load, y, x)
    effective = judge_played(c, m, load, y)
    if wanted == BY_THE_RULE:
        o, a = assess_period(c, m, effective)
        wanted = decide_by(rule, m.rule, o, a)
    begin_period(c, m, wanted, update, tick, load, effective)


@kernel
def end_period(m: OptimizerState) -> None:
    """Note the answer of the period that ends; nothing is known of how it went."""
    now, real = m.numbers[0], m.belief.x.dtype.type
    if now.solved:
        now.sequences = max(now.sequences, m.sent.numbers[0].number)
        now.guessed_before, now.delivered_before = m.sent.numbers[0].hot_start, m.sent.numbers[0].delivered
        now.solved = False
    now.efficiency = now.mismatch = now.contraction = real(1.0)
    now.gamma = real(0.0)


@kernel
def judge_played(c: Constants, m: OptimizerState, load: float, y: Array) -> float:
    """Return J of what is played at the state that is estimated now, and find limits and target there."""
    now, played, real = m.numbers[0], m.playing.numbers[0], m.belief.x.dtype.type
    w = m.belief.numbers[0].w
    now.suspects = suspects_of(m.belief.readings)
    if stands(c.turbine, y):
        now.suspects += c.turbine.bit
    idle = idle_valve(c.turbine, now.suspects)
    at = m.u[max(idle, 0)] / c.input_scale[max(idle, 0)]
    now.most_open = limit_of_feed(c, m, y)
    now.shortage = shortage(c, m.belief.x, w, load, now.most_open, idle, at, now.shortage, real(0.0))
    if not abs(now.shortage) <= real(LARGEST):  # by an estimate that leads to no answer
        now.shortage = real(0.0)
    find_target(c.target, m.belief.x, w, m.belief.numbers[0].mismatch, now.most_open, idle, at, m.target)
    qp = problem_at(c, m.belief.x, w, m.playing.u_before, played.share, m.target, now.most_open, idle)
    return with_floor(augmented_cost(qp, m.playing.z, c.alpha), qp.constant, c.floor)


@kernel
def assess_period(c: Constants, m: OptimizerState, effective: float) -> tuple[Observation, Assessment]:
    """Return what a rule decides by, step (4): the costs of the period that ends, and what they say of it."""
    now, played, real = m.numbers[0], m.playing.numbers[0], m.belief.x.dtype.type
    o = Observation(
        now.q, now.iterations, real(now.ticks) * c.estimator.tick_s, now.effective, played.hot_start,
        played.last_but_one, played.delivered, effective,
    )  # fmt: skip
    a = assessed(o)
    now.efficiency, now.mismatch, now.contraction, now.gamma = a.efficiency, a.mismatch, a.contraction, a.gamma
    return o, a


@kernel
def begin_period(
    c: Constants, m: OptimizerState, wanted: int, update: int, tick: int, load: float, effective: float
) -> None:  # fmt: skip
    """Begin the period of a q, step (5): its length, and what fits; then step (2), what was sent is played."""
    now = m.numbers[0]
    now.q = max(min(wanted, c.most), 1)  # costs that are no numbers lead a rule anywhere
    adaptive = min(c.periods[now.q] + now.allowance, c.fitting.shape[0] - 1)
    now.ticks = c.fixed_ticks if c.fixed_ticks > 0 else adaptive
    now.iterations = c.fitting[max(now.ticks - now.allowance, 0)]  # where a period cannot grow, they are fewer
    now.update, now.tick, now.load, now.effective, now.planned = update, tick, load, effective, True
