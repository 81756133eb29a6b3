"""The discrete prediction model, at the sampling period and at every updating period, where it rests, and the target.

One matrix triple for a tick comes with the model file; those of longer periods are its powers, so no matrix
exponential is needed on line.

The target is where the plant, as it is estimated to be, should rest: of the inputs at which it rests with the level of
its bath at the operating point those that cost least, as deviations from the operating point. They are within their
bounds; within these they hold the load, or as much of it as they can; then they have the turbine's outlet (T5 of the
cold box) within its rows, or as near as they can. Inputs are deviations over `input_scale`, and those that act: with
the estimated constants of inputs added. Without a bath the target is the operating point, and what a process holds is
not known.
"""

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.kernels.compiled import kernel
from coldloop.process import lti_model, sections
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Array, Real, multiply, rounded
from coldloop_optimizer_plc.settings import ControlDesign, Target


class Transition(NamedTuple):
    """x(t + period) = A x(t) + B u + F w, for constant u and w; deviations from the operating point."""

    A: Array
    B: Array
    F: Array

    def then(self, later: "Transition") -> "Transition":
        """Return the transition over this period followed by `later`, under the same inputs."""
        return Transition(
            multiply(later.A, self.A), multiply(later.A, self.B) + later.B, multiply(later.A, self.F) + later.F
        )

    def transposed(self) -> "Transition":
        """Return A', B' and F', which is how `respond` takes them."""
        return Transition(*(np.ascontiguousarray(M.T) for M in self))


class Ahead(NamedTuple):
    """A state that stands for how much a disturbance will differ, in some samples of the horizon, from what it is.

    It has a place among the states; samples first to last are counted from 1. states (n,) and outputs (n_y,) are
    changed by one unit of it in a sample.
    """

    place: int
    first: int
    last: int
    states: Array
    outputs: Array


class PredictionModel:
    """LTI model of the plant around its operating point.

    `transitions[k]` spans k ticks, k = 1..ticks of a sampling period. Outputs are y = C x + D u + G w, of which
    `constrained` are those that have a band.
    """

    def __init__(self, model: lti_model.LtiModel) -> None:
        self.model = model
        self.process = model.declared
        self.constrained = self.process.controlled
        tick = Transition(*(np.array(M, order="C") for M in (model.A_tick, model.B_tick, model.F_tick[:, None])))
        self.C, self.D, self.G = np.array(model.C), np.array(model.D), np.array(model.G[:, None])
        self.x0, self.u0, self.y0 = model.x0, model.u0, model.y0
        self.w0 = DOUBLE(model.w0)
        self.disturbances: tuple[int, ...] = ()
        """Signals whose constants are states."""
        self.ahead: tuple[Ahead, ...] = ()
        """States at the end that are what is forecast; no transition reads them, as they act later."""
        self.resting_inputs = np.zeros((self.D.shape[1], len(self.x0)))
        """Inputs at which the plant rests at the operating point, by the states, shape (3, n)."""
        self.transitions = {1: tick}
        for ticks in range(2, self.process.ticks_per_sample + 1):
            self.transitions[ticks] = self.transitions[ticks - 1].then(tick)

    def with_disturbances(self, signals: Sequence[int]) -> "PredictionModel":
        """Return this model with a constant disturbance of each of these signals, outputs and then inputs, as a state.

        With as many as outputs, predictions have no offset at rest (Pannocchia and Rawlings 2003). Costs and rows
        follow from the states.
        """
        if not signals:
            return self
        n, n_outputs, twin = self.n_states, len(self.y0), self._with_states(len(signals))
        twin.disturbances = tuple(signals)
        twin.C[:, n:] = np.hstack([np.eye(n_outputs), self.D])[:, list(signals)]
        for state, signal in enumerate(signals, n):
            if signal >= n_outputs:
                twin.resting_inputs[signal - n_outputs, state] = -1.0
                for step in twin.transitions.values():
                    step.A[:n, state] = step.B[:n, signal - n_outputs]
        return twin

    def _with_states(self, extra: int) -> "PredictionModel":
        """Return a copy with so many further states, which nothing moves and no output shows."""
        n, twin = self.n_states, copy(self)
        twin.x0 = np.concatenate([self.x0, np.zeros(extra)])
        twin.C, twin.resting_inputs = (np.hstack([M, np.zeros((len(M), extra))]) for M in (self.C, self.resting_inputs))
        twin.transitions = {}
        for ticks, step in self.transitions.items():
            A = np.eye(n + extra)
            A[:n, :n] = step.A
            B, F = (np.vstack([M, np.zeros((extra, M.shape[1]))]) for M in (step.B, step.F))
            twin.transitions[ticks] = Transition(A, B, F)
        return twin

    def with_forecasts(self, sources: Sequence[int], ends: Sequence[int]) -> "PredictionModel":
        """Return this model with the changes that are forecast of disturbances as further states.

        `sources` are states, -1 is the load; each has a state for each part of the horizon, with last samples `ends`.
        """
        if not sources:
            return self
        n, extra = self.n_states, len(sources) * len(ends)
        A, _, F = self.sample
        twin, starts, found = self._with_states(extra), (1, *(end + 1 for end in ends[:-1])), list[Ahead]()
        for source in sources:
            column, seen = np.zeros(n + extra), self.G[:, 0] if source < 0 else self.C[:, source]
            column[:n] = F[:, 0] if source < 0 else A[:, source] - np.eye(n)[source]
            found += [Ahead(n + len(found) + k, starts[k], end, column, seen) for k, end in enumerate(ends)]
        twin.ahead = tuple(found)
        return twin

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.x0)

    @property
    def n_estimated(self) -> int:
        """Number of those that are estimated: all but what is forecast."""
        return len(self.x0) - len(self.ahead)

    @property
    def sample(self) -> Transition:
        """The transition over one sampling period of 5 s."""
        return self.transitions[self.process.ticks_per_sample]

    @property
    def outputs(self) -> Transition:
        """C, D and G, which give outputs as a transition gives states."""
        return Transition(self.C, self.D, self.G)


