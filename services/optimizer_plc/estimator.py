"""What the optimiser believes of the plant's state at an updating instant."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from coldloop.compiled import kept, kernel
from coldloop.errors import ConfigurationError
from coldloop.process import SAMPLING_PERIOD_S, STATE_NAMES, TICK_S
from coldloop.registers.control_plc import Update
from optimizer_plc.arithmetic import DOUBLE, Real
from optimizer_plc.computing_settings import EstimatorKind, EstimatorSettings, NoiseReference
from optimizer_plc.linear_algebra import add_transposed_product, multiply, respond
from optimizer_plc.prediction import PredictionModel, Transition

Array = NDArray[np.float64]


class Estimate(NamedTuple):
    """State and load as deviations from the operating point."""

    x: Array
    w: float
    mismatch: float
    """Share of w that no sensor saw, W."""


class Estimator(Protocol):
    """Turns measurements at updating instants into states."""

    def reset(self) -> None:
        """Begin at the operating point."""

    def correct(self, update: Update) -> Estimate:
        """Take the measurement at an updating instant."""

    def predict(self, segments: list[tuple[Array, int]]) -> Array:
        """Move to the next updating instant under (input deviation, ticks) segments; return the state there."""


class StateFeedback:
    """Believes the simulated state; not free of offset, for it does not know why the model is wrong."""

    def __init__(self, prediction: PredictionModel, real: Real = DOUBLE) -> None:
        self._model = prediction.rounded(real)
        self.reset()

    def reset(self) -> None:
        """Begin at the operating point."""
        real = self._model.real
        self.estimate = Estimate(np.zeros(self._model.n_states, real), real(0.0), real(0.0))

    def correct(self, update: Update) -> Estimate:
        """Take the simulated state."""
        m = self._model
        self.estimate = Estimate(np.asarray(update.x, m.real) - m.x0, m.real(update.load) - m.w0, m.real(0.0))
        return self.estimate

    def predict(self, segments: list[tuple[Array, int]]) -> Array:
        """Predict with the model."""
        return _through(self._model, self.estimate.x, self.estimate.w, segments)


class KalmanFilter:
    """Stationary Kalman filter on the LTI model with one slow load-mismatch state; a load that is known is fed in."""

    def __init__(self, prediction: PredictionModel, settings: EstimatorSettings, real: Real = DOUBLE) -> None:
        self._model = prediction.rounded(real)
        self.load_known = settings.load_known
        gains = stationary_gains(prediction, settings)
        self.gains = {ticks: gain.astype(real, copy=False) for ticks, gain in gains.items()}
        self.reset()

    def reset(self) -> None:
        """Begin at the operating point."""
        real = self._model.real
        self.x = np.zeros(self._model.n_states, real)
        self.mismatch = real(0.0)
        self.estimate = Estimate(self.x, real(0.0), real(0.0))
        self.since = 1

    def correct(self, update: Update) -> Estimate:
        """Correct the predicted state by the measurement, with the gain of the period that just ended."""
        m = self._model
        u = np.asarray(update.u_before, m.real) - m.u0
        known = m.real(update.load) - m.w0 if self.load_known else m.real(0.0)
        y = np.asarray(update.y, m.real) - m.y0
        gain = self.gains[min(self.since, len(self.gains))]
        self.x, mismatch = corrected(gain, m.outputs, self.x, self.mismatch, u, known, y)
        self.mismatch = m.real(mismatch)
        self.estimate = Estimate(self.x, known + self.mismatch, self.mismatch)
        return self.estimate

    def predict(self, segments: list[tuple[Array, int]]) -> Array:
        """Predict with the model and the mismatch."""
        self.x = _through(self._model, self.estimate.x, self.estimate.w, segments)
        self.since = sum(ticks for _, ticks in segments)
        return self.x


def make_estimator(prediction: PredictionModel, settings: EstimatorSettings, real: Real) -> Estimator:
    """Return the estimator that the settings name.

    Raises:
        ConfigurationError: The simulated state is to be believed, and is not that of the model.
    """
    if settings.kind is EstimatorKind.KALMAN:
        return KalmanFilter(prediction, settings, real)
    if prediction.n_states > len(STATE_NAMES):
        raise ConfigurationError(
            "optimizer_plc.program.estimator.kind=state-feedback: the model has states that the plant does not"
            " tell; use kalman"
        )
    return StateFeedback(prediction, real)


def stationary_gains(prediction: PredictionModel, settings: EstimatorSettings) -> dict[int, Array]:
    """Return the gain of every updating period, in ticks, transposed: (n_y, n + 1); the load mismatch comes last."""
    nx = prediction.n_states
    C = np.ascontiguousarray(np.hstack([prediction.C, prediction.G]))
    by_unit = {
        "Pa": settings.pressure_noise_pa, "m3": settings.volume_noise_m3, "K": settings.temperature_noise_k,
        "kg": settings.mass_noise_kg, "kg/s": settings.flow_noise_kg_s, "bar s": settings.integral_noise_bar_s,
    }  # fmt: skip
    drift = np.array([*(by_unit[unit] for unit in prediction.model.state_units), settings.load_walk_w])
    sensors = np.full(C.shape[0], settings.temperature_sensor)
    sensors[0], sensors[1], sensors[12:] = settings.level_sensor, settings.speed_sensor, settings.pressure_sensor

    def computed() -> Array:
        P = np.diag(100.0 * drift**2)
        gains = []
        for ticks, step in prediction.transitions.items():
            A = np.eye(nx + 1)
            A[:nx, :nx], A[:nx, nx] = step.A, step.F[:, 0]
            process = drift**2 * (ticks * TICK_S / SAMPLING_PERIOD_S)
            measured = sensors**2 * (SAMPLING_PERIOD_S / (ticks * TICK_S) if of_time else 1.0)
            gains.append(stationary_gain(A, C, process, measured, P, settings.longest_riccati).T)
        return np.array(gains)

    tick = prediction.transitions[1]
    of_time = settings.noise_reference is NoiseReference.TIME
    decided_by = (tick.A, tick.F, C, drift, sensors, np.array(settings.longest_riccati), np.ones(int(of_time)))
    found = kept("kalman", b"".join(part.tobytes() for part in decided_by), computed)
    return {ticks: np.ascontiguousarray(gain) for ticks, gain in zip(prediction.transitions, found, strict=True)}


@kernel
def corrected(
    gain: Array, outputs: Transition, x: Array, mismatch: float, u: Array, w: float, y: Array
) -> tuple[Array, float]:
    """Return the state (n,) and the load mismatch (W) after a measurement y (22,); all are deviations.

    `gain` (22, n + 1) is that of the period which ends; `x` and `mismatch` are predicted, `u` (3,) was applied and `w`
    is the known load (W).
    """
    innovation = y - respond(outputs.A, outputs.B, outputs.F, x, u, w + mismatch)
    correction = np.zeros(gain.shape[1], gain.dtype)
    add_transposed_product(gain, innovation, correction)
    return x + correction[:-1], mismatch + correction[-1]


def _through(model: PredictionModel, x: Array, w: float, segments: list[tuple[Array, int]]) -> Array:
    for u, ticks in segments:
        x = model.advance(x, u, w, ticks)
    return x


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

    `process` (n) and `sensors` (n_y) are variances. Sensors are independent, so measurements are taken one after the
    other and no matrix is inverted.
    """
    n, m = A.shape[0], C.shape[0]
    columns = np.zeros((m, n))
    previous = np.zeros((m, n))
    At = np.ascontiguousarray(A.T)
    for _ in range(periods):
        P[:] = multiply(multiply(A, P), At)
        for i in range(n):
            P[i, i] += process[i]
        for output in range(m):
            _measure(P, C, sensors[output], output, columns[output])
        if _settled(columns, previous):
            break
    return _joint_gain(columns, C)


@kernel
def _settled(columns: Array, previous: Array) -> bool:
    """Tell whether no state's gains (a column each) have changed by more than 1e-10 of its largest; remember them."""
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
