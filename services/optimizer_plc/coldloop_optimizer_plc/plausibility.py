"""Readings against the prediction and against each other: the innovation of a Kalman filter, and the mask of suspects.

The residual of an output is its innovation less what those of the others say of it; over its standard deviation it is
standard normal where plant and sensors are as the filter takes them, and its square is what the quadratic form of all
innovations loses without the output. So one wrong reading has the largest residual, and without it all others agree.

A reading without a bias (L1 of the cold box) decides the load mismatch, which explains why it does not move
while it is stuck. It is watched against two predictions without it, which begin at the estimate and are corrected by
the other readings: a balance of mass and energy. The younger begins again when the reading moves. One that shows only
its noise although that prediction moves is stuck. The older one began earlier: it has not learnt what the filter learnt
from a reading that turns out to be bad.
"""

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.computing_settings import PlausibilitySettings
from coldloop_optimizer_plc.qp import linear_algebra as la
from coldloop_optimizer_plc.qp.linear_algebra import Array, Real
from coldloop_optimizer_plc.qp.prediction import PredictionModel, Transition

USED: Final = 0  # a reading is used by the filter
MISSING: Final = 1  # the reading is NaN: the control PLC has masked it
SUSPECT: Final = 2  # it contradicts prediction and other readings, and is left out
STUCK: Final = 3  # the same of one that shows nothing but its noise while the prediction moves (`watch`)
FORGETTING: Final = 0.1  # share of the time without a spike that is taken off the time with one
RESTART, LONGEST_WATCH = 0.5, 10.0  # times to the restart and of the longest watch, in multiples of `settled_s`
READING: Final = (
    ("state", "i8"), ("since_s", "real"), ("agreed_s", "real"), ("jump", "real"), ("jumped_to", "real"),
    ("difference", "real"), ("spikes_s", "real"),
)  # fmt: skip
"""state: `USED`, `MISSING`, `SUSPECT` or `STUCK`. since_s: how long it has been that. agreed_s: for how long a suspect
has agreed with the others again. jump, jumped_to: by how much it differed from what the others say of it after its last
jump, and what it showed then; of one that is stuck, where. difference: by how much it differs now. spikes_s: for how
long one that is used has been left out as a spike."""


class Plausibility(NamedTuple):
    """Limits of the plausibility check, in the on-line floating-point type; those of `PlausibilitySettings`, and more.

    allowance, constants, low, high and noise have shape (n_y,). in_all: largest quadratic form of the innovations that
    the outputs which are left may have. longest_period_s: that inverse covariances are for. constants: state that is
    the bias of each output, below 0: it has none. low, high: outputs whose prediction is outside are not judged. noise:
    standard deviation of each sensor. watched: output that is judged by predictions without it, or -1. origin: its
    reading at the operating point. movement: integral of the square of that prediction about its trend from which on
    the reading must move, squared unit times s. restart_s: time after which the prediction begins again where the
    reading moves; longer than a frozen one goes unnoticed.
    """

    sigmas: float
    allowance: Array
    in_all: float
    longest_period_s: float
    settled_s: float
    agreeing_s: float
    longest_s: float
    most: int
    model_sigmas: float
    constants: NDArray[np.int64]
    spike_s: float
    forgetting: float
    low: Array
    high: Array
    noise: Array
    watched: int
    origin: float
    movement: float
    restart_s: float
    longest_watch_s: float


def plausibility_of(
    settings: PlausibilitySettings, prediction: PredictionModel, noise: Sequence[float], longest_period_s: float,
    real: Real,
) -> Plausibility:  # fmt: skip
    """Return what is plausible with a model, sensors and inverse covariances for periods up to the longest."""
    n_y = len(prediction.y0)
    constants = np.full(n_y, -1)
    disturbances = prediction.disturbances
    for place, signal in enumerate(disturbances, prediction.n_estimated - len(disturbances)):
        if signal < n_y:
            constants[signal] = place
    spread = 2.0 / (9.0 * n_y)  # Wilson and Hilferty: the quantile of chi-square at so many sigmas
    in_all = n_y * (1.0 - spread + settings.sigmas * math.sqrt(spread)) ** 3
    low, high = np.array(settings.spans).T
    watched = watched_output(settings, prediction)
    movement = (settings.movement_sigmas * noise[watched]) ** 2 * settings.settled_s
    found = Plausibility(
        settings.sigmas, np.array(settings.allowances), in_all, longest_period_s, settings.settled_s,
        settings.agreeing_s, settings.longest_s, settings.most, settings.model_sigmas, constants, settings.spike_s,
        FORGETTING, low, high, np.array(noise), watched, prediction.y0[watched], movement,
        RESTART * settings.settled_s, LONGEST_WATCH * settings.settled_s,
    )  # fmt: skip
    return la.rounded(found, real)


