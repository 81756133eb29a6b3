"""A linear model from a record of inputs and outputs: by subspaces, of the order that predicts data held back best.

The state sequence is found by predictor-based subspace identification (Chiuso, Automatica 43 (2007), pp. 1034-1048): a
high-order autoregression gives the predictor's responses, and the largest singular values of what the past says of the
future are the states. Transition and output matrices follow by least squares from that sequence; then initial state,
constants and input matrix by those of the simulated outputs, so that gains are those of the record as a whole.
"""

import warnings
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.process.lti_model import discretise

Array = NDArray[np.float64]
Places = NDArray[np.intp]

MOST_STATES: Final = 8
HELD_BACK: Final = 1 / 3
"""Share of the record, its end, that orders are compared on."""
WORTH: Final = 1.1
"""Error of a lower order over that of the best one, up to which the lower one is taken."""
LONGEST_PAST: Final = 20
"""Samples of the past that a prediction goes by, at most."""
ROWS_PER_UNKNOWN: Final = 3
"""Of the autoregression, at least."""
FASTEST: Final = 1e-3
"""Least pole in the plane of z: one below, or on the negative real axis, has no continuous counterpart."""
TOGETHER: Final = 0.98
"""Correlation of two inputs from which on their effects cannot be told apart."""
EXACT: Final = 1e-6
"""Error that no order improves on: the record has no noise."""
NOTHING: Final = 1e-13
"""Part of the largest singular value below which there is no state."""


class Record(NamedTuple):
    """What was recorded at N equidistant times: each row's inputs hold until the next one."""

    period_s: float
    inputs: Array
    """Shape (N, m)."""
    outputs: Array
    """Shape (N, p)."""
    operating: Array
    """Inputs at the operating point, shape (m,); what integrates does not move there."""
    input_names: tuple[str, ...]
    where: str
    """Names it in messages."""
    pieces: tuple[slice, ...] = (slice(None),)
    """Rows without a gap between them, in order."""


class Identified(NamedTuple):
    """dx/dt = A x + B u, y = C x + constant, with u in deviations from the operating point."""

    A: Array
    """Shape (n, n), per second."""
    B: Array
    """Shape (n, m)."""
    C: Array
    """Shape (p, n)."""
    constant: Array
    """Outputs at rest at the operating point, if the plant rests: shape (p,)."""
    rests: bool
    """Whether all modes decay, within the length of the record."""
    fit: Array
    """Share of each output's variation on the data held back that is explained, 1 is all: 1 - rms error / deviation."""


class _Fit(NamedTuple):
    """A model of one order in discrete time, of scaled signals."""

    A: Array
    B: Array
    C: Array
    constant: Array
    error: Array
    """Rms error of each output on the data held back, over its deviation there."""


def identified(record: Record, order: int = 0) -> Identified:
    """Return the model that predicts a record best, or that of an order.

    Raises:
        UsageError: It is too short, or its inputs do not move enough, or together.
    """
    y_mean, y_scale = record.outputs.mean(axis=0), record.outputs.std(axis=0)
    u_scale = record.inputs.std(axis=0)
    _check_moves(record, u_scale)
    y_scale = np.maximum(y_scale, 1e-12 * np.maximum(1.0, np.abs(y_mean)))
    u, y = (record.inputs - record.operating) / u_scale, (record.outputs - y_mean) / y_scale
    pieces = [np.arange(len(u))[piece] for piece in record.pieces]
    used = [piece[: len(piece) - round(len(piece) * HELD_BACK)] for piece in pieces]
    past = _past(record, sum(map(len, used)))
    error = np.zeros(len(y_scale))
    if not order:
        seen = _states(u, y, used, past)
        candidates = [_fitted(seen, u, y, pieces, used, order) for order in range(1, seen.rows.shape[1] + 1)]
        errors = [float(np.sqrt((each.error**2).mean())) for each in candidates]
        order = next(k for k, error in enumerate(errors, 1) if error <= max(WORTH * min(errors), EXACT))
        error = candidates[order - 1].error
    states = _states(u, y, pieces, past)
    whole = _fitted(states, u, y, pieces, pieces, min(order, states.rows.shape[1]))
    A, B = _continuous(whole.A, whole.B, record.period_s)
    rests = bool(np.linalg.eigvals(A).real.max() * record.period_s * len(u) < -1.0)
    return Identified(
        A, B / u_scale, whole.C * y_scale[:, np.newaxis], whole.constant * y_scale + y_mean, rests,
        1.0 - error,
    )  # fmt: skip


