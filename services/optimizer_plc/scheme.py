"""The implementation scheme as kernels: what the program does in an ordinary update.

`solve` is step (3) of the paper's section II, `plan` are steps (4), (5) and (2). They compute with what the program
computes with, in its order, so that whoever calls them instead has the same bits. Double precision only.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.compiled import kernel
from coldloop.process import TICK_S, TICKS_PER_SAMPLE
from optimizer_plc.costs import OutputMaps, augmented_cost, predicted_indicators
from optimizer_plc.estimator import corrected
from optimizer_plc.instance import Maps, instance, keep_first_rate
from optimizer_plc.linear_algebra import respond
from optimizer_plc.prediction import Transition
from optimizer_plc.problem import QuadraticProblem
from optimizer_plc.profile import inputs_of, shifted
from optimizer_plc.solvers.interface import Costs
from optimizer_plc.solvers.kernel_solver import solve_by
from optimizer_plc.updating_period import (
    Assessment,
    ContractionParameters,
    Observation,
    assess,
    by_contraction,
    one_step,
    recent_contraction,
)

Array = NDArray[np.float64]

FIXED, ALGORITHM_1, CONTRACTION = 0, 1, 2

OPTIMIZER_STATE = np.dtype([
    ("update_tick", "i8"), ("iterations", "i8"), ("ticks", "i8"), ("since", "i8"), ("done", "i8"),
    ("sequences", "i8"), ("mismatch", "f8"), ("w", "f8"), ("effective", "f8"), ("hot_start", "f8"),
    ("last_but_one", "f8"), ("delivered", "f8"), ("j_dev", "f8"), ("j_cst", "f8"), ("violation", "f8"),
    ("contraction", "f8"), ("contraction_delivered", "f8"), ("played_w", "f8"), ("played_share", "f8"),
    ("played_ticks", "i8"),
])  # fmt: skip
"""Numbers of the optimiser between two updates.