def watched_output(settings: PlausibilitySettings, prediction: PredictionModel) -> int:
    """Return the controlled output that has no bias, where readings are judged; or -1."""
    without = [output for output in prediction.constrained if output not in prediction.disturbances]
    judged = settings.sigmas and settings.movement_sigmas and not prediction.ahead
    return without[0] if judged and without else -1


def new_readings(n_outputs: int, real: Real) -> Any:  # noqa: ANN401 records
    """Return the state of all readings at a beginning: used since just now, shape (n_y,)."""
    return np.zeros(n_outputs, [(name, real if kind == "real" else kind) for name, kind in READING])


@kernel
def note_surprise(surprise: Array, innovation: Array, J: Array, share: float) -> None:
    """Let an innovation (n_y,), whose inverse covariance is J, count with a share of up to 1 in the mean squares.

    (J e)_i / sqrt(J_ii) is the residual of output i given all others, over its standard deviation.
    """
    for i in range(surprise.shape[0]):
        residual = residual_of(i, innovation, J)
        surprise[i] += min(share, surprise.dtype.type(1.0)) * (residual * residual - surprise[i])


@kernel
def residual_of(output: int, innovation: Array, J: Array) -> float:
    """Return the residual of an output given all others, over its standard deviation."""
    total = innovation.dtype.type(0.0)
    for j in range(innovation.shape[0]):
        total += J[output, j] * innovation[j]
    residual: float = total / np.sqrt(J[output, output])
    return residual


@kernel
def are_finite(values: Array) -> bool:
    """Return whether all of them (n,) are."""
    finite = True
    for i in range(values.shape[0]):
        finite = finite and np.isfinite(values[i])
    return finite


@kernel
def imputed(innovation: Array, inverse_covariance: Array) -> Array:
    """Return the innovation (n_y,), its elements that are not finite replaced by their mean given the others.

    J_MM e_M = -J_MO e_O, with the inverse covariance J (n_y, n_y): the gain for all outputs then corrects as that for
    the others alone. Without any it is zero.
    """
    n, real, missing, one = innovation.size, innovation.dtype.type, 0, 0
    M, mean = np.zeros((n, n), innovation.dtype), np.zeros(n, innovation.dtype)
    for i in range(n):
        if np.isfinite(innovation[i]):
            M[i, i], mean[i] = real(1.0), innovation[i]
        else:
            missing, one = missing + 1, i
    if missing == 1:  # most often; what follows would find the same, bit by bit
        for j in range(n):
            if j != one:
                mean[one] -= inverse_covariance[one, j] * innovation[j]
        pivot = np.sqrt(inverse_covariance[one, one])
        mean[one] = mean[one] / pivot / pivot
        return mean
    for i in range(n):
        if not np.isfinite(innovation[i]):
            for j in range(n):
                if np.isfinite(innovation[j]):
                    mean[i] -= inverse_covariance[i, j] * innovation[j]
                else:
                    M[i, j] = inverse_covariance[i, j]
    la.cholesky_solve(M, la.cholesky(M), mean)
    return mean


@kernel
def judge(
    p: Plausibility, readings: Any, surprise: Array, predicted: Array, y: Array, innovation: Array, J: Array,  # noqa: ANN401
    elapsed_s: float,
) -> Array:  # fmt: skip
    """Return the innovation (n_y,) of a measurement y (n_y,) with suspected sensors masked as NaN.

    `readings` is `new_readings`'s, `surprise` that of the readings so far, `elapsed_s` the time since the judgement
    before. Biases in `predicted` are set to a reading that is reinstated. There are no new suspects
    after a longer time than J is for.
    """
    believed, returning = innovation.copy(), False
    for i in range(innovation.shape[0]):
        r = readings[i]
        if r.since_s < p.settled_s <= r.since_s + elapsed_s:
            surprise[i] = 0.0  # by what it has shown until now nobody is judged
        r.since_s += elapsed_s
        r.spikes_s = max(r.spikes_s - p.forgetting * elapsed_s, innovation.dtype.type(0.0))
        if r.state == USED and not p.low[i] <= y[i] - innovation[i] <= p.high[i]:
            r.since_s = 0.0  # there the plant is not as its model
        if not np.isfinite(innovation[i]):
            if r.state != STUCK:  # which it is still when it shows something again
                enter(r, MISSING)
        elif r.state != USED:
            believed[i] = np.nan
            returning = True
    contradicting, contradicts = against_the_model(p, readings, surprise, J)
    if returning:
        take_back(p, readings, predicted, y, innovation, believed, J, elapsed_s, contradicting)
    if elapsed_s <= p.longest_period_s and contradicting < 2:
        suspect_some(p, readings, believed, J, contradicts, elapsed_s)
    return believed


