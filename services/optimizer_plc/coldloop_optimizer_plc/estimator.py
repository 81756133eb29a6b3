"""The estimate of the plant's state at an updating instant: a stationary Kalman filter, or state feedback.

Its gains solve the Riccati equation after each updating period, by the recursion itself, in kernels of ours: gains
decide traces, and LAPACK's last bits are not the same on every machine. Tests compare both.
"""

import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from coldloop.errors import ConfigurationError
from coldloop.kernels.compiled import kept, kernel
from coldloop_optimizer_plc import computing_settings as computing
from coldloop_optimizer_plc import plausibility as check
from coldloop_optimizer_plc.qp import linear_algebra as la
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Array, Real
from coldloop_optimizer_plc.qp.prediction import PredictionModel, Transition

MEMORY_TICKS: Final = 240  # a minute of the cold box
UNDETECTABLE: Final = 1e-9  # relative size of a direction that no measurement sees


class StationaryGains(NamedTuple):
    """Kalman gains after periods of 1, 2, ... ticks, transposed, shape (ticks, n_y, n + 1): the load mismatch is last.

    Inverse covariances are those of the innovation, shape (ticks, n_y, n_y).
    """

    gains: Array
    inverse_covariances: Array


class Estimator(NamedTuple):
    """Constants of an estimator in one session, in the on-line floating-point type.

    The Kalman filter is stationary, on the LTI model with one slow load-mismatch state; a load that is known is fed in.
    State feedback takes the simulated state as its estimate; it has an offset, since it does not estimate model errors.
    steps are the transitions over 1, 2, ... ticks, stacked, outputs C, D and G, all transposed. kalman: or else state
    feedback.
    """

    steps: Transition
    outputs: Transition
    x0: Array
    u0: Array
    y0: Array
    w0: float
    tick_s: float
    kalman: bool
    load_known: bool
    stationary: StationaryGains
    plausible: check.Plausibility


class Belief(NamedTuple):
    """Estimates, as deviations from the operating point; kernels overwrite them.

    numbers is a record, shape (1,): `w`, the load (W); `mismatch`, the share of it that no sensor saw; `since`, the
    ticks predicted over since the last measurement. x (n,) is the state there, predicted (n,) that predicted since.
    surprise (n_y,): how far each output was from what the prediction and the other outputs say, over the standard
    deviation that the filter expects, mean square over about `MEMORY_TICKS`. readings (n_y,) are `READING` records.
    """

    numbers: Any
    x: Array
    predicted: Array
    surprise: Array
    readings: Any
    apart: check.Apart


def estimator_of(
    prediction: PredictionModel, settings: computing.EstimatorSettings, real: Real = DOUBLE,
    plausibility: computing.PlausibilitySettings | None = None,
) -> Estimator:  # fmt: skip
    """Return the estimator that the settings name; without `plausibility` whatever sensors show is plausible.

    Raises ConfigurationError if the simulated state is used, and is not that of the model.
    """
    kalman = settings.kind is computing.EstimatorKind.KALMAN
    check_detectability(prediction)
    process, plausible = prediction.process, plausibility or computing.PlausibilitySettings()
    if not kalman and prediction.n_states > len(process.states):
        raise ConfigurationError(
            "optimizer_plc.program.estimator.kind=state-feedback: the model has more states than the plant reports; "
            "use kalman"
        )
    stationary = stationary_gains(prediction, settings) if kalman else StationaryGains(*np.zeros((2, 1, 1, 1)))
    steps = Transition(
        *map(np.array, zip(*(step.transposed() for step in prediction.transitions.values()), strict=True))
    )
    longest_s = len(prediction.transitions) * process.tick_s
    found = Estimator(
        steps, prediction.outputs.transposed(), np.array(prediction.x0), np.array(prediction.u0),
        np.array(prediction.y0), prediction.w0, process.tick_s, kalman, settings.load_known, stationary,
        check.plausibility_of(plausible, prediction, settings.sensors, longest_s, DOUBLE),
    )  # fmt: skip
    return la.rounded(found, real)