def prediction_of(model: lti_model.LtiModel, disturbed: Sequence[int], design: ControlDesign) -> PredictionModel:
    """Return the model that an optimiser predicts by: with constants of the signals `disturbed`, and what is forecast.

    Changes are forecast as means over the time from one decision instant to the next.
    """
    prediction = PredictionModel(model)
    process = prediction.process
    sources = [
        -1 if one.name == process.load.name else process.state_names.index(one.name) for one in process.forecasts
    ]
    return prediction.with_disturbances(disturbed).with_forecasts(sources, design.decision_instants)


def state_cost(model: lti_model.LtiModel, design: ControlDesign) -> Array:
    """Return Q, shape (n, n): what the states, and the outputs through them, weigh."""
    weights = np.array([output.weight for output in model.declared.outputs])
    through_outputs: Array = model.C.T @ (weights[:, None] * model.C)
    return through_outputs + np.diag(state_weights(model, design))


def state_weights(model: lti_model.LtiModel, design: ControlDesign) -> Array:
    """Return what states weigh themselves, shape (n,): those of a bath with a cold end.

    Pressure, level and the mean of the temperatures weigh alike; further states and those of other processes nothing.
    """
    weights, process = np.zeros(len(model.x0)), model.declared
    bath = process.bath
    if bath is None:
        return weights
    if bath.pressure_state:
        weights[process.state_names.index(bath.pressure_state)] = design.state_weight / design.pressure_scale**2
    if bath.level_state:
        place = process.state_names.index(bath.level_state)
        scale = design.level_scale / model.C[process.output_names.index(bath.level), place]
        weights[place] = design.state_weight / scale**2
    for name in bath.temperature_states:
        share = 1.0 / len(bath.temperature_states)
        weights[process.state_names.index(name)] = design.state_weight * share / design.temperature_scale**2
    return weights