@kernel
def against_the_model(p: Plausibility, readings: Any, surprise: Array, J: Array) -> tuple[int, int]:  # noqa: ANN401
    """Return how many readings that are believed and judged say that the model does not hold; one of them, or -1."""
    count, one = 0, -1
    for i in range(surprise.shape[0]):
        limit = p.model_sigmas + p.allowance[i] * np.sqrt(J[i, i])
        judged = readings[i].state == USED and readings[i].since_s >= p.settled_s
        if judged and surprise[i] > limit * limit:
            count, one = count + 1, i
    return count, one


@kernel
def enter(r: Any, state: int) -> None:  # noqa: ANN401 a record
    """Let a reading be in a state."""
    if r.state != state:
        r.state, r.since_s, r.agreed_s, r.spikes_s = state, 0.0, 0.0, 0.0


@kernel
def take_back(
    p: Plausibility, readings: Any, predicted: Array, y: Array, innovation: Array, believed: Array, J: Array,  # noqa: ANN401
    elapsed_s: float, contradicting: int,
) -> None:  # fmt: skip
    """Take back suspects that agree again, wander off or have been out for the longest time, and what was missing.

    After a long time, or when others contradict the model, what they say of a reading is no better than the reading:
    its bias, if it has one, is set so that it agrees. One without (L1) counts again in full, and so only
    where two or more contradict: one of them may itself be wrong. One that is stuck must have moved before. One that
    agrees has been judged all the time, and no jump ends the longest time.
    """
    expected = imputed(believed, J)
    for i in range(innovation.shape[0]):
        r, difference = readings[i], innovation[i] - expected[i]
        if r.state != USED and np.isfinite(difference):
            largest = p.allowance[i] + p.sigmas / np.sqrt(J[i, i])
            if abs(difference) > largest:
                r.agreed_s = 0.0
            else:
                r.agreed_s += elapsed_s
            jumps = r.since_s <= elapsed_s or abs(difference - r.difference) > largest
            if r.state == STUCK:
                jumps = abs(y[i] - r.jumped_to) > (p.sigmas + p.sigmas) * p.noise[i]
                if jumps:
                    r.state, r.agreed_s, r.since_s = SUSPECT, 0.0, 0.0
            if jumps and r.state != STUCK:
                r.jump, r.jumped_to = difference, y[i]
            r.difference = difference
            agrees = r.state == SUSPECT and r.agreed_s >= p.agreeing_s
            model_fails = contradicting > (0 if p.constants[i] >= 0 else 1)
            wanders = r.state == SUSPECT and wanders_off(r, y[i], largest)
            too_long = r.state == SUSPECT and r.since_s >= p.longest_s and not jumps
            if agrees or model_fails or wanders or too_long or r.state == MISSING:
                believed[i] = innovation[i]
                if not agrees and p.constants[i] >= 0:
                    predicted[p.constants[i]] += difference
                    believed[i] = expected[i]
                enter(r, USED)
                if agrees:
                    r.since_s = p.settled_s


@kernel
def wanders_off(r: Any, shown: float, least: float) -> bool:  # noqa: ANN401 a record
    """Return whether a suspect has moved away from what the others say, by itself and as far again as it had jumped.

    So does a sound sensor when the plant is no longer as its model (a valve is stuck), and one that drifts, which is
    believed, too. One that shows too much by a constant does not, nor does one that is stuck or jumps about.
    """
    away = r.difference - r.jump
    moved = shown - r.jumped_to if away > 0.0 else r.jumped_to - shown
    wanders: bool = abs(away) > max(abs(r.jump), least) and moved + moved >= abs(away)
    return wanders


