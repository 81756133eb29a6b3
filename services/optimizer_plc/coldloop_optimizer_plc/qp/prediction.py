"""The discrete prediction model, at the sampling period and at every updating period, and where it rests.

One matrix triple for a tick comes with the model file; those of longer periods are its powers, so no matrix
exponential is needed on line.
"""

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.process.lti_model import LtiModel
from coldloop_optimizer_plc.qp.design import ControlDesign
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Real, multiply

Array = NDArray[np.float64]


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
    """A state that stands for how much a disturbance will differ, in some samples of the horizon, from what it is."""

    place: int
    """Among the states."""
    first: int
    """Sample, counted from 1."""
    last: int
    states: Array
    """Change of the states by one unit of it in a sample, shape (n,)."""
    outputs: Array
    """The same of the outputs, shape (n_y,)."""


class PredictionModel:
    """LTI model of the plant around its operating point.

    `transitions[k]` spans k ticks, k = 1..ticks of a sampling period. Outputs are y = C x + D u + G w, of which
    `constrained` are those that have a band.
    """

    def __init__(self, model: LtiModel) -> None:
        self.model = model
        self.process = model.declared
        self.constrained = self.process.controlled
        tick = Transition(*(np.array(M, order="C") for M in (model.A_tick, model.B_tick, model.F_tick[:, None])))
        self.C, self.D, self.G = np.array(model.C), np.array(model.D), np.array(model.G[:, None])
        self.x0, self.u0, self.y0 = model.x0, model.u0, model.y0
        self.w0 = DOUBLE(model.w0)
        self.real = DOUBLE
        self.disturbances: tuple[int, ...] = ()
        """Signals whose constants are states."""
        self.ahead: tuple[Ahead, ...] = ()
        """States at the end that are what is forecast; no transition reads them, as they act later."""
        self.resting_inputs = np.zeros((self.D.shape[1], len(self.x0)))
        """Inputs at which the plant rests at the operating point, by the states, shape (3, n)."""
        self.transitions = {1: tick}
        for ticks in range(2, self.process.ticks_per_sample + 1):
            self.transitions[ticks] = self.transitions[ticks - 1].then(tick)

    def rounded(self, real: Real) -> "PredictionModel":
        """Return this model in another floating-point type, rounded once."""
        twin = copy(self)
        twin.C, twin.D, twin.G, twin.x0, twin.u0, twin.y0 = (
            M.astype(real, copy=False) for M in (self.C, self.D, self.G, self.x0, self.u0, self.y0)
        )
        twin.w0, twin.real = real(self.w0), real
        twin.transitions = {
            ticks: Transition(*(M.astype(real, copy=False) for M in step)) for ticks, step in self.transitions.items()
        }
        return twin

    def with_disturbances(self, signals: Sequence[int]) -> "PredictionModel":
        """Return this model with a constant disturbance of each of these signals as a further state.

        With as many as outputs, predictions have no offset at rest (Pannocchia and Rawlings 2003). Costs and rows
        follow from the states.

        Args:
            signals: Outputs, counted from 0, and then inputs, counted on from there.
        """
        if not signals:
            return self
        n, extra, n_outputs = self.n_states, len(signals), len(self.y0)
        inputs = [(n + place, signal - n_outputs) for place, signal in enumerate(signals) if signal >= n_outputs]
        twin = copy(self)
        twin.disturbances = tuple(signals)
        twin.x0 = np.concatenate([self.x0, np.zeros(extra)])
        twin.C = np.hstack([self.C, np.hstack([np.eye(n_outputs), self.D])[:, list(signals)]])
        twin.resting_inputs = np.zeros((self.D.shape[1], n + extra))
        for state, i in inputs:
            twin.resting_inputs[i, state] = -1.0
        twin.transitions = {}
        for ticks, step in self.transitions.items():
            A = np.eye(n + extra)
            A[:n, :n] = step.A
            for state, i in inputs:
                A[:n, state] = step.B[:, i]
            B, F = (np.vstack([M, np.zeros((extra, M.shape[1]))]) for M in (step.B, step.F))
            twin.transitions[ticks] = Transition(A, B, F)
        return twin

    def with_forecasts(self, sources: Sequence[int], ends: Sequence[int]) -> "PredictionModel":
        """Return this model with the changes that are forecast of disturbances as further states.

        Args:
            sources: States that are disturbances; -1 is the load.
            ends: Last samples of the parts of the horizon that each has a state for, rising.
        """
        if not sources:
            return self
        n, extra = self.n_states, len(sources) * len(ends)
        A, _, F = self.sample
        twin, starts, found = copy(self), (1, *(end + 1 for end in ends[:-1])), list[Ahead]()
        for source in sources:
            column, seen = np.zeros(n + extra), self.G[:, 0] if source < 0 else self.C[:, source]
            column[:n] = F[:, 0] if source < 0 else A[:, source] - np.eye(n)[source]
            found += [Ahead(n + len(found) + k, starts[k], end, column, seen) for k, end in enumerate(ends)]
        twin.ahead = tuple(found)
        twin.x0 = np.concatenate([self.x0, np.zeros(extra)])
        twin.C = np.hstack([self.C, np.zeros((len(self.C), extra))])
        twin.resting_inputs = np.hstack([self.resting_inputs, np.zeros((len(self.resting_inputs), extra))])
        twin.transitions = {
            ticks: Transition(
                np.block([[step.A, np.zeros((n, extra))], [np.zeros((extra, n)), np.eye(extra)]]),
                *(np.vstack([M, np.zeros((extra, M.shape[1]))]) for M in (step.B, step.F)),
            )
            for ticks, step in self.transitions.items()
        }
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


def prediction_of(model: LtiModel, disturbed: Sequence[int], design: ControlDesign) -> PredictionModel:
    """Return the model that an optimiser predicts by: with constants of the signals `disturbed`, and what is forecast.

    Changes are forecast as means over the time from one decision instant to the next.
    """
    prediction = PredictionModel(model)
    process = prediction.process
    sources = [
        -1 if one.name == process.load.name else process.state_names.index(one.name) for one in process.forecasts
    ]
    return prediction.with_disturbances(disturbed).with_forecasts(sources, design.decision_instants)


def state_cost(model: LtiModel, design: ControlDesign) -> Array:
    """Return Q, shape (n, n): what the states, and the outputs through them, weigh."""
    weights = np.array([output.weight for output in model.declared.outputs])
    through_outputs: Array = model.C.T @ (weights[:, None] * model.C)
    return through_outputs + np.diag(state_weights(model, design))


def state_weights(model: LtiModel, design: ControlDesign) -> Array:
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
    beside the load, is 0 at rest.

    Raises:
        ConfigurationError: With another model, none does.
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
        return found.astype(real, copy=False)
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
    return found.astype(real, copy=False)