def no_belief(n_states: int, n_outputs: int, real: Real = DOUBLE) -> Belief:
    """Return the belief of an estimator that begins at the operating point."""
    numbers = np.zeros(1, [("w", real), ("mismatch", real), ("since", "i8")])
    belief = Belief(
        numbers, np.zeros(n_states, real), np.zeros(n_states, real), np.zeros(n_outputs, real),
        check.new_readings(n_outputs, real), check.none_apart(n_states, real),
    )  # fmt: skip
    forget(belief)
    return belief


@kernel
def forget(belief: Belief) -> None:
    """Begin at the operating point."""
    b, zero = belief.numbers[0], belief.x.dtype.type(0.0)
    belief.x[:] = zero
    belief.predicted[:] = zero
    belief.surprise[:] = zero
    b.w, b.mismatch, b.since = zero, zero, 1
    belief.apart.watch[0].age_s = check.NONE
    for i in range(belief.readings.shape[0]):
        r = belief.readings[i]
        r.state, r.since_s, r.agreed_s, r.spikes_s = check.USED, zero, zero, zero
        r.jump, r.jumped_to, r.difference = zero, zero, zero


@kernel
def begin_at_rest(rest: Array, belief: Belief, u: Array, load: float, load_known: bool, level: float) -> None:  # noqa: FBT001
    """Begin where the plant would rest with the inputs u (3,), load and level, deviations; `rest` is `rest_map`'s.

    A load that is measured may have moved just now: it then says more than what would let the level rest.
    """
    forget(belief)
    last, inputs = rest.shape[0] - 1, u.shape[0]
    for i in range(last + 1):
        found = rest[i, inputs] * load + rest[i, inputs + 1] * level
        for j in range(inputs):
            found += rest[i, j] * u[j]
        if i < last:
            belief.predicted[i] = found
        elif not load_known:
            belief.numbers[0].mismatch = found
    belief.x[:] = belief.predicted


@kernel
def correct(c: Estimator, belief: Belief, u_before: Array, load: float, y: Array, x: Array) -> None:
    """Take a measurement (u_before (3,), load, y (22,), x (28,), in physical units and the on-line type).

    The Kalman filter corrects by the outputs that are finite and plausible.
    """
    b = belief.numbers[0]
    known = load - c.w0 if c.load_known else belief.x.dtype.type(0.0)
    if not c.kalman:
        for i in range(x.shape[0]):
            belief.x[i] = x[i] - c.x0[i]
        b.w, b.mismatch = known, belief.x.dtype.type(0.0)
        return
    real, period, maps = belief.x.dtype.type, min(b.since, c.stationary.gains.shape[0]) - 1, c.outputs
    expected = la.respond(maps.A, maps.B, maps.F, belief.predicted, u_before - c.u0, known + b.mismatch)
    innovation = y - c.y0 - expected
    J = c.stationary.inverse_covariances[period]
    if c.plausible.sigmas > 0.0:
        innovation = check.judge(
            c.plausible, belief.readings, belief.surprise, belief.predicted, y, innovation, J,
            real(b.since) * c.tick_s,
        )  # fmt: skip
    believed = innovation.copy()
    if not check.are_finite(innovation):
        innovation = check.imputed(innovation, J)
    if b.since <= c.stationary.gains.shape[0]:  # J is for no longer time
        check.note_surprise(belief.surprise, innovation, J, real(b.since) * real(1.0 / MEMORY_TICKS))
    correction = np.zeros(belief.x.size + 1, belief.x.dtype)
    la.add_transposed_product(c.stationary.gains[period], innovation, correction)
    belief.x[:] = belief.predicted + correction[:-1]
    belief.predicted[:] = belief.x
    b.mismatch += correction[belief.x.size]
    b.w = known + b.mismatch
    if c.plausible.watched >= 0:
        check.watch(
            c.plausible, maps, c.stationary.gains[period], J, belief, known, u_before - c.u0, y - c.y0, believed,
            real(b.since) * c.tick_s,
        )  # fmt: skip