def rest_map(prediction: PredictionModel, real: Real = DOUBLE) -> Array:
    """Return what states and load mismatch are at rest, as a map (n + 1, inputs + 2): all deviations.

    It is one of the inputs, of the load, and of the level where there is a bath. There it integrates: any rests, and
    with the inputs and the load that are given only one mismatch lets it. Elsewhere there is no mismatch at rest, and
    where the states do not rest they are those that move least. What inputs and load do not move, as disturbances
    beside the load, is 0 at rest. Raises ConfigurationError if, with another model, none does.
    """
    n = len(prediction.model.x0)
    A, B, F = (M[:n] for M in prediction.sample)
    moved = prediction.model.moved
    A, B, F = A[np.ix_(moved, moved)], B[moved], F[moved]
    zeros = np.zeros((len(moved), 1))
    found = np.zeros((n + 1, B.shape[1] + 2))
    process = prediction.process
    if process.bath is None:
        found[moved] = np.linalg.pinv(np.eye(len(moved)) - A) @ np.hstack([B, F, zeros])
        return rounded(found, real)
    level = [process.output_names.index(process.bath.level)]
    C, D, G = (M[level] for M in (prediction.C, prediction.D, prediction.G))
    left = np.block([[np.eye(len(moved)) - A, -F], [C[:, moved], G]])
    right = np.block([[B, F, zeros], [-D, -G, np.ones((1, 1))]])
    try:
        found[[*moved, n]] = np.linalg.solve(left, right)
    except np.linalg.LinAlgError as error:
        raise ConfigurationError(
            "model.file: with constant inputs no load lets the model's states and the level rest; name another model"
        ) from error
    return rounded(found, real)


TOLERANCES = {8: 1e-8, 4: 1e-4}
"""Tolerances for the violation of a bound, scaled, by the bytes of a number: in single precision a corner of bounds is
met no better than within 1e-5."""
NO_EFFECT = 1e-9
"""K of the turbine's outlet per W held: an input that warms it by less does so by rounding, whose sign is another on
another machine."""


class Rest(NamedTuple):
    """Values at rest with the level at its operating point, by the scaled inputs, without disturbances.

    states (3, n_x + 1) are those and the load held, temperature (3,) that of the turbine's outlet.
    """

    states: Array
    temperature: Array


class TargetSearch(NamedTuple):
    """Constants of the search for targets, in the on-line floating-point type.

    followed: whether there is a target other than the operating point. limited: whether it is known what can be held.
    of_load: 1 where the load counts, 0 where only its mismatch does. held (3,): load that an input holds, W. cheapest
    (3,): inputs that hold a W at the least cost. plane (3, 2): inputs that hold nothing, orthonormal in what they cost.
    rows (4, 2): the inputs and the turbine's outlet on that plane. temperature (3,): of that outlet, by the inputs.
    low, high (4,): bounds of inputs and outlet. margin: how far inside its band the rows of the outlet are, K.
    constants (4,): indices of the states that are the biases of inputs and outlet, -1 is none. scale (4,): of these
    biases, input_scale and 1. tolerance: for the violation of a bound. feed: index of the input that fills the bath;
    kernels are shared by processes, and have no places of theirs in them.
    """

    followed: bool
    limited: bool
    of_load: float
    held: Array
    cheapest: Array
    plane: Array
    rows: Array
    temperature: Array
    low: Array
    high: Array
    margin: float
    constants: NDArray[np.int64]
    scale: Array
    tolerance: float
    feed: int


def rest_of(prediction: PredictionModel, design: ControlDesign, bath: sections.Bath) -> Rest:
    """Return where the model of a plant with a bath rests."""
    outlet, n_inputs = prediction.process.output_names.index(bath.turbine_outlet), design.n_inputs
    n, scale = len(prediction.model.x0), np.array(design.input_scale)
    by_inputs = rest_map(prediction)[:, :n_inputs] * scale
    states = np.zeros((n_inputs, prediction.n_states + 1))
    states[:, :n], states[:, -1] = by_inputs[:n].T, by_inputs[n]
    C, D, G = (M[outlet] for M in (prediction.C, prediction.D, prediction.G))
    return Rest(states, states[:, :-1] @ C + D * scale + states[:, -1] * G)


