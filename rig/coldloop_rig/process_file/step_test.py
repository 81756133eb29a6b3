"""A step test as a historian exports it: a CSV file of inputs, load and outputs over time, made into a model.

The model has the order that predicts data held back best. The state sequence is found by predictor-based subspace
identification (Chiuso, Automatica 43 (2007), pp. 1034-1048): a high-order autoregression gives the predictor's
responses, and the largest singular values of what the past says of the future are the states. Transition and output
matrices follow by least squares from that sequence; then initial state, constants and input matrix by those of the
simulated outputs, so that gains are those of the record as a whole.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.process import declaration, lti_model, sections
from coldloop.table import TIME, Table, read_table
from coldloop_plant.own_plants import LINEAR
from coldloop_rig.process_file.linear_model import Array, Identified, Linearised, Record, operating_point

Places = NDArray[np.intp]

MOST_STATES: Final = 8
HELD_BACK: Final = 1 / 3  # share of the record, its end, that orders are compared on
WORTH: Final = 1.1  # error of a lower order over that of the best one, up to which the lower one is taken
LONGEST_PAST: Final = 20  # samples of the past that a prediction goes by, at most
ROWS_PER_UNKNOWN: Final = 3  # least number of rows per unknown of the autoregression
FASTEST: Final = 1e-3
"""Least pole in the plane of z: one below, or on the negative real axis, has no continuous counterpart."""
TOGETHER: Final = 0.98  # correlation of two inputs from which on their effects cannot be identified separately
EXACT: Final = 1e-6  # error that no order improves on: the record has no noise
NOTHING: Final = 1e-13
"""Part of the largest singular value below which there is no state."""


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

    Raises UsageError: it is too short, or its inputs do not move enough, or together.
    """
    y_mean, y_scale = record.outputs.mean(axis=0), record.outputs.std(axis=0)
    u_scale = record.inputs.std(axis=0)
    for name, deviation, mean in zip(record.input_names, u_scale, record.inputs.mean(axis=0), strict=True):
        if deviation <= 1e-9 * max(1.0, abs(mean)):
            raise UsageError(f"{record.where}: {name} never moves; step it too, or what it does cannot be told")
    related = np.atleast_2d(np.corrcoef(record.inputs.T)) - np.eye(len(u_scale))
    if np.abs(related).max() > TOGETHER:
        one, other = (record.input_names[k] for k in np.unravel_index(np.abs(related).argmax(), related.shape))
        raise UsageError(f"{record.where}: {one} and {other} move together; step one after the other")
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


def simulated(A: Array, B: Array, C: Array, D: Array, record: Record) -> Array:
    """Return what a model in continuous time makes of the inputs of a record, shape (N, p).

    Initial states and constants are those that leave least of the outputs.
    """
    n, m = B.shape
    u, scale = record.inputs - record.operating, np.maximum(record.outputs.std(axis=0), 1e-12)
    at = lti_model.discretise(A, B, np.zeros(n), record.period_s)
    responses, q = _responses(at.A, C, u, [np.arange(len(u))[piece] for piece in record.pieces]), n * len(record.pieces)
    left = record.outputs - responses[:, :, q : q + n * m] @ at.B.ravel() - u @ D.T
    free = np.delete(responses, np.s_[q : q + n * m], axis=2) / scale[:, np.newaxis]
    unknowns = np.linalg.lstsq(free.reshape(-1, free.shape[2]), (left / scale).ravel())[0]
    return np.asarray(record.outputs - left + scale * (free @ unknowns))


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
    """State sequence that predicts future outputs from past data: as many states as there may be, the largest first."""

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


def _fitted(states: _States, u: Array, y: Array, pieces: list[Places], used: list[Places], order: int) -> _Fit:
    """Return the model of an order that the rows used of each piece give, and its errors on the others."""
    x, one = states.rows[:, :order], np.ones((len(states.rows), 1))
    seen = np.hstack([x, one])
    shown = np.asarray(np.linalg.lstsq(seen, states.y)[0].T, float)
    known = np.hstack([x, states.u, states.y - seen @ shown.T, one])[:-1][states.followed]  # with the innovations
    A, C = _admissible(np.linalg.lstsq(known, x[1:][states.followed])[0][:order].T), shown[:, :order]
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
    return np.asarray(np.real(modes @ np.diag(moved) @ np.linalg.inv(modes)))


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
        warnings.simplefilter("ignore", RuntimeWarning)  # for errors of 1e-13: no record is that accurate
        rates = np.real(logm(whole)) / period_s
    return rates[:n, :n], rates[:n, n:]


