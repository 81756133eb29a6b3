"""An update and its answer, as kernels: steps (4), (5) and (2) of the paper's section II.

`take_update` is all that an update asks for: what is played from it on, what that costs at the estimated state, which q
follows, and the period that begins. Its answer is `scheme.solve`; `note_answer` notes whether it came in time.
"""

from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc import scheme
from coldloop_optimizer_plc.estimator import Belief, begin_at_rest, correct, forget
from coldloop_optimizer_plc.plausibility import USED, suspects_of
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_optimizer_plc.qp.prediction import bounds_at, find_target, least_warm_load, loads_held
from coldloop_optimizer_plc.qp.problem import hold, shift, shifted
from coldloop_optimizer_plc.rules import Assessment, Observation, UpdatingRule, assessed, decide_by
from coldloop_optimizer_plc.scheme import Constants, OptimizerState

BY_THE_RULE: Final = 0  # the q of a period whose length the rule is to decide
PROVEN: Final = 8
"""Answers in time, one after the other, after which the next is tried with half of what is allowed for late ones: where
some ticks are needed for good, one answer in nine is late."""
LONGEST_GAP_TICKS: Final = 4 * SEQUENCE_ROWS
"""After a longer time without an update nothing is predicted from the last one."""
FIRST: Final = -1  # sentinel for q: there is none before a first period
AFTER_A_STEP: Final = -2  # sentinel for q: the period begins with a load step


class Latched(NamedTuple):
    """An update, in physical units and the on-line type, while the sequence with the number `playing` is played.

    u_before (3,) are the inputs until this tick, u (3,) those from it on, y (22,) the outputs, NaN where a reading is
    bad, x (28,) the states, for state feedback only, ahead what is forecast, as the last states of the model.
    """

    update: int
    tick: int
    playing: int
    load: float
    u_before: Array
    u: Array
    y: Array
    x: Array
    ahead: Array


class Starts(NamedTuple):
    """The q that a rule does not decide."""

    first: int
    after_step: int