def unexplained(A: Array, B: Array, C: Array, D: Array, record: Record) -> Array:
    """Return what a model in continuous time leaves of a record: rms error of each output over its deviation."""
    left = record.outputs - simulated(A, B, C, D, record)
    error: Array = np.sqrt((left**2).mean(axis=0)) / np.maximum(record.outputs.std(axis=0), 1e-12)
    return error


def simulated(A: Array, B: Array, C: Array, D: Array, record: Record) -> Array:
    """Return what a model in continuous time makes of the inputs of a record, shape (N, p).

    Initial states and constants are those that leave least of the outputs.
    """
    n, m = B.shape
    u, scale = record.inputs - record.operating, np.maximum(record.outputs.std(axis=0), 1e-12)
    at = discretise(A, B, np.zeros(n), record.period_s)
    responses, q = _responses(at.A, C, u, [np.arange(len(u))[piece] for piece in record.pieces]), n * len(record.pieces)
    left = record.outputs - responses[:, :, q : q + n * m] @ at.B.ravel() - u @ D.T
    free = np.delete(responses, np.s_[q : q + n * m], axis=2) / scale[:, np.newaxis]
    unknowns = np.linalg.lstsq(free.reshape(-1, free.shape[2]), (left / scale).ravel())[0]
    made: Array = record.outputs - left + scale * (free @ unknowns)
    return made


def _check_moves(record: Record, deviations: Array) -> None:
    for name, deviation, mean in zip(record.input_names, deviations, record.inputs.mean(axis=0), strict=True):
        if deviation <= 1e-9 * max(1.0, abs(mean)):
            raise UsageError(f"{record.where}: {name} never moves; step it too, or what it does cannot be told")
    related = np.atleast_2d(np.corrcoef(record.inputs.T)) - np.eye(len(deviations))
    if np.abs(related).max() > TOGETHER:
        one, other = (record.input_names[k] for k in np.unravel_index(np.abs(related).argmax(), related.shape))
        raise UsageError(f"{record.where}: {one} and {other} move together; step one after the other")