def target_search(
    prediction: PredictionModel, design: ControlDesign, limits: InputLimits, real: Real = DOUBLE
) -> TargetSearch:
    """Return what targets of this problem are found with."""
    process = prediction.process
    if process.bath is None:
        inputs, rows, n = np.zeros(design.n_inputs), np.zeros(design.n_inputs + 1), design.n_inputs
        nothing = TargetSearch(
            followed=False, limited=False, of_load=0.0, held=inputs, cheapest=inputs, plane=np.zeros((n, 2)),
            rows=np.zeros((n + 1, 2)), temperature=inputs, low=rows, high=rows, margin=0.0,
            constants=np.full(n + 1, -1), scale=rows, tolerance=0.0, feed=0,
        )  # fmt: skip
        return rounded(nothing, real)
    outlet, feed = process.output_names.index(process.bath.turbine_outlet), process.input_names.index(process.bath.feed)
    rest, n, scale = rest_of(prediction, design, process.bath), len(prediction.model.x0), np.array(design.input_scale)
    held, states = rest.states[:, -1], rest.states[:, :n]
    cost = states @ state_cost(prediction.model, design) @ states.T + np.diag(scale**2 * design.input_weight)
    inverse = np.linalg.inv(cost)
    across = np.linalg.svd(held[None])[2][1:].T
    root = np.linalg.cholesky(across.T @ cost @ across)
    plane = np.linalg.solve(root, across.T).T
    band = process.controlled.index(outlet)
    y0, margin, u0 = float(prediction.y0[outlet]), design.band_margin[band], np.array(prediction.u0)
    places = {signal: n + place for place, signal in enumerate(prediction.disturbances)}
    signals = (*range(len(prediction.y0), len(prediction.y0) + design.n_inputs), outlet)
    found = TargetSearch(
        followed=design.target is not Target.OPERATING_POINT, limited=True,
        of_load=float(design.target is Target.LOAD), held=held, cheapest=inverse @ held / (held @ inverse @ held),
        plane=plane, rows=np.vstack([plane, rest.temperature @ plane]), temperature=rest.temperature,
        low=np.array([*(limits.low - u0) / scale, design.output_low[band] + margin - y0]),
        high=np.array([*(limits.high - u0) / scale, design.output_high[band] - margin - y0]), margin=margin,
        constants=np.array([places.get(signal, -1) for signal in signals]), scale=np.array([*scale, 1.0]),
        tolerance=TOLERANCES[np.dtype(real).itemsize], feed=feed,
    )  # fmt: skip
    return rounded(found, real)


@kernel
def find_target(
    c: TargetSearch, x: Array, w: float, mismatch: float, most_open: float, idle: int, at: float, target: Array
) -> None:  # fmt: skip
    """Write the target (3,) for estimated states (n_x,), load and its mismatch, and a limit of the feed.

    The input that is `idle`, unless it is -1, stays `at` a scaled deviation.
    """
    if not c.followed:
        return
    low, high = bounds_at(c, x, most_open, idle, at)
    least, most = loads_held(c, low, high)
    load = min(max(mismatch + c.of_load * (w - mismatch), least), most)
    bounds, last = np.empty((low.shape[0], 2), x.dtype), target.shape[0]
    for i in range(last):
        target[i] = c.cheapest[i] * load
        bounds[i, 0], bounds[i, 1] = low[i] - target[i], high[i] - target[i]
        low[last] -= c.temperature[i] * target[i]
        high[last] -= c.temperature[i] * target[i]
    bounds[last, 0], bounds[last, 1] = low[last], high[last]
    point = nearest_point(c.rows, bounds, c.tolerance)
    for i in range(last):
        moved = target[i] + c.plane[i, 0] * point[0] + c.plane[i, 1] * point[1]
        target[i] = min(max(moved, low[i]), high[i])


@kernel
def bounds_at(c: TargetSearch, x: Array, most_open: float, idle: int, at: float) -> tuple[Array, Array]:
    """Return bounds (4,), (4,) of inputs that act, with a limit of the feed, and of the outlet less its constant.

    Those of an input that is `idle` (-1: none is) collapse to where it is, within its range.
    """
    low, high = c.low.copy(), c.high.copy()
    high[c.feed] = max(min(high[c.feed], most_open), low[c.feed])
    if idle >= 0:
        held = min(max(at, low[idle]), high[idle])
        low[idle] = held
        high[idle] = held
    one = x.dtype.type(1.0)
    for i in range(low.shape[0]):
        if c.constants[i] >= 0:
            constant = x[c.constants[i]] / c.scale[i]
            sign = one if i < c.held.shape[0] else -one
            low[i] += sign * constant
            high[i] += sign * constant
    return low, high


