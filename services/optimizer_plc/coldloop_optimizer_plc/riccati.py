"""The Riccati equation of the Kalman filter: its stationary covariance and gain after each updating period.

Solved by the recursion itself, in kernels of ours: gains decide traces, and LAPACK's last bits are not the same on
every machine. Tests compare both.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.qp.linear_algebra import cholesky, cholesky_solve, multiply

Array = NDArray[np.float64]

ASYMMETRY: Final = 1e-11
"""Difference of mirrored elements of P, over the standard deviations of both states, that is left. Rounding causes
1e-13 where no mode grows; gains are computed to 1e-10."""
RESIDUAL: Final = 1e-3
"""Change of the covariance of states and innovation by a step of the recursion, over the standard deviations of both,
that a stationary one may have. One that still settles after thousands of steps has 1e-6, one that diverges 1."""

GROWTH: Final = 1e-6
"""Of an error in a period, that is rounding: of eigenvalues that are 1, and one another's."""
ATTEMPTS: Final = 50
"""Runs of the recursion, each from where the last one ended: a mode that grows slowly and is hardly seen needs more."""


def gains_after(
    steps: Mapping[int, tuple[Array, Array]], C: Array, drift: Array, sensors: Array, of_time: bool, periods: int,  # noqa: FBT001
    tick_s: float, sampling_period_s: float,
) -> Array:  # fmt: skip
    """Return the stationary gains, transposed, beside the inverse covariances, shape (steps, n_y, n + 1 + n_y).

    A recursion begins at the covariance of the period before, which has been checked.

    Args:
        steps: A (n, n) and F (n,) over so many ticks.
        C: Outputs by states and load mismatch, shape (n_y, n + 1).
        drift: Standard deviations of the process noise in a sampling period, shape (n + 1,).
        sensors: Standard deviations of the measurements, shape (n_y,).
        of_time: The latter are those of a mean over a sampling period.
        periods: Steps of the Riccati recursion at most.
        tick_s: Length of a tick, s.
        sampling_period_s: That of the model, s.

    Raises:
        ConfigurationError: The recursion does not converge.
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
        if is_stationary(A, C, process, sensors, P) and errors_decay(A, C, gain):
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


def errors_decay(A: Array, C: Array, gain: Array) -> bool:
    """Return whether no error of the estimate grows with this gain (n, n_y); one that no sensor shows may stay."""
    return bool(np.abs(np.linalg.eigvals(A - gain @ (C @ A))).max() <= 1.0 + GROWTH)


def inverse_covariance(A: Array, C: Array, process: Array, sensors: Array, P: Array) -> Array:
    """Return the inverse (n_y, n_y) of the innovation's covariance; P (n, n) is that of the state before the period.

    `process` (n) and `sensors` (n_y) are variances.
    """
    before = multiply(multiply(A, P), np.ascontiguousarray(A.T)) + np.diag(process)
    S = multiply(multiply(C, before), np.ascontiguousarray(C.T)) + np.diag(sensors)
    inverse, skyline = np.eye(len(C)), cholesky(S)
    for column in inverse:
        cholesky_solve(S, skyline, column)
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

    `process` (n) and `sensors` (n_y) are variances. Sensors are independent, so measurements are taken one after the
    other and no matrix is inverted.
    """
    n, m = A.shape[0], C.shape[0]
    columns = np.zeros((m, n))
    previous = np.zeros((m, n))
    At = np.ascontiguousarray(A.T)
    for _ in range(periods):
        P[:] = multiply(multiply(A, P), At)
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

    No measurement takes off what is antisymmetric, so a mode that grows multiplies it in each step, and the gain would
    soon be that of no covariance.
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