def _past(record: Record, rows: int) -> int:
    """Return how many samples of the past a prediction goes by."""
    width, p = record.inputs.shape[1] + record.outputs.shape[1], record.outputs.shape[1]
    per_sample = (ROWS_PER_UNKNOWN + 1) * width
    least = max(2, -(-4 // p))
    if rows < least * per_sample:
        raise UsageError(
            f"{record.where}: {len(record.inputs)} samples of {record.period_s:g} s are too short a record for "
            f"{width} signals; record {round(least * per_sample / (1 - HELD_BACK)) + 1} or more"
        )
    return min(LONGEST_PAST, int(rows // per_sample))


class _States(NamedTuple):
    """What the past tells of the future: as many states as there may be, the largest first."""

    rows: Array
    """Scaled to a standard deviation of 1, shape (N - past, n)."""
    u: Array
    """Inputs at the same times."""
    y: Array
    followed: NDArray[np.bool_]
    """Whether the next row is a sample later: shape (N - past - 1,)."""


def _states(u: Array, y: Array, pieces: list[Places], past: int) -> _States:
    """Return the state sequence of the predictor that the record gives."""
    z, p = np.hstack([u, y]), y.shape[1]
    width = z.shape[1]
    at = np.concatenate([piece[past:] for piece in pieces])
    behind = np.hstack([z[at - past + k] for k in range(past)])  # oldest first
    one = np.ones((len(behind), 1))
    predictor = np.linalg.lstsq(np.hstack([behind, one]), y[at])[0][:-1].T  # shape (p, past width)
    ahead = np.zeros((past, p, past * width))
    for k in range(past):  # k samples later the oldest k are no longer in the window
        ahead[k, :, k * width :] = predictor[:, : (past - k) * width]
    left, sizes, _ = np.linalg.svd(ahead.reshape(past * p, -1) @ behind.T @ behind @ ahead.reshape(past * p, -1).T)
    most = min(MOST_STATES, int((sizes > NOTHING * sizes[0]).sum()))
    rows = behind @ ahead.reshape(past * p, -1).T @ left[:, :most]
    return _States(rows / rows.std(axis=0), u[at], y[at], np.diff(at) == 1)


def _matrices(states: _States, order: int) -> tuple[Array, Array]:
    """Return A (n, n) and C (p, n) of the first states."""
    x, one = states.rows[:, :order], np.ones((len(states.rows), 1))
    seen = np.hstack([x, one])
    C = np.asarray(np.linalg.lstsq(seen, states.y)[0].T, float)
    innovations = states.y - seen @ C.T
    known = np.hstack([x, states.u, innovations, one])[:-1][states.followed]
    A = np.linalg.lstsq(known, x[1:][states.followed])[0][:order].T
    return _admissible(A), C[:, :order]


def _fitted(states: _States, u: Array, y: Array, pieces: list[Places], used: list[Places], order: int) -> _Fit:
    """Return the model of an order that the rows used of each piece give, and its errors on the others."""
    A, C = _matrices(states, order)
    responses, of = _responses(A, C, u, pieces), np.concatenate(used)
    unknowns = np.asarray(np.linalg.lstsq(responses[of].reshape(-1, responses.shape[2]), y[of].ravel())[0], float)
    left, held = np.delete(y - responses @ unknowns, of, axis=0), np.delete(y, of, axis=0)
    error = np.sqrt((left**2).mean(axis=0)) / np.maximum(held.std(axis=0), 1e-9) if len(held) else np.zeros(y.shape[1])
    n, m, q = order, u.shape[1], order * len(pieces)
    return _Fit(A, unknowns[q : q + n * m].reshape(n, m), C, unknowns[q + n * m :], error)


def _admissible(A: Array) -> Array:
    """Return A with its poles where those of a stable plant, sampled, can be."""
    poles, modes = np.linalg.eig(A)
    real = np.abs(poles.imag) < 1e-12
    moved = np.where(real, np.maximum(poles.real, FASTEST), poles)
    moved = moved / np.maximum(np.abs(moved), 1.0)
    if np.array_equal(moved, poles):
        return A
    found: Array = np.real(modes @ np.diag(moved) @ np.linalg.inv(modes))
    return found


def _responses(A: Array, C: Array, u: Array, pieces: list[Places]) -> Array:
    """Return what the pieces' initial states, entries of B and constants do to the outputs: (N, p, q + n m + p)."""
    n, m, p = len(A), u.shape[1], len(C)
    q, each = n * len(pieces), np.arange(n)
    found = np.zeros((len(u), p, q + n * m + p))
    found[:, :, q + n * m :] = np.eye(p)
    for i, piece in enumerate(pieces):
        free, forced = np.eye(n), np.zeros((n, n, m))
        for k in piece:
            found[k, :, i * n : (i + 1) * n], found[k, :, q : q + n * m] = C @ free, C @ forced.reshape(n, n * m)
            free, forced = A @ free, (A @ forced.reshape(n, n * m)).reshape(n, n, m)
            forced[each, each] += u[k]
    return found


def _continuous(A: Array, B: Array, period_s: float) -> tuple[Array, Array]:
    """Return the matrices of dx/dt that, with inputs held, give these over a period."""
    from scipy.linalg import logm  # noqa: PLC0415

    n, m = B.shape
    whole = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of errors of 1e-13: a record is not known as well as that
        rates = np.real(logm(whole)) / period_s
    return rates[:n, :n], rates[:n, n:]