@kernel
def begin_prediction(belief: Belief) -> None:
    """Predict from the last measurement on."""
    belief.predicted[:] = belief.x
    if belief.apart.watch[0].age_s >= 0.0:
        belief.apart.predicted[:] = belief.apart.x
    belief.numbers[0].since = 0


@kernel
def predict(c: Estimator, belief: Belief, u: Array, ticks: int) -> None:
    """Predict so many ticks further under the input deviation u (3,)."""
    b = belief.numbers[0]
    b.since += ticks
    longest = c.steps.A.shape[0]
    while ticks > 0:
        step = min(ticks, longest)
        A, B, F = c.steps.A[step - 1], c.steps.B[step - 1], c.steps.F[step - 1]
        belief.predicted[:] = la.respond(A, B, F, belief.predicted, u, b.w)
        if belief.apart.watch[0].age_s >= 0.0:
            for which in range(belief.apart.x.shape[0]):
                w = b.w - b.mismatch + belief.apart.mismatch[which]
                belief.apart.predicted[which] = la.respond(A, B, F, belief.apart.predicted[which], u, w)
        ticks -= step


def check_detectability(prediction: PredictionModel) -> None:
    """Raise a ConfigurationError unless disturbances are observable beside states and load (Hautus' test at 1)."""
    if not prediction.disturbances:
        return
    n, step = prediction.n_estimated, prediction.sample
    modes = np.vstack([
        np.hstack([step.A[:n, :n] - np.eye(n), step.F[:n]]), np.hstack([prediction.C[:, :n], prediction.G])
    ])  # fmt: skip
    if not prediction.process.has_load:
        modes = modes[:, :n]
    modes /= np.maximum(np.linalg.norm(modes, axis=0), UNDETECTABLE)
    _, sizes, directions = np.linalg.svd(modes)
    if sizes[-1] > UNDETECTABLE:
        return
    shares = np.abs(directions[-1][n - len(prediction.disturbances) : n])
    worst = computing.signals_of(prediction.process)[prediction.disturbances[int(np.argmax(shares))]]
    raise ConfigurationError(
        f"optimizer_plc.program.estimator.disturbances: no sensor tells a constant error of {worst} from the plant's"
        " state, the load and the other errors: leave it out"
    )


def walks_of(prediction: PredictionModel, settings: computing.EstimatorSettings) -> Array:
    """Return the process noise of the states, the constants among them, and of the load mismatch, shape (n + 1,)."""
    by_unit = {
        "Pa": settings.pressure_noise_pa, "m3": settings.volume_noise_m3, "K": settings.temperature_noise_k,
        "kg": settings.mass_noise_kg, "kg/s": settings.flow_noise_kg_s, "bar s": settings.integral_noise_bar_s,
    }  # fmt: skip
    units, states = prediction.model.state_units, prediction.process.states
    declared = [state.walk for state in states] + [None] * (len(units) - len(states))
    of_states = [by_unit[unit] if walk is None else walk for walk, unit in zip(declared, units, strict=True)]
    constants = np.array([settings.disturbance_walk * one for one in settings.sensors] + [*settings.input_walk])
    chosen = constants[list(prediction.disturbances)]
    return np.array([*of_states, *chosen, settings.load_walk_w])


def stationary_gains(prediction: PredictionModel, settings: computing.EstimatorSettings) -> StationaryGains:
    """Return what the Kalman filter corrects with after every updating period; what is forecast it leaves alone.

    Raises ConfigurationError if there is none for a period.
    """
    nx = prediction.n_estimated
    C = np.ascontiguousarray(np.hstack([prediction.C[:, :nx], prediction.G]))
    steps = {ticks: (step.A[:nx, :nx], step.F[:nx, 0]) for ticks, step in prediction.transitions.items()}
    of_time = settings.noise_reference is computing.NoiseReference.TIME
    drift, sensors = walks_of(prediction, settings), np.array(settings.sensors)
    process = prediction.process
    found = kept(
        "kalman", gains_after, steps, C, drift, sensors, of_time, settings.longest_riccati, process.tick_s,
        process.sampling_period_s,
    )  # fmt: skip
    gains, inverses = np.split(found, [nx + 1], axis=2)
    gains = np.insert(gains, [nx] * len(prediction.ahead), 0.0, axis=2)
    return StationaryGains(np.ascontiguousarray(gains), np.ascontiguousarray(inverses))


