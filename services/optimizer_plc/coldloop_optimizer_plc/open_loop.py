"""The watched reading against predictions without it: one that is stuck behind its noise, and what was learnt from it.

A reading without a constant error (L1 of the cold box) decides the load mismatch, which explains why it does not move
while it is stuck. Two predictions begin at the estimate and are corrected by the other readings: a balance of mass and
energy. The younger begins again when the reading moves. One that shows only its noise although that prediction moves is
stuck. The older one began earlier: it has not learnt what the filter learnt from a reading that turns out to be bad.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.plausibility import (
    STUCK,
    USED,
    Plausibility,
    against_the_model,
    count_suspects,
    enter,
    imputed,
)
from coldloop_optimizer_plc.qp.arithmetic import Real
from coldloop_optimizer_plc.qp.linear_algebra import add_transposed_product, respond
from coldloop_optimizer_plc.qp.prediction import Transition

Array = NDArray[np.float64]

YOUNGER: Final = 0
OLDER: Final = 1
NONE: Final = -1.0
"""Age of predictions that have not begun."""
WATCH: Final = (
    "age_s", "shown", "unchanged_s", "count", "mean", "spread", "weight_s", "when_s", "span", "expected", "movement",
    "trend",
)  # fmt: skip
"""age_s: since when the younger prediction is without the reading. shown, unchanged_s: its last value, a deviation, and
for how long it has had these bits. count, mean, spread: readings since then, their mean and variance. weight_s: the
time that these stand for; when_s, span: mean and variance of their ages. expected, movement, trend: mean and variance
of what that predicted, and its covariance with the age."""


class Apart(NamedTuple):
    """Predictions without the watched reading."""

    x: Array
    """States of the younger and the older one at the last measurement, deviations, shape (2, n)."""
    predicted: Array
    """The same predicted from there, as often as it is begun."""
    mismatch: Array
    """Their load mismatches, W, shape (2,)."""
    watch: Any
    """`WATCH`, a record, shape (1,)."""


def none_apart(n_states: int, real: Real) -> Apart:
    """Return what is known at a beginning, for so many states of the model."""
    states = np.zeros((2, n_states), real)
    return Apart(states, states.copy(), np.zeros(2, real), np.zeros(1, [(name, real) for name in WATCH]))


@kernel
def watch(
    p: Plausibility, outputs: Transition, K: Array, J: Array, belief: Any, known: float, u: Array, y: Array,  # noqa: ANN401
    believed: Array, elapsed_s: float,
) -> None:  # fmt: skip
    """Judge the watched reading after the filter has taken a measurement; take back what was learnt from a bad one.

    `known` (W), u (3,) and y (n_y,) are measured load, inputs until then and measurement, as deviations; `believed`
    (n_y,) is the innovation, not a number where a reading is left out; K and J are transposed gain and inverse
    covariance.
    """
    w, r, shown, zero = belief.apart.watch[0], belief.readings[p.watched], y[p.watched], y.dtype.type(0.0)
    if w.age_s < zero:
        begin_younger(belief)
        begin_younger(belief)
    else:
        w.age_s += elapsed_s
        for which in range(belief.apart.x.shape[0]):
            expected = correct_apart(p, outputs, K, J, belief, which, known, u, y, believed)
            if which == YOUNGER and np.isfinite(believed[p.watched]):
                note_movement(w, p.noise.dtype.type(1.0), shown, expected, elapsed_s)
    if r.state != USED and r.since_s == zero and w.unchanged_s > zero:
        take_estimate(belief, YOUNGER if w.age_s >= w.unchanged_s else OLDER, known)
    w.unchanged_s = w.unchanged_s + elapsed_s if shown == w.shown else zero
    w.shown = shown
    moves = has_moved(p, w)
    contradicting, _ = against_the_model(p, belief.readings, belief.surprise, J)
    alone = contradicting < 2 and count_suspects(belief.readings) < p.most
    if alone and r.state == USED and r.since_s >= p.settled_s and not moves and is_expected_to_move(p, w):
        enter(r, STUCK)
        r.jumped_to = w.mean + p.origin
        take_estimate(belief, OLDER, known)
    if r.state != USED:
        begin_younger(belief)
        begin_younger(belief)
    elif (moves and w.age_s >= p.restart_s) or w.age_s >= p.longest_watch_s:
        begin_younger(belief)


@kernel
def begin_younger(belief: Any) -> None:  # noqa: ANN401 a belief
    """Let the younger prediction become the older one, and one that begins at the estimate the younger."""
    w, a, zero = belief.apart.watch[0], belief.apart, belief.x.dtype.type(0.0)
    for i in range(belief.x.size):
        a.x[OLDER, i], a.x[YOUNGER, i] = a.x[YOUNGER, i], belief.x[i]
    a.mismatch[OLDER], a.mismatch[YOUNGER] = a.mismatch[YOUNGER], belief.numbers[0].mismatch
    w.age_s, w.count, w.mean, w.spread, w.weight_s = zero, zero, zero, zero, zero
    w.when_s, w.span, w.expected, w.movement, w.trend = zero, zero, zero, zero, zero


@kernel
def take_estimate(belief: Any, which: int, known: float) -> None:  # noqa: ANN401 a belief
    """Let the filter go on from what was predicted without the watched reading."""
    b = belief.numbers[0]
    belief.x[:] = belief.apart.x[which]
    belief.predicted[:] = belief.x
    b.mismatch = belief.apart.mismatch[which]
    b.w = known + b.mismatch


@kernel
def correct_apart(
    p: Plausibility, outputs: Transition, K: Array, J: Array, belief: Any, which: int, known: float, u: Array,  # noqa: ANN401
    y: Array, believed: Array,
) -> float:  # fmt: skip
    """Correct a prediction by the readings that the filter believes but the watched one; return what that should show.

    Constant errors that the filter has just set to what a reading shows are the same in both.
    """
    a, zero = belief.apart, y.dtype.type(0.0)
    for i in range(y.size):
        if p.constants[i] >= 0 and belief.readings[i].since_s == zero:
            a.predicted[which, p.constants[i]] = belief.x[p.constants[i]]
    expected = respond(outputs.A, outputs.B, outputs.F, a.predicted[which], u, known + a.mismatch[which])
    innovation = y - expected
    for i in range(y.size):
        if i == p.watched or not np.isfinite(believed[i]):
            innovation[i] = np.nan
    correction = np.zeros(belief.x.size + 1, y.dtype)
    add_transposed_product(K, imputed(innovation, J), correction)
    for i in range(belief.x.size):
        a.x[which, i] = a.predicted[which, i] + correction[i]
    a.mismatch[which] += correction[belief.x.size]
    should: float = expected[p.watched]
    return should


@kernel
def predict_apart(A: Array, B: Array, F: Array, belief: Any, u: Array) -> None:  # noqa: ANN401 a belief
    """Predict over a step (A, B, F, transposed) under the input deviation u (3,), with the load that is measured."""
    b, a = belief.numbers[0], belief.apart
    for which in range(a.x.shape[0]):
        later = respond(A, B, F, a.predicted[which], u, b.w - b.mismatch + a.mismatch[which])
        for i in range(later.size):
            a.predicted[which, i] = later[i]


@kernel
def note_movement(w: Any, one: float, shown: float, expected: float, elapsed_s: float) -> None:  # noqa: ANN401
    """Let a reading count in mean and variance, and what was predicted of it by the time that it stands for."""
    w.count += one
    off = shown - w.mean
    w.mean += off / w.count
    w.spread += (off * (shown - w.mean) - w.spread) / w.count
    w.weight_s += elapsed_s
    share, moved, later = elapsed_s / w.weight_s, expected - w.expected, w.age_s - w.when_s
    w.expected += share * moved
    w.when_s += share * later
    w.movement += share * (moved * (expected - w.expected) - w.movement)
    w.span += share * (later * (w.age_s - w.when_s) - w.span)
    w.trend += share * (later * (expected - w.expected) - w.trend)


@kernel
def is_expected_to_move(p: Plausibility, w: Any) -> bool:  # noqa: ANN401 a record
    """Return whether what is predicted moves enough about its trend, which a mismatch that was wrong at first is."""
    enough = w.age_s >= p.restart_s and w.span > p.noise.dtype.type(0.0)
    expected: bool = enough and (w.movement - w.trend * w.trend / w.span) * w.weight_s > p.movement
    return expected


@kernel
def has_moved(p: Plausibility, w: Any) -> bool:  # noqa: ANN401 a record
    """Return whether the readings vary by more than noise; a variance of n has a relative deviation of sqrt(2 / n)."""
    real = p.noise.dtype.type
    largest = real(1.5) + real(5.0) * np.sqrt(real(2.0) / max(w.count, real(1.0)))
    moved: bool = w.spread > largest * p.noise[p.watched] * p.noise[p.watched]
    return moved