@kernel
def shortage(
    c: Constants, x: Array, w: float, load: float, most_open: float, idle: int, at: float, before: float, none: float
) -> float:  # fmt: skip
    """Return what the load is above what can be held, W; negative: below what is needed; `none`, that is 0, otherwise.

    The estimate w (a deviation) has what the plant lacks beside its model, so it is compared with what the model holds
    at rest within the inputs' bounds and the limit of the feed, less a reserve, and with the least that it holds
    without the turbine's outlet getting too cold, by the bias of that. The load itself (W), where it is
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
def judge_played(c: Constants, m: OptimizerState, load: float, y: Array) -> float:
    """Return J of what is played at the state that is estimated now, and find limits and target there."""
    now, played, real = m.numbers[0], m.playing.numbers[0], m.belief.x.dtype.type
    w = m.belief.numbers[0].w
    now.suspects = suspects_of(m.belief.readings)
    turbine = c.turbine  # which stands; a reading that is NaN does not say so
    if y[turbine.speed] < turbine.slow and y[turbine.before] < turbine.ratio * y[turbine.behind]:
        now.suspects += turbine.bit
    idle = scheme.idle_valve(c.turbine, now.suspects)
    at = m.u[max(idle, 0)] / c.input_scale[max(idle, 0)]
    now.most_open = limit_of_feed(c, m, y)
    now.shortage = shortage(c, m.belief.x, w, load, now.most_open, idle, at, now.shortage, real(0.0))
    if not abs(now.shortage) <= real(scheme.LARGEST):  # by an estimate that leads to no answer
        now.shortage = real(0.0)
    find_target(c.target, m.belief.x, w, m.belief.numbers[0].mismatch, now.most_open, idle, at, m.target)
    qp = scheme.problem_at(c, m.belief.x, w, m.playing.u_before, played.share, m.target, now.most_open, idle)
    return scheme.with_floor(augmented_cost(qp, m.playing.z, c.alpha), qp.constant, c.floor)


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
def begin_period(c: Constants, m: OptimizerState, wanted: int, latched: Latched, effective: float) -> None:
    """Begin the period of a q, step (5): its length, and what fits; then step (2), what was sent is played."""
    now = m.numbers[0]
    now.q = max(min(wanted, c.most), 1)  # costs that are no numbers lead a rule anywhere
    adaptive = min(c.periods[now.q] + now.allowance, c.fitting.shape[0] - 1)
    now.ticks = c.fixed_ticks if c.fixed_ticks > 0 else adaptive
    now.iterations = c.fitting[max(now.ticks - now.allowance, 0)]  # where a period cannot grow, they are fewer
    now.update, now.tick, now.load, now.effective, now.planned = (
        latched.update, latched.tick, latched.load, effective, True
    )  # fmt: skip


@kernel
def begin_session(c: Constants, m: OptimizerState) -> None:
    """Begin at the operating point; all numbers of the state are 0 before."""
    forget(m.belief)
    now, played, real = m.numbers[0], m.playing.numbers[0], m.u.dtype.type
    now.guessed_before = now.delivered_before = real(np.inf)
    sample = c.fitting.shape[0] - 1
    played.ticks, played.share = sample, c.rate_shares[sample]


@kernel
def take_update(c: Constants, rule: UpdatingRule, starts: Starts, m: OptimizerState, latched: Latched) -> float:
    """Take an update and begin its updating period; return the load step that ends it, W, or 0.

    The program does the same step by step where estimator or rule are not ours.
    """
    wanted, load_step = follow(c, m, latched), c.load_step
    if wanted == FIRST:
        wanted = starts.first
    elif wanted == AFTER_A_STEP:
        wanted = starts.after_step
        load_step = m.u.dtype.type(0.0)  # a load that keeps moving must not keep the control PLC waiting for ever
    correct(c.estimator, m.belief, latched.u_before, latched.load, latched.y, latched.x)
    effective = judge_played(c, m, latched.load, latched.y)
    if wanted == BY_THE_RULE:  # what is played is the answer to the update before, in time
        o, a = assess_period(c, m, effective)
        wanted = decide_by(rule, m.rule, o, a)
    begin_period(c, m, wanted, latched, effective)
    return load_step


@kernel
def follow(c: Constants, m: OptimizerState, latched: Latched) -> int:
    """Find out what is played from an update on, and end the period before, with all that led to an answer of none.

    Returns the q of the next one, `BY_THE_RULE`, `FIRST` or `AFTER_A_STEP`.
    """
    now, u, real = m.numbers[0], latched.u - c.estimator.u0, m.u.dtype.type
    played, sent = m.playing.numbers[0], m.sent.numbers[0]
    failed = now.solved and sent.length == 0
    if failed:
        now.sequences = max(now.sequences, sent.number)
        now.guessed_before = now.delivered_before = real(np.inf)
        now.planned = now.solved = False
        m.rule[:] = real(0.0)
    elapsed = latched.tick - now.tick if now.planned else 0
    known = now.planned or latched.tick == 0  # a session begins at the operating point
    ours = played.length == 0 or played.number == latched.playing  # or the control PLC has begun none
    ours = ours or (sent.length > 0 and sent.number == latched.playing)
    if not (known and 0 <= elapsed <= LONGEST_GAP_TICKS and ours):
        begin_again(c, m, latched, u, failed and played.number == latched.playing)
    elif 0 < elapsed != now.ticks:
        scheme.predict_played(c, m, elapsed)
    interrupted = now.planned and 0 < elapsed < now.ticks and 0 < c.load_step < abs(latched.load - now.load)
    in_time = follow_sequence(c, m, latched, u)
    now.sequences = max(now.sequences, latched.playing)
    m.u[:] = u
    m.belief.predicted[m.belief.predicted.shape[0] - latched.ahead.shape[0] :] = latched.ahead
    if now.solved:
        now.guessed_before, now.delivered_before = sent.hot_start, sent.delivered
        now.sequences, now.solved = max(now.sequences, sent.number), False
    now.efficiency = now.mismatch = now.contraction = real(1.0)  # nothing is known of how the period went
    now.gamma = real(0.0)
    if not now.planned:
        return FIRST
    if interrupted:
        return AFTER_A_STEP
    return BY_THE_RULE if in_time else now.q


@kernel
def begin_again(c: Constants, m: OptimizerState, latched: Latched, u: Array, plays_on: bool) -> None:  # noqa: FBT001
    """Forget what was sent: others have moved the inputs since, to u (3,), from which the next profile sets out.

    After an update without an answer nobody has: the rest of the sequence `plays_on`, and moves them meanwhile.
    For want of a past the plant is believed to rest: a filter that began at the operating point would take minutes.
    """
    estimator, played, zero = c.estimator, m.playing.numbers[0], m.u.dtype.type(0.0)
    load = latched.load - estimator.w0 if estimator.load_known else zero
    level = latched.y[c.level] - estimator.y0[c.level] if np.isfinite(latched.y[c.level]) else zero
    begin_at_rest(c.rest, m.belief, u, load, estimator.load_known, level)
    hold(u, c.input_scale, c.n_inputs, m.playing.z)
    m.playing.u_before[:] = u
    if not plays_on:
        played.first_tick, played.length = latched.tick, 0
    m.sent.numbers[0].length = 0
    m.numbers[0].planned = False


@kernel
def follow_sequence(c: Constants, m: OptimizerState, latched: Latched, u: Array) -> bool:
    """Find out which profile is played from an update on; return whether it is the last answer, in time."""
    now, played, sent = m.numbers[0], m.playing.numbers[0], m.sent.numbers[0]
    begun, late = sent.length > 0 and sent.number == latched.playing, 0
    if begun:  # the last answer is what is played
        m.playing.numbers[0] = m.sent.numbers[0]
        m.playing.x[:], m.playing.u_before[:], m.playing.z[:] = m.sent.x, m.sent.u_before, m.sent.z
        m.playing.rows[:] = m.sent.rows
        late = latched.tick - sent.first_tick  # scans were missed: it began before this instant
    elif now.planned and played.length == 0:  # others may have moved the inputs again
        hold(u, c.input_scale, c.n_inputs, m.playing.z)
        m.playing.u_before[:] = u
    elif now.planned:
        late = latched.tick - now.tick
    if late >= c.shifts.shape[0]:
        real = m.u.dtype.type
        far = shift(c.knots, real(late) / real(c.fitting.shape[0] - 1))
        m.playing.z[:] = shifted(far, m.playing.z, c.n_inputs)
    elif late > 0:
        m.playing.z[:] = shifted(c.shifts[late], m.playing.z, c.n_inputs)
    return begun and late == 0


@kernel
def note_answer(m: OptimizerState, late: bool) -> None:  # noqa: FBT001
    """Note how an answer came: after a late one adaptive periods get longer, after one in time shorter again.

    The budget is what the PLC should need; this is what machine and link really take. Each late answer doubles what is
    allowed for them, `PROVEN` in time halve it. Where a period is fixed, or is the longest, there are fewer iterations
    instead.
    """
    now = m.numbers[0]
    now.in_time = 0 if late else (now.in_time + 1) % PROVEN
    if late:
        now.allowance = min(max(1, 2 * now.allowance), now.ticks)
    elif now.in_time == 0:
        now.allowance = now.allowance // 2