ASYMMETRY: Final = 1e-11
"""Difference of mirrored elements of P, over the standard deviations of both states, that is left. Rounding causes
1e-13 where no mode grows; gains are computed to 1e-10."""
RESIDUAL: Final = 1e-3
"""Change of the covariance of states and innovation by a step of the recursion, over the standard deviations of both,
that a stationary one may have. One that still settles after thousands of steps has 1e-6, one that diverges 1."""
GROWTH: Final = 1e-6
"""Largest growth of an error in a period that is taken for rounding: eigenvalues of 1, and equal ones, are rounded so.
"""
ATTEMPTS: Final = 50
"""Runs of the recursion, each from where the last one ended: a mode that grows slowly and is hardly seen needs more."""


def gains_after(
    steps: Mapping[int, tuple[Array, Array]], C: Array, drift: Array, sensors: Array, of_time: bool, periods: int,  # noqa: FBT001
    tick_s: float, sampling_period_s: float,
) -> Array:  # fmt: skip
    """Return the stationary gains, transposed, beside the inverse covariances, shape (steps, n_y, n + 1 + n_y).

    A recursion of so many `periods` at most begins at the covariance of the period before, which has been checked.
    Raises ConfigurationError if it does not converge. `steps` are A (n, n) and F (n,) over so many ticks; C is that of
    states and load mismatch, shape (n_y, n + 1). Standard deviations are `drift` (n + 1,), of the process noise in a
    sampling period, and `sensors` (n_y,), of a measurement or, where `of_time`, of a mean over a sampling period. A
    tick and the model's sampling period are given in s.
    """
    P, n, found = np.diag(100.0 * drift**2), len(drift) - 1, []
    for ticks, (step, load) in steps.items():
        A = np.eye(n + 1)
        A[:n, :n], A[:n, n] = step, load
        process = drift**2 * (ticks * tick_s / sampling_period_s)
        measured = sensors**2 * (sampling_period_s / (ticks * tick_s) if of_time else 1.0)
        gain = _converged(A, C, process, measured, P, periods)
        if gain is None:
            raise ConfigurationError(
                f"optimizer_plc.program.estimator: no stationary Kalman filter for updating periods of"
                f" {ticks * tick_s:g} s, the Riccati recursion does not converge: either no sensor shows a mode that"
                f" does not decay, or noise and walks are too far apart, or longest_riccati = {periods} is too short"
            )
        found.append(np.hstack([gain.T, inverse_covariance(A, C, process, measured, P)]))
    return np.array(found)


def _converged(A: Array, C: Array, process: Array, sensors: Array, P: Array, periods: int) -> Array | None:
    """Return the stationary gain, or None where there is none; arguments are as in `stationary_gain`."""
    for _ in range(ATTEMPTS):
        gain = stationary_gain(A, C, process, sensors, P, periods)
        if not np.isfinite(gain).all():
            return None
        if not is_stationary(A, C, process, sensors, P):
            continue
        if np.abs(np.linalg.eigvals(A - gain @ (C @ A))).max() <= 1.0 + GROWTH:  # an error that none sees may stay
            return gain
    return None