update_tick, iterations, ticks, effective: t_k, q(t_k), tau_u in ticks and J_k of the update under way. w, mismatch:
estimated load, and its share that no sensor saw. since: ticks predicted over. sequences: number of the last one.
done, hot_start, last_but_one, delivered, j_dev, j_cst, violation, played_w, played_share, played_ticks: of the last
solve. contraction, contraction_delivered: of the contraction rule."""


class Rule(NamedTuple):
    """The rule of the updating period, and what follows from its decision."""

    kind: int
    """FIXED, ALGORITHM_1 or CONTRACTION."""
    fixed_ticks: int
    q_min: int
    """That of a fixed period is q_max, too."""
    q_max: int
    delta: int
    contraction: ContractionParameters
    most: int
    """Iterations that fit into the longest period."""
    periods: NDArray[np.int64]
    """Updating period in ticks for each number of iterations, shape (most + 1,)."""


class Constants(NamedTuple):
    """What an optimiser computes with that never changes in a session."""

    steps: Transition
    """Transitions over 1, 2, ... ticks, stacked."""
    outputs: Transition
    """C, D, G."""
    x0: Array
    u0: Array
    y0: Array
    w0: float
    kalman: bool
    """Kalman filter, or else state feedback."""
    load_known: bool
    """The filter is fed the measured load."""
    gains: Array
    """Of the Kalman filter for periods of 1, 2, ... ticks, shape (ticks, 22, n + 1)."""
    Phi: Array
    Gamma: Array
    maps: Maps
    shifts: Array
    """Shape (ticks + 1, knots, knots)."""
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
    solver: Any
    """Method of a solver of our own."""
    floor: float
    """Constant added to J."""
    sequence_ticks: int
    load_step: float
    """Change of the load that interrupts an updating period, W, or 0."""
    rule: Rule


class Memory(NamedTuple):
    """State of an optimiser between two updates, overwritten as it goes on."""

    numbers: Any
    """`OPTIMIZER_STATE`, shape (1,)."""
    x: Array
    """Estimated state at the last update, as a deviation, shape (n_x,)."""
    predicted: Array
    """State predicted for the next one, or estimated at the last one, shape (n_x,)."""
    x_solved: Array
    """State of the last problem solved, shape (n_x,)."""
    z: Array
    """The profile being played, shape (n,)."""
    answer: Array
    """The profile that `solve` has found, shape (n,)."""
    u_before: Array
    """Input before the first knot of the last problem solved, as a deviation, shape (3,)."""
    rows: Array
    """Inputs of the sequence being played, a row a tick, shape (240, 3)."""
    answer_rows: Array
    """Those of the sequence that `solve` has made."""


@kernel
def with_floor(cost: float, constant: float, floor: float) -> float:
    """Return J with its constant and its floor."""
    return max(cost + (constant + floor), floor)


@kernel
def problem_at(c: Constants, x: Array, w: float, u_before: Array, share: float) -> QuadraticProblem:
    """Return the instance of the problem at a state, a load and the input before; all are deviations."""
    phi, gamma, low, high, constant = instance(c.maps, x, w, u_before, share)
    return QuadraticProblem(c.Phi, phi, c.Gamma, gamma, low, high, constant)


@kernel
def solve(c: Constants, m: Memory) -> int:
    """Predict the state at t_{k+1}, shift the profile, do q iterations, make the sequence; return its length in ticks.

    What is played until then is the first row of the present sequence. The answer is in `answer` and `answer_rows`.
    """
    s = m.numbers[0]
    ticks = s.ticks
    u = np.empty(3)
    for i in range(3):
        u[i] = m.rows[0, i] - c.u0[i]
    m.predicted[:] = respond(c.steps.A[ticks - 1], c.steps.B[ticks - 1], c.steps.F[ticks - 1], m.x, u, s.w)
    m.x_solved[:] = m.predicted
    s.since = ticks
    s.played_w, s.played_share, s.played_ticks = s.w, c.rate_shares[ticks], ticks
    m.u_before[:] = u
    qp = problem_at(c, m.predicted, s.w, u, c.rate_shares[ticks])
    before = Costs(s.hot_start, s.delivered)
    counts = np.array([s.iterations - 1, s.iterations])
    answer = solve_by(c.solver, qp, shifted(c.shifts[ticks], m.z), counts, before)
    z = answer.points[1]
    s.hot_start = with_floor(answer.guessed, qp.constant, c.floor)
    s.last_but_one = with_floor(answer.costs[0], qp.constant, c.floor)
    s.delivered = with_floor(answer.costs[1], qp.constant, c.floor)
    s.done = answer.iterations[1]
    keep_first_rate(c.maps, c.scaled_rate, u, c.rate_shares[ticks], z)
    s.j_dev, s.j_cst, s.violation = predicted_indicators(c.predicted, qp, z, m.predicted, s.w, c.n_inputs)
    m.answer[:] = z
    return write_rows(c, z, ticks, m.answer_rows)


@kernel
def write_rows(c: Constants, z: Array, ticks: int, rows: Array) -> int:
    """Write the sequence of a profile, in single precision and a row a tick, into `rows`; return its length."""
    length = max(c.sequence_ticks, 2 * ticks)
    samples = (length + TICKS_PER_SAMPLE - 1) // TICKS_PER_SAMPLE
    inputs = inputs_of(c.weights[:samples], z, c.input_scale, c.u0, c.rate)
    for tick in range(length):
        for i in range(3):
            rows[tick, i] = np.float64(np.float32(inputs[tick // TICKS_PER_SAMPLE, i]))
    return length


@kernel
def take_answer(m: Memory) -> None:
    """Let what `solve` has found be what is played: its sequence begins."""
    m.z[:] = m.answer
    m.rows[:] = m.answer_rows
    m.numbers[0].sequences += 1


@kernel
def estimate(c: Constants, m: Memory, u_before: Array, load: float, y: Array, x: Array) -> None:
    """Take the measurement at an updating instant, all in physical units."""
    s = m.numbers[0]
    known = load - c.w0 if c.load_known else 0.0
    if not c.kalman:
        m.x[:] = x - c.x0
        s.w, s.mismatch = known, 0.0
        return
    gain = c.gains[min(s.since, c.gains.shape[0]) - 1]
    m.x[:], s.mismatch = corrected(gain, c.outputs, m.predicted, s.mismatch, u_before - c.u0, known, y - c.y0)
    m.predicted[:] = m.x
    s.w = known + s.mismatch


@kernel
def plan(c: Constants, m: Memory, tick: int, u_before: Array, load: float, y: Array, x: Array) -> Assessment:
    """Take the update latched at `tick`, where the sequence of the last `solve` begins; decide the updating period.

    The decision is in `iterations` and `ticks`; what it was decided by is returned.
    """
    s, rule = m.numbers[0], c.rule
    estimate(c, m, u_before, load, y, x)
    qp = problem_at(c, m.x, s.w, m.u_before, s.played_share)
    effective = with_floor(augmented_cost(qp, m.z, c.alpha), qp.constant, c.floor)
    o = Observation(s.iterations, s.ticks * TICK_S, s.effective, s.hot_start, s.last_but_one, s.delivered, effective)
    assessment = _assess(o)
    wanted = rule.q_min
    if rule.kind == ALGORITHM_1:
        wanted = _one_step(rule.q_min, rule.q_max, rule.delta, s.iterations, assessment.gamma)
    elif rule.kind == CONTRACTION:
        s.contraction = _recent_contraction(rule.contraction, s.contraction, s.contraction_delivered, o)
        s.contraction_delivered = s.delivered
        wanted = _by_contraction(rule.contraction, s.contraction, o)
    s.iterations = min(wanted, rule.most)
    s.ticks = rule.fixed_ticks or rule.periods[s.iterations]
    s.effective, s.update_tick = effective, tick
    return assessment


_assess, _one_step = kernel(assess), kernel(one_step)
_recent_contraction, _by_contraction = kernel(recent_contraction), kernel(by_contraction)