LEVEL: Final = 0.99
"""Probability with which all gains are in their intervals."""
DRAWS: Final = 30
WIDER: Final = 1.5
"""Factor for slow noise, which a fitted model follows and its draws lack: found over records of a known plant."""


def gains_after(found: Identified, horizon_s: float) -> Array:
    """Return what 1 of each input, held, does to the outputs after a horizon: shape (p, m)."""
    return np.asarray(found.C @ lti_model.discretise(found.A, found.B, np.zeros(len(found.A)), horizon_s).B)


def half_widths(record: Record, found: Identified, horizon_s: float) -> Array:
    """Return half the widths of the intervals of the gains, shape (p, m), jointly by Bonferroni's inequality.

    In each draw what a model of the next order leaves of the record is shifted in time and has a random sign, which
    keeps how errors follow one another and each other output's. The gains of a model of the order found, identified
    anew, are off those of the former by noise, and by what the lower order cannot show.
    """
    from scipy.special import stdtrit  # noqa: PLC0415 records alone need it

    order, count = len(found.A), len(record.outputs)
    more = identified(record, order + 1)
    y = simulated(more.A, more.B, more.C, np.zeros((len(more.C), more.B.shape[1])), record)
    left = (record.outputs - y) * np.sqrt(count / max(count - more.A.size - more.B.size, 1))
    random, best, errors = np.random.default_rng(1), gains_after(more, horizon_s), []
    for _ in range(DRAWS):
        noise = np.roll(left, random.integers(1, count), axis=0) * random.choice([-1.0, 1.0])
        errors.append(gains_after(identified(record._replace(outputs=y + noise), order), horizon_s) - best)
    quantile = WIDER * stdtrit(DRAWS - 1, 1.0 - (1.0 - LEVEL) / (2 * best.size))
    return np.asarray(quantile * np.sqrt((np.array(errors) ** 2).mean(axis=0)))


PIECE: Final = "piece"
"""Column whose number changes where a record has a gap."""
POOR: Final = 0.5  # share of an output's variation, explained of the data held back, below which a model is no good
UNLIKE: Final = 0.3
"""Rms error of a plant on a record of it, over the deviation of the output, from which on it is told."""
FAR: Final = 3.0  # least of that error over that of the model found in the record
EVEN: Final = 0.01  # largest deviation of an interval from the others, over their length


def from_step_test(file: declaration.Process, path: Path) -> Linearised:
    """Return the model that a step test shows. Raises UsageError: one line that names file, line and remedy."""
    record, moved, table = _recorded(file, path)
    found = identified(record)
    used = {table.place(name) for name in (TIME, PIECE, *record.input_names, *file.output_names)}
    left = ", ".join(name for place, name in enumerate(table.names) if name and place not in used)
    notes = [f"record     {path.name}: {note}" for note in (*table.notes, *([f"not used: {left}"] if left else []))]
    unmoved = [one.name for one in file.outside if one not in moved]
    notes += [f"unknown    {path.name} has no column {one}: the model does not know what it does" for one in unmoved]
    missing = [one.name for one in file.outputs if one.at is None]
    if not found.rests and missing:
        raise UsageError(
            f"outputs: {missing[0]} needs at, its value at the operating point: by its record the plant does not rest"
        )
    rest = zip(file.outputs, found.constant, strict=True)
    y0 = np.array([constant if one.at is None else one.at for one, constant in rest])
    model = model_identified(file, found, y0, moved)
    return model._replace(notes=(*model.notes, *notes), record=(record, found))


def record_compared(file: declaration.Process, path: Path, plant: Linearised, model: Linearised) -> list[str]:
    """Return which outputs of a record the plant that it is for explains by far worse than the model found in it."""
    record, moved, _ = _recorded(file, path)
    places, deviations, unexplained = _places(file, moved), record.outputs.std(axis=0), []
    for one in (plant, model):
        B, D = np.hstack([one.B, one.F[:, places]]), np.hstack([one.D, one.G[:, places]])
        left = record.outputs - simulated(one.A, B, one.C, D, record)
        unexplained.append(np.sqrt((left**2).mean(axis=0)) / np.maximum(deviations, 1e-12))
    return [
        f"warning    {path.name}: of {one.name} the plant itself explains {100 * max(0.0, 1.0 - its):.0f} %, the model "
        f"found in it {100 * max(0.0, 1.0 - found):.0f} %; are its columns those of this plant?"
        for one, its, found in zip(file.outputs, *unexplained, strict=True)
        if its > max(UNLIKE, FAR * found)
    ]