@np.errstate(all="ignore")
def is_stationary(A: Array, C: Array, process: Array, sensors: Array, P: Array) -> bool:
    """Return whether P (n, n) solves the Riccati equation but for `RESIDUAL`; arguments are as in `inverse_covariance`.

    Judged is what P says of the sensors: a constant that no sensor shows is ever less certain, and changes no gain.
    """
    later = P.copy()
    stationary_gain(A, C, process, sensors, later, 1)
    (shown, sizes), (again, _) = (_shown(A, C, process, sensors, each) for each in (P, later))
    return bool((np.abs(again - shown) <= RESIDUAL * sizes).all())  # not where there is a NaN


def _shown(A: Array, C: Array, process: Array, sensors: Array, P: Array) -> tuple[Array, Array]:
    """Return the covariance of states and innovation, shape (n, n_y), and the product of their standard deviations."""
    before = A @ P @ A.T + np.diag(process)
    shown = before @ C.T
    return shown, np.sqrt(np.outer(np.diag(before), np.diag(C @ shown) + sensors))


def inverse_covariance(A: Array, C: Array, process: Array, sensors: Array, P: Array) -> Array:
    """Return the inverse (n_y, n_y) of the innovation's covariance; P (n, n) is that of the state before the period.

    `process` (n) and `sensors` (n_y) are variances.
    """
    before = la.multiply(la.multiply(A, P), np.ascontiguousarray(A.T)) + np.diag(process)
    S = la.multiply(la.multiply(C, before), np.ascontiguousarray(C.T)) + np.diag(sensors)
    inverse, skyline = np.eye(len(C)), la.cholesky(S)
    for column in inverse:
        la.cholesky_solve(S, skyline, column)
    return inverse


@kernel
def _measure(P: Array, C: Array, sensor: float, output: int, column: Array) -> None:
    """Write the gain of one scalar measurement into `column` and update P by it."""
    n = P.shape[0]
    variance = sensor
    for i in range(n):
        column[i] = 0.0
        for j in range(n):
            column[i] += P[i, j] * C[output, j]
    for i in range(n):
        variance += C[output, i] * column[i]
    for i in range(n):
        for j in range(n):
            P[i, j] -= column[i] * column[j] / variance
    for i in range(n):
        column[i] /= variance


@kernel
def stationary_gain(A: Array, C: Array, process: Array, sensors: Array, P: Array, periods: int) -> Array:
    """Return the stationary gain (n, n_y) by the Riccati recursion from P, which ends as the stationary covariance.

    `process` (n) and `sensors` (n_y) are variances; independent measurements are taken in turn, nothing is inverted.
    """
    n, m = A.shape[0], C.shape[0]
    columns = np.zeros((m, n))
    previous = np.zeros((m, n))
    At = np.ascontiguousarray(A.T)
    for _ in range(periods):
        P[:] = la.multiply(la.multiply(A, P), At)
        _keep_symmetric(P)
        for i in range(n):
            P[i, i] += process[i]
        for output in range(m):
            _measure(P, C, sensors[output], output, columns[output])
        if _settled(columns, previous):
            break
    return _joint_gain(columns, C)


@kernel
def _keep_symmetric(P: Array) -> None:
    """Average mirrored elements of P that rounding has driven apart by more than `ASYMMETRY`.

    No measurement reduces the antisymmetric part: a mode that grows would multiply it until P is no covariance.
    """
    for i in range(P.shape[0]):
        for j in range(i):
            apart = P[i, j] - P[j, i]
            if apart * apart > ASYMMETRY * ASYMMETRY * P[i, i] * P[j, j]:
                P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@kernel
def _settled(columns: Array, previous: Array) -> bool:
    """Return whether no state's gains (a column each) have changed by more than 1e-10 of its largest; remember them."""
    settled = True
    for i in range(columns.shape[1]):
        change, size = 0.0, 0.0
        for output in range(columns.shape[0]):
            change = max(change, abs(columns[output, i] - previous[output, i]))
            size = max(size, abs(columns[output, i]))
            previous[output, i] = columns[output, i]
        settled = settled and change <= 1e-10 * size
    return settled


