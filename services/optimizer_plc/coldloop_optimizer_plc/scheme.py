"""The optimiser in a session: its constants, its one state, and step (3) of the paper's section II on it, as kernels.

`solve`, which is `pose`, a solver and `deliver`, is step (3): what is computed during an updating period. Steps (4),
(5) and (2), at its ends, are in `decisions.py`. Kernels take single and double precision alike.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.process.declaration import Process
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc import computing_settings, rules
from coldloop_optimizer_plc.estimator import Belief, Estimator, begin_prediction, no_belief, predict
from coldloop_optimizer_plc.plausibility import are_finite
from coldloop_optimizer_plc.qp import prediction
from coldloop_optimizer_plc.qp import problem as problems
from coldloop_optimizer_plc.qp.costs import predicted_indicators
from coldloop_optimizer_plc.qp.linear_algebra import Array, Real, rounded
from coldloop_optimizer_plc.settings import ProgramSettings, RuleName
from coldloop_optimizer_plc.solvers.interface import Answer, Costs, solve_by

SLOW: Final = 0.05  # share of the turbine's speed at the operating point below which it may stand
STANDSTILL_RATIO: Final = 1.1
"""Ratio of the pressures before and behind its nozzle, below which nothing flows; it is some ten in operation."""
ROOM: Final = 1e-3
"""Between a bound and an input that is held, scaled: methods of the interior need some. Sequences hold it exactly."""
MOST_BITS: Final = 31  # largest number of bits of the mask of suspects in an exported optimiser


class TurbineWatch(NamedTuple):
    """Test for a turbine at standstill; its indices are parameters, since kernels are shared by processes.

    valve: input before the turbine; -1: neither speed nor pressures are measured. speed, before, behind: outputs that
    are its speed and the pressures before and behind it. slow: speed below which it may stand. ratio: of the pressures,
    below which nothing flows. bit: of the valve in the mask of suspects, after those of the outputs.
    """

    valve: int
    speed: int
    before: int
    behind: int
    slow: float
    ratio: float
    bit: int


def turbine_watch(process: Process, y0: Array) -> TurbineWatch:
    """Return how the turbine of the process is watched, by its outputs (n_y,) at the operating point."""
    bath, outputs = process.bath, process.output_names
    if bath is None or not bath.turbine_speed or len(outputs) + len(process.inputs) > MOST_BITS:
        return TurbineWatch(-1, 0, 0, 0, -math.inf, STANDSTILL_RATIO, 0)
    valve, speed = process.input_names.index(bath.turbine_valve), outputs.index(bath.turbine_speed)
    before, behind = map(outputs.index, bath.turbine_pressures)
    return TurbineWatch(valve, speed, before, behind, SLOW * y0[speed], STANDSTILL_RATIO, 1 << (len(outputs) + valve))


@kernel
def idle_valve(c: TurbineWatch, suspects: int) -> int:
    """Return the input that has no effect by the mask of suspects, or -1."""
    return c.valve if suspects >= c.bit else -1


DELIVERY: Final = (
    ("number", "i8"), ("first_tick", "i8"), ("length", "i8"), ("ticks", "i8"), ("iterations", "i8"), ("w", "real"),
    ("share", "real"), ("hot_start", "real"), ("last_but_one", "real"), ("delivered", "real"), ("j_dev", "real"),
    ("j_cst", "real"), ("violation", "real"),
)  # fmt: skip
"""number, first_tick, length: of the sequence; length 0 where there is none. ticks, w, share: updating period before
the first tick, load (W, a deviation), share of the rate limit. iterations: done. hot_start, last_but_one, delivered:
costs of the guess, after q - 1 and after q iterations. j_dev, j_cst, violation: indicators of the profile."""
PERIOD: Final = (
    ("update", "i8"), ("tick", "i8"), ("q", "i8"), ("iterations", "i8"), ("ticks", "i8"), ("sequences", "i8"),
    ("allowance", "i8"), ("in_time", "i8"), ("planned", "?"), ("solved", "?"), ("load", "real"), ("effective", "real"),
    ("efficiency", "real"), ("mismatch", "real"), ("contraction", "real"), ("gamma", "real"),
    ("guessed_before", "real"), ("delivered_before", "real"), ("shortage", "real"), ("most_open", "real"),
    ("suspects", "i8"),
)  # fmt: skip
"""update, tick, load: of the update under way. q, iterations, ticks, effective: q(t_k), what fits, tau_u and J_k.
efficiency, mismatch, contraction, gamma: what q was decided by. sequences: number of the last sequence. allowance:
ticks that adaptive periods are longer than the budget says. in_time: answers in a row that came in time. planned,
solved: whether there is a period, and an answer to it. guessed_before, delivered_before: J+ and Jhat of the problem
before, infinite where there was none. shortage: what the load is above what can be held (W); negative: below what is
needed. most_open: limit of the feed, a scaled deviation. suspects: readings left out, bit i is output i; after
those of the outputs comes the bit of an input that has no effect."""


class Delivery(NamedTuple):
    """A profile z (n,), the parameters it was computed for, and its rows for the control PLC.

    numbers (1,) is a `DELIVERY` record; the state x (n_x,) and the input before the first knot u_before (3,) are
    deviations; rows (240, 3) are the inputs as the link carries them, a row a tick.
    """

    numbers: Any
    x: Array
    u_before: Array
    z: Array
    rows: NDArray[np.float32]


class OptimizerState(NamedTuple):
    """State of the optimiser between two updates, and between a plan and its answer.

    numbers (1,) is a `PERIOD` record. The control PLC plays the sequence `playing`; `sent` is the last answer, which
    may be computed again from the same state, with the same bits. u (3,) is the input applied at the update under way,
    a deviation, played on where no sequence is; target (3,) are the inputs that the plant should come to rest at,
    scaled deviations; rule (1,) is the memory of the rule of the updating period.
    """

    numbers: Any
    belief: Belief
    playing: Delivery
    sent: Delivery
    u: Array
    target: Array
    rule: Array


def empty_state(n_states: int, n_inputs: int, n_outputs: int, size: int, real: Real) -> OptimizerState:
    """Return room for the state, for so many states, inputs and outputs of the model, and variables of the problem."""

    def numbers(fields: tuple[tuple[str, str], ...]) -> Any:  # noqa: ANN401 a record
        return np.zeros(1, [(name, real if kind == "real" else kind) for name, kind in fields])

    def delivery() -> Delivery:
        rows = np.zeros((SEQUENCE_ROWS, n_inputs), np.float32)
        x, u, z = (np.zeros(n, real) for n in (n_states, n_inputs, size))
        return Delivery(numbers(DELIVERY), x, u, z, rows)

    return OptimizerState(
        numbers(PERIOD), no_belief(n_states, n_outputs, real), delivery(), delivery(), np.zeros(n_inputs, real),
        np.zeros(n_inputs, real), np.zeros(rules.MEMORY, real),
    )  # fmt: skip


LARGEST: Final = 1e38  # largest number that registers carry, in single precision


class Constants(NamedTuple):
    """Constants of an optimiser in one session, in the on-line floating-point type; loads are deviations, W."""

    estimator: Estimator
    target: prediction.TargetSearch
    Phi: Array
    Gamma: Array
    maps: problems.Maps
    shifts: Array  # shape (ticks + 1, knots, knots)
    knots: Array  # decision instants, shape (knots,)
    rest: Array  # `rest_map`
    predicted: problems.OutputMaps
    weights: Array  # weights of the knots in each sample, shape (horizon, knots)
    input_scale: Array
    rate: Array
    scaled_rate: Array  # over `input_scale`, shape (3,)
    rate_shares: Array  # share of the rate limit after 0, 1, ... ticks, shape (ticks + 1,)
    n_inputs: int
    alpha: float
    floor: float  # constant added to J
    least_load: float
    largest_load: float  # least and largest load that can be held
    reserve: float  # reserve kept below the largest load that the model holds
    least_load_error: float
    """Taken off the model's least load with the turbine's outlet in its band: it is too high until the bias
    of that has followed."""
    approach: float
    following_s: float
    """How much warmer than the bath helium before the feed is at which that is opened no further, K, infinite is any;
    time constant with which the limit of the feed follows that."""
    level: int
    temperature: int
    feed_temperature: int  # outputs that are level and temperature of the bath, and the temperature before its feed
    opening_per_k: float
    opening_from: float  # a deviation, %
    turbine: TurbineWatch
    load_step: float  # change of the load at which an updating period is interrupted; 0 is never
    sequence_ticks: int
    fixed_ticks: int  # fixed updating period; 0 is adaptive
    most: int  # largest q, that of the longest period
    periods: NDArray[np.int64]  # updating period in ticks for each q, shape (most + 1,); there is no q = 0
    fitting: NDArray[np.int64]
    """Iterations that fit into each number of ticks up to the longest period, a sampling period; shape (ticks + 1,)."""


def constants_of(
    estimator: Estimator, problem: problems.PredictiveProblem, target: prediction.TargetSearch, alpha: float,
    settings: ProgramSettings, budget: computing_settings.PlcBudget, rest: Array,
) -> Constants:  # fmt: skip
    """Return the constants of a session with adaptive periods."""
    process, every, end = settings.process, range(budget.longest_ticks + 1), settings.cold_end
    bath, level, temperature, feed_temperature = process.bath, 0, 0, 0
    if bath is not None:
        named = bath.level, bath.temperature, bath.feed_temperature
        level, temperature, feed_temperature = map(process.output_names.index, named)
    found = Constants(
        estimator=estimator, target=target, Phi=problem.Phi, Gamma=problem.Gamma, maps=problem.maps,
        shifts=problem.shifts, knots=problem.knots, rest=rest, predicted=problem.predicted,
        weights=problem.knots_to_samples, input_scale=problem.input_scale, rate=problem.rate,
        scaled_rate=problem.scaled_rate, n_inputs=problem.n_inputs, alpha=alpha,
        rate_shares=np.array([problem.limits.rate_share(ticks) for ticks in every]),
        floor=settings.adaptive.cost_floor, least_load=settings.holdable_load_w[0] - estimator.w0,
        largest_load=settings.holdable_load_w[1] - estimator.w0, reserve=settings.capacity_reserve_w,
        least_load_error=bath.least_load_error if bath else 0.0, approach=end.approach_k or math.inf,
        following_s=end.following_s, level=level, temperature=temperature, feed_temperature=feed_temperature,
        opening_per_k=end.opening_per_k, opening_from=end.opening_from - estimator.u0[target.feed],
        turbine=turbine_watch(process, estimator.y0), load_step=settings.interrupting_load_step_w,
        sequence_ticks=shortest_sequence(settings, budget), fixed_ticks=0, most=len(budget.ladder),
        periods=np.array([0, *budget.ladder]), fitting=np.array([budget.iterations(ticks) for ticks in every]),
    )  # fmt: skip
    return rounded(found, problem.Phi.dtype.type)


def shortest_sequence(settings: ProgramSettings, budget: computing_settings.PlcBudget) -> int:
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
) -> problems.QuadraticProblem:  # fmt: skip
    """Return the instance of the problem at a state, a load and the input before, about a target.

    With a limit of the feed; all are deviations. The input that is `idle`, unless it is -1, stays where it is.
    """
    phi, gamma, low, high, constant = problems.instance(c.maps, x, w, u_before, share, target)
    feed = c.target.feed
    for i in range(feed, c.n_inputs, u_before.shape[0]):
        high[i] = min(high[i], max(most_open, low[feed]))  # the first knot's low is as far as the rate lets it close
    if idle >= 0:
        held, real = u_before[idle] / c.input_scale[idle], x.dtype.type
        for i in range(idle, c.n_inputs, u_before.shape[0]):
            low[i] = max(held - real(ROOM), c.maps.low[i])
            high[i] = min(held + real(ROOM), c.maps.high[i])
    return problems.QuadraticProblem(c.Phi, phi, c.Gamma, gamma, low, high, constant)


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
def pose(c: Constants, m: OptimizerState) -> tuple[problems.QuadraticProblem, Array]:
    """Predict the state at t_{k+1}; return the problem there and the guess, the shifted profile."""
    ticks, sent = m.numbers[0].ticks, m.sent
    sent.u_before[:] = predict_played(c, m, ticks)
    sent.x[:] = m.belief.predicted
    s = sent.numbers[0]
    s.w, s.share, s.ticks = m.belief.numbers[0].w, c.rate_shares[ticks], ticks
    idle = idle_valve(c.turbine, m.numbers[0].suspects)
    qp = problem_at(c, sent.x, s.w, sent.u_before, s.share, m.target, m.numbers[0].most_open, idle)
    return qp, problems.shifted(c.shifts[ticks], m.playing.z, c.n_inputs)


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
def deliver(c: Constants, m: OptimizerState, qp: problems.QuadraticProblem, answer: Answer) -> None:
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
    problems.keep_first_rate(c.maps, c.scaled_rate, sent.u_before, s.share, sent.z)
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
    problems.write_inputs(c.weights, z, c.input_scale, c.estimator.u0, c.rate, samples, inputs)
    for sample in range(samples):
        for tick in range(sample * per_sample, min((sample + 1) * per_sample, length)):
            for i in range(inputs.shape[1]):
                rows[tick, i] = inputs[sample, i]
    return length
