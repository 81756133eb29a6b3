"""Decisions of the optimiser as kernels: what an update says of what is played, and how its q is decided.

`take_update` is all that an update asks for, `scheme.solve` all that its answer does.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc.estimator import begin_at_rest, forget
from coldloop_optimizer_plc.qp.profile import hold, shift, shifted
from coldloop_optimizer_plc.rules.interface import UpdatingRule
from coldloop_optimizer_plc.scheme import BY_THE_RULE, Constants, begin_sent, plan, predict_played
from coldloop_optimizer_plc.session_state import OptimizerState

Array = NDArray[np.float64]

PROVEN: Final = 8
"""Answers in time, one after the other, after which the next is tried with half of what is allowed for late ones: where
some ticks are needed for good, one answer in nine is late."""
LONGEST_GAP_TICKS: Final = 4 * SEQUENCE_ROWS
"""After a longer time without an update nothing is predicted from the last one."""
FIRST: Final = -1
"""In the place of a q: that of a first period."""
AFTER_A_STEP: Final = -2
"""That of a period which begins with a load step."""


class Latched(NamedTuple):
    """An update, in physical units and the on-line type."""

    update: int
    tick: int
    playing: int
    """Number of the sequence being played."""
    load: float
    u_before: Array
    """Inputs until this tick, shape (3,)."""
    u: Array
    """Inputs from it on."""
    y: Array
    """Outputs, shape (22,); not a number where a reading is bad."""
    x: Array
    """States, shape (28,), which only state feedback looks at."""
    ahead: Array
    """What is forecast, as the last states of the model."""


class Starts(NamedTuple):
    """The q that a rule does not decide."""

    first: int
    after_step: int


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
    """Take an update and begin its updating period; return the load step that ends it, W, or 0."""
    wanted, load_step = follow(c, m, latched), c.load_step
    if wanted == FIRST:
        wanted = starts.first
    elif wanted == AFTER_A_STEP:
        wanted = starts.after_step
        load_step = m.u.dtype.type(0.0)  # a load that keeps moving must not keep the control PLC waiting for ever
    plan(
        c, rule, m, wanted, latched.update, latched.tick, latched.u_before, latched.load, latched.y, latched.x
    )  # fmt: skip
    return load_step


@kernel
def follow(c: Constants, m: OptimizerState, latched: Latched) -> int:
    """Find out what is played from an update on; return its q, `BY_THE_RULE`, `FIRST` or `AFTER_A_STEP`."""
    now, u = m.numbers[0], latched.u - c.estimator.u0
    failed = now.solved and m.sent.numbers[0].length == 0
    if failed:
        forget_failure(m)
    elapsed = latched.tick - now.tick if now.planned else 0
    known = now.planned or latched.tick == 0  # a session begins at the operating point
    if not (known and 0 <= elapsed <= LONGEST_GAP_TICKS and knows_what_is_played(m, latched.playing)):
        begin_again(c, m, latched, u, failed and m.playing.numbers[0].number == latched.playing)
    elif 0 < elapsed != now.ticks:
        predict_played(c, m, elapsed)
    interrupted = now.planned and 0 < elapsed < now.ticks and 0 < c.load_step < abs(latched.load - now.load)
    in_time = follow_sequence(c, m, latched, u)
    now.sequences = max(now.sequences, latched.playing)
    m.u[:] = u
    m.belief.predicted[m.belief.predicted.shape[0] - latched.ahead.shape[0] :] = latched.ahead
    if not now.planned:
        return FIRST
    if interrupted:
        return AFTER_A_STEP
    return BY_THE_RULE if in_time else now.q


@kernel
def forget_failure(m: OptimizerState) -> None:
    """Forget all that led to an answer that was none: the next update is one without a past."""
    now, real = m.numbers[0], m.u.dtype.type
    now.sequences = max(now.sequences, m.sent.numbers[0].number)
    now.guessed_before = now.delivered_before = real(np.inf)
    now.planned = now.solved = False
    m.rule[:] = real(0.0)


@kernel
def knows_what_is_played(m: OptimizerState, number: int) -> bool:
    """Return whether the control PLC plays something of ours, or has not begun to."""
    played, sent = m.playing.numbers[0], m.sent.numbers[0]
    known: bool = played.length == 0 or played.number == number or (sent.length > 0 and sent.number == number)
    return known


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
    if begun:
        begin_sent(m)
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