@kernel
def _joint_gain(columns: Array, C: Array) -> Array:
    """Return the matrix that does at once what the scalar corrections `columns` (n_y, n) do one after the other."""
    m, n = columns.shape
    gain = np.zeros((n, m))
    for source in range(m):
        x = np.zeros(n)
        for output in range(m):
            residual = 1.0 if output == source else 0.0
            for j in range(n):
                residual -= C[output, j] * x[j]
            for i in range(n):
                x[i] += columns[output, i] * residual
        for i in range(n):
            gain[i, source] = x[i]
    return gain


class PlantModel(NamedTuple):
    """x' = A x + B u + F w over a tick, y = C x + D u + G w, as deviations from the operating point; w has shape (1,).

    The last `constants` states are those that `estimator.disturbances` names: nothing moves them, and C adds them.
    noise (n_y,) are the standard deviations of the sensors, walks (n + 1,) the process noise of the states and, last,
    of the load's mismatch, per square root of a tick.
    """

    A: Array
    B: Array
    F: Array
    C: Array
    D: Array
    G: Array
    tick_s: float
    constants: int
    noise: Array
    walks: Array


class Measured(NamedTuple):
    """Measurement at an updating instant, as deviations from the operating point, ticks after the last one.

    Inputs u (m,) were applied until now; load is 0 where it is not measured, y (n_y,) NaN where a reading is bad.
    """

    ticks: int
    u: Array
    load: float
    y: Array


class OutsideCorrection(Protocol):
    """Estimator that an entry point makes for each session; the same measurements give the same bits."""

    def __init__(self, model: PlantModel) -> None:
        """Begin at the operating point."""

    def correct(self, predicted: Array, mismatch: float, measured: Measured) -> tuple[Array, float]:
        """Return the state (n,) and the load's mismatch after a measurement, from those that were predicted for it.

        The load that acts is `measured.load` plus the mismatch, which is the share that no sensor sees.
        """


class OutsideEstimator:
    """One of these: what it returns is checked; what is no estimate, or not finite, leaves the prediction as it is."""

    def __init__(self, name: str, prediction: PredictionModel, settings: computing.EstimatorSettings) -> None:
        self.name = name
        self._n_states = prediction.n_estimated
        self._estimator: OutsideCorrection = computing.made(
            computing.Part.ESTIMATOR, name, plant_model(prediction, settings)
        )

    def correct(self, c: Estimator, belief: Belief, u_before: Array, load: float, y: Array) -> None:
        """Take a measurement (u_before (m,), load, y (n_y,), in physical units), as `estimator.correct` does.

        Raises ConfigurationError if the estimator raises, or returns something else than a state and a number.
        """
        b, predicted = belief.numbers[0], belief.predicted[: self._n_states]
        known = load - c.w0 if c.load_known else 0.0
        measured = Measured(int(b["since"]), u_before - c.u0, known, y - c.y0)
        with computing.in_its_name(computing.Part.ESTIMATOR, self.name):
            x, mismatch = self._estimator.correct(predicted.copy(), float(b["mismatch"]), measured)
            x, mismatch = np.asarray(x, np.float64), float(mismatch)
        if x.shape == predicted.shape and np.isfinite(x).all() and math.isfinite(mismatch):
            predicted[:], b["mismatch"] = x, mismatch
        belief.x[:] = belief.predicted
        b["w"] = known + b["mismatch"]


def plant_model(prediction: PredictionModel, settings: computing.EstimatorSettings) -> PlantModel:
    """Return what an outside estimator is given of the model: copies, which it may change."""
    n, step, process = prediction.n_estimated, prediction.transitions[1], prediction.process
    A, B, F = step.A[:n, :n].copy(), step.B[:n].copy(), step.F[:n].copy()
    C, D, G = prediction.C[:, :n].copy(), prediction.D.copy(), prediction.G.copy()
    walks = walks_of(prediction, settings) * math.sqrt(process.tick_s / process.sampling_period_s)
    return PlantModel(A, B, F, C, D, G, process.tick_s, len(prediction.disturbances), np.array(settings.sensors), walks)