@kernel
def loads_held(c: TargetSearch, low: Array, high: Array) -> tuple[float, float]:
    """Return the least and the largest load that inputs within these bounds hold at rest, deviations in W."""
    least, most = low.dtype.type(0.0), low.dtype.type(0.0)
    for i in range(c.held.shape[0]):
        one, other = c.held[i] * low[i], c.held[i] * high[i]
        least += min(one, other)
        most += max(one, other)
    return least, most


@kernel
def least_warm_load(c: TargetSearch, low: Array, high: Array) -> float:
    """Return the least load that these bounds let hold with the turbine's outlet within its band, a deviation in W.

    From the inputs that hold least those move that warm the outlet the most for each watt. Where that is not enough it
    is the load with which it is warmest.
    """
    last = c.held.shape[0]
    room, load, lacking = np.empty(last, low.dtype), low.dtype.type(0.0), low[last] - c.margin
    for i in range(last):
        room[i] = high[i] - low[i]
        at = low[i] if c.held[i] > 0 else high[i]
        load += c.held[i] * at
        lacking -= c.temperature[i] * at
    best = 0
    while lacking > 0 and best >= 0:
        best, most = -1, low.dtype.type(NO_EFFECT)
        for i in range(last):
            warms = c.temperature[i] * c.held[i] > 0  # in the direction in which it holds more
            share = abs(c.temperature[i] / c.held[i])
            if warms and room[i] > 0 and share > most:
                best, most = i, share
        if best >= 0:
            moved = min(room[best], lacking / abs(c.temperature[best]))
            load += abs(c.held[best]) * moved
            lacking -= abs(c.temperature[best]) * room[best]
            room[best] = low.dtype.type(0.0)
    return load


@kernel
def nearest_point(rows: Array, bounds: Array, tolerance: float) -> Array:
    """Return the point (2,) nearest to the origin with `rows` (4, 2) times it between `bounds` (4, 2).

    Where there is none, the bounds of the first three rows come before those of the last. Of strips it is the origin,
    its projection on a bound, or where two bounds meet.
    """
    best, missed = np.zeros(2, rows.dtype), np.empty(3, rows.dtype)
    judge_point(rows, bounds, tolerance, best, missed)
    point, found = np.empty(2, rows.dtype), np.empty(3, rows.dtype)
    for i in range(rows.shape[0]):
        square = rows[i, 0] * rows[i, 0] + rows[i, 1] * rows[i, 1]
        for at in range(2):
            share = bounds[i, at] / square
            point[0], point[1] = share * rows[i, 0], share * rows[i, 1]
            take_better(rows, bounds, tolerance, point, found, best, missed)
            for j in range(i):
                cross = rows[i, 0] * rows[j, 1] - rows[i, 1] * rows[j, 0]
                for other in range(2):
                    one, two = bounds[i, at] / cross, bounds[j, other] / cross
                    point[0], point[1] = one * rows[j, 1] - two * rows[i, 1], two * rows[i, 0] - one * rows[j, 0]
                    take_better(rows, bounds, tolerance, point, found, best, missed)
    return best


@kernel
def take_better(
    rows: Array, bounds: Array, tolerance: float, point: Array, found: Array, best: Array, missed: Array
) -> None:
    """Copy a point to `best` if it is better than that; `found` and `missed` (3,) are as `judge_point` judges them."""
    judge_point(rows, bounds, tolerance, point, found)
    for k in range(found.shape[0]):
        if not found[k] <= missed[k]:
            return
        if found[k] < missed[k]:
            best[:], missed[:] = point, found
            return


@kernel
def judge_point(rows: Array, bounds: Array, tolerance: float, point: Array, missed: Array) -> None:
    """Write what a point misses the bounds (4, 2) of the first three rows by, those of the last, and its square."""
    n = rows.shape[0]
    missed[0] = missed[1] = tolerance
    for i in range(n):
        value = rows[i, 0] * point[0] + rows[i, 1] * point[1]
        k = 1 if i == n - 1 else 0
        missed[k] = max(missed[k], bounds[i, 0] - value, value - bounds[i, 1])
    missed[2] = point[0] * point[0] + point[1] * point[1]