def _recorded(
    file: declaration.Process, path: Path
) -> tuple[Record, list[sections.Load | sections.Disturbance], Table]:
    """Return a record in samples of the model, what moved in it beside the inputs, and the table that holds it."""
    named = (*file.inputs, *file.outside, *file.outputs)
    table = read_table(path, [TIME, *(one.name for one in named)], "name a CSV file beside the process file")
    moved = [one for one in file.outside if table.place(one.name) is not None]
    names = [one.name for one in (*file.inputs, *moved)]
    rows = np.array(table.columns([TIME, *names, *(one.name for one in file.outputs)])).T
    number = np.zeros(len(rows)) if table.place(PIECE) is None else np.array(table.columns([PIECE])[0])
    pieces = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(number)) + 1)
    period_s = _period(table, rows[:, 0], pieces)
    for signal, column in zip(file.outputs, rows[:, 1 + len(names) :].T, strict=True):
        low, high = signal.range
        wrong = column[(column < low) | (column > high)]
        if wrong.size:
            raise UsageError(
                f"{table.where}: {signal.name} = {wrong[0]:g} is outside the range of its sensor, {low:g} to {high:g}; "
                "give the record in the unit of the process file, without failed readings"
            )
        if np.ptp(column) == 0.0:
            raise UsageError(f"{table.where}: {signal.name} never moves; what acts on it cannot be told")
    every = max(1, round(file.tick_s * file.ticks_per_sample / period_s))
    counts = [len(piece) // every for piece in pieces if len(piece) >= every]
    used = np.concatenate([piece[: len(piece) // every * every] for piece in pieces])
    inputs, outputs = rows[used, 1 : 1 + len(names)], rows[used, 1 + len(names) :]
    held = inputs.reshape(len(used) // every, every, -1).mean(axis=1)
    at, ends = np.array([one.at for one in (*file.inputs, *moved)]), np.cumsum(counts)
    cut = tuple(slice(end - count, end) for count, end in zip(counts, ends, strict=True))
    return Record(period_s * every, held, outputs[::every], at, tuple(names), table.where, cut), moved, table


def _places(file: declaration.Process, moved: Sequence[sections.Load | sections.Disturbance]) -> list[int]:
    """Return the columns that load and disturbances have in F and G."""
    return [1 + file.disturbances.index(one) if isinstance(one, sections.Disturbance) else 0 for one in moved]


def model_identified(
    file: declaration.Process, found: Identified, y0: Array, moved: Sequence[sections.Load | sections.Disturbance]
) -> Linearised:
    """Return what was identified, of inputs and of what moved beside them, as a process that rests at `y0`."""
    u, w = operating_point(file)
    n, m, p = len(found.A), len(u), len(y0)
    F = np.zeros((n, len(w)))
    F[:, _places(file, moved)] = found.B[:, m:]
    poor = ", ".join(one.name for one, share in zip(file.outputs, found.fit, strict=True) if share < POOR)
    warning = (f"warning    fit: the record does not explain {poor}; something else moves it",) if poor else ()
    fit = "  ".join(f"{one.name} {100 * share:.1f} %" for one, share in zip(file.outputs, found.fit, strict=True))
    return Linearised(
        found.A, found.B[:, :m], F, found.C, np.zeros((p, m)), np.zeros((p, len(w))), np.zeros(n), u, w, y0,
        {f"x{i}": "" for i in range(1, n + 1)}, LINEAR, {}, "", 0.0,
        (f"identified with {n} states; of the last third, held back, it explains  {fit}", *warning),
    )  # fmt: skip


def _period(table: Table, times: Array, pieces: Sequence[Places]) -> float:
    if len(times) < 2:
        raise UsageError(f"{table.where}: one line of numbers is no record")
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    if usual <= 0.0:
        raise UsageError(f"{table.where}: {TIME} does not rise from line to line")
    uneven = np.abs(intervals - usual) > EVEN * usual
    uneven[[piece[0] - 1 for piece in pieces[1:]]] = False
    if uneven.any():
        odd = int(uneven.argmax())
        raise UsageError(
            f"{table.where}, line {table.rows[odd + 1][0]}: {intervals[odd]:g} s after the line before, others are "
            f"{usual:g} s apart; `coldloop import` makes times even and cuts at gaps"
        )
    return usual