@kernel
def suspect_some(
    p: Plausibility, readings: Any, believed: Array, J: Array, only: int, elapsed_s: float  # noqa: ANN401
) -> None:  # fmt: skip
    """Leave out readings whose residual is too large, the worst first, if what is left then agrees in all.

    Where one says that the model does not hold it is the `only` one that may be wrong itself; -1: any may. A reading
    is a suspect when it has been left out for longer than a spike.
    """
    before, expected, out = believed.copy(), believed.copy(), count_suspects(readings)
    if not are_finite(believed):
        expected = imputed(believed, J)
    worst = least_plausible(p, readings, believed, expected, J, only)
    if worst < 0:
        return
    while worst >= 0 and out < p.most:
        believed[worst] = np.nan
        out += 1
        expected = imputed(believed, J)
        worst = least_plausible(p, readings, believed, expected, J, only)
    total = believed.dtype.type(0.0)
    for i in range(believed.shape[0]):
        for j in range(believed.shape[0]):
            total += expected[i] * J[i, j] * expected[j]
    if worst >= 0 or total > p.in_all:  # so many do not fail at once: it is the plant
        believed[:] = before
        return
    for i in range(believed.shape[0]):
        if np.isfinite(before[i]) and not np.isfinite(believed[i]):
            r = readings[i]
            r.spikes_s += elapsed_s + p.forgetting * elapsed_s
            if r.spikes_s > p.spike_s:
                enter(r, SUSPECT)


@kernel
def count_suspects(readings: Any) -> int:  # noqa: ANN401 records
    """Return how many readings are suspects."""
    count = 0
    for i in range(readings.shape[0]):
        if readings[i].state >= SUSPECT:
            count += 1
    return count


@kernel
def least_plausible(p: Plausibility, readings: Any, believed: Array, expected: Array, J: Array, only: int) -> int:  # noqa: ANN401
    """Return the reading with the largest residual of those that are too large, or -1; new ones are not judged."""
    worst, largest = -1, p.sigmas
    for i in range(believed.shape[0]):
        if np.isfinite(believed[i]) and readings[i].since_s >= p.settled_s and (only < 0 or only == i):
            size = abs(residual_of(i, expected, J)) - p.allowance[i] * np.sqrt(J[i, i])
            if size > largest:
                worst, largest = i, size
    return worst


@kernel
def suspects_of(readings: Any) -> int:  # noqa: ANN401 records
    """Return the suspects: bit i is output i."""
    mask, bit = 0, 1
    for i in range(readings.shape[0]):
        if readings[i].state >= SUSPECT:
            mask += bit
        bit += bit
    return mask


YOUNGER: Final = 0
OLDER: Final = 1
NONE: Final = -1.0  # age of predictions that have not begun
WATCH: Final = (
    "age_s", "shown", "unchanged_s", "count", "mean", "spread", "weight_s", "when_s", "span", "expected", "movement",
    "trend",
)  # fmt: skip
"""age_s: since when the younger prediction is without the reading. shown, unchanged_s: its last value, a deviation, and
for how long it has had these bits. count, mean, spread: readings since then, their mean and variance. weight_s: the
time that these stand for; when_s, span: mean and variance of their ages. expected, movement, trend: mean and variance
of what that predicted, and its covariance with the age."""


class Apart(NamedTuple):
    """Predictions without the watched reading, the younger and the older one, as deviations.

    x (2, n) are their states at the last measurement, predicted (2, n) those predicted from there as often as it is
    begun, mismatch (2,) their load mismatches, W; watch (1,) is a `WATCH` record.
    """

    x: Array
    predicted: Array
    mismatch: Array
    watch: Any


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
    a.x[OLDER] = a.x[YOUNGER]
    a.x[YOUNGER] = belief.x
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
    """Correct a prediction by the readings that the filter uses but the watched one; return what that should show.

    Biases that the filter has just set to a reading are the same in both.
    """
    a, zero = belief.apart, y.dtype.type(0.0)
    for i in range(y.size):
        if p.constants[i] >= 0 and belief.readings[i].since_s == zero:
            a.predicted[which, p.constants[i]] = belief.x[p.constants[i]]
    expected = la.respond(outputs.A, outputs.B, outputs.F, a.predicted[which], u, known + a.mismatch[which])
    innovation = y - expected
    for i in range(y.size):
        if i == p.watched or not np.isfinite(believed[i]):
            innovation[i] = np.nan
    correction = np.zeros(belief.x.size + 1, y.dtype)
    la.add_transposed_product(K, imputed(innovation, J), correction)
    a.x[which] = a.predicted[which] + correction[:-1]
    a.mismatch[which] += correction[belief.x.size]
    should: float = expected[p.watched]
    return should


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
