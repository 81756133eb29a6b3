"""The condensed quadratic problem: min z' Phi z + z' phi under Gamma z <= gamma and low <= z <= high.

z holds, knot by knot, the 3 inputs (deviations from the operating point over `input_scale`) and then, knot by knot,
the 4 slacks of the output bands. phi and gamma are affine in the predicted state, the load and the input applied
before the first knot; Phi and Gamma are constant. There is no factor 1/2 before Phi (`docs/science.md`, ruling 11).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.compiled import kernel
from coldloop.limits import InputLimits
from coldloop.process import TICKS_PER_SAMPLE
from optimizer_plc.arithmetic import DOUBLE, Real
from optimizer_plc.design import N_INPUTS, N_SLACKS, ControlDesign
from optimizer_plc.linear_algebra import apply, multiply
from optimizer_plc.prediction import PredictionModel, state_weights
from optimizer_plc.profile import interpolation, shift

Array = NDArray[np.float64]

RATE_ROW_GAIN = 4.0
"""Rate rows are divided by their largest coefficient and multiplied by this: with a softer penalty a truncated or
penalised solution undercuts the optimum by breaking the rate limits."""


SHIFTS = TICKS_PER_SAMPLE
"""Longest shift, in ticks, that is tabulated: that of the longest updating period."""


class QuadraticProblem(NamedTuple):
    """One instance of the problem; shapes (n, n), (n,), (m, n), (m,), (n,), (n,). `constant` completes the cost."""

    Phi: Array
    phi: Array
    Gamma: Array
    gamma: Array
    low: Array
    high: Array
    constant: float


class Situation(NamedTuple):
    """What an instance depends on, as deviations from the operating point."""

    x: Array
    w: float
    u_before: Array
    """Input applied just before the first knot takes effect."""
    elapsed_ticks: int = TICKS_PER_SAMPLE
    """Time since the update before; matters when the rate limit follows the elapsed time."""


class PredictiveProblem:
    """Builds instances of the QP for one design and one prediction model.

    Sizes: n = 7 decision instants x 7 = 49 variables; m = 56 output rows and 38 rate rows with the paper's instants.
    """

    def __init__(
        self, prediction: PredictionModel, design: ControlDesign, limits: InputLimits, real: Real = DOUBLE
    ) -> None:
        self.design = design
        self.limits = limits
        self.n_knots = len(design.decision_instants)
        self.n_inputs = N_INPUTS * self.n_knots
        self.bands = np.array([design.output_low, design.output_high, design.violation_weight])
        self.size = (N_INPUTS + N_SLACKS) * self.n_knots
        self._model = prediction
        self.knots_to_samples = interpolation(design.decision_instants, np.arange(1.0, design.horizon + 1))
        self.input_scale = np.asarray(design.input_scale)
        self._u0, self.rate = np.array(prediction.model.u0), np.asarray(limits.rate)
        self._condense()
        self._build_output_rows()
        self._build_rate_rows()
        self.Gamma = np.ascontiguousarray(np.vstack([self._output_rows, self._rate_rows]))
        self.maps = Maps(*(M.astype(real, copy=False) for M in self._make_maps()))
        self.shifts = np.array(
            [shift(design.decision_instants, ticks / TICKS_PER_SAMPLE) for ticks in range(SHIFTS + 1)]
        )
        self._real = real
        self._round()

    # -- construction ------------------------------------------------------------------------------------------------

    def _condense(self) -> None:
        """Accumulate Phi, the map to phi, the constant and the constrained outputs over the horizon."""
        design, model = self.design, self._model
        n, nx = self.size, model.n_states
        A, B, F = model.sample
        to_z = np.zeros((nx, n))
        to_s = np.hstack([np.eye(nx), np.zeros((nx, 1))])
        Q = state_weights(model.model, design)
        R = np.asarray(design.input_weight)
        C, D, G = (matrix[list(model.constrained)] for matrix in (model.C, model.D, model.G))
        Phi, cross, constant = np.zeros((n, n)), np.zeros((nx + 1, n)), np.zeros((nx + 1, nx + 1))
        outputs_z, outputs_s = [], []
        for weights in self.knots_to_samples:
            u_of_z = self._input_map(weights)
            to_z = multiply(A, to_z) + multiply(B, u_of_z)
            to_s = multiply(A, to_s)
            to_s[:, -1] += F[:, 0]
            weighted_z, weighted_s = Q[:, None] * to_z, Q[:, None] * to_s
            Phi += multiply(_transposed(to_z), weighted_z) + multiply(_transposed(u_of_z), R[:, None] * u_of_z)
            cross += 2.0 * multiply(_transposed(to_s), weighted_z)
            constant += multiply(_transposed(to_s), weighted_s)
            outputs_z.append(multiply(C, to_z) + multiply(D, u_of_z))
            through_w = multiply(C, to_s)
            through_w[:, -1] += G[:, 0]
            outputs_s.append(through_w)
        self._Phi_deviation = Phi
        self._phi_map, self._constant_map = cross, constant
        self.outputs_z, self.outputs_s = np.array(outputs_z), np.array(outputs_s)
        self.stacked_outputs_z = _transposed(self.outputs_z.reshape(-1, n))
        self.stacked_outputs_x = _transposed(self.outputs_s.reshape(-1, nx + 1)[:, :nx])
        self.stacked_outputs_w = np.array(self.outputs_s.reshape(-1, nx + 1)[:, nx])
        self.y0 = model.model.y0[list(model.constrained)]
        self.resting_outputs = np.tile(self.y0, design.horizon)
        self.Phi = np.ascontiguousarray(Phi + self._slack_weights())

    def _input_map(self, weights: Array) -> Array:
        """Return the matrix (3, n) from z to the input deviation at a sample with these knot weights."""
        u_of_z = np.zeros((N_INPUTS, self.size))
        for knot, weight in enumerate(weights):
            for i in range(N_INPUTS):
                u_of_z[i, N_INPUTS * knot + i] = weight * self.input_scale[i]
        return u_of_z

    def _slack_map(self, weights: Array) -> Array:
        slack_of_z = np.zeros((N_SLACKS, self.size))
        for knot, weight in enumerate(weights):
            for i in range(N_SLACKS):
                slack_of_z[i, self.n_inputs + N_SLACKS * knot + i] = weight
        return slack_of_z

    def _slack_weights(self) -> Array:
        level, temperature = self.design.violation_weight
        rho = np.array([level, level, temperature, temperature])
        total = np.zeros((self.size, self.size))
        for weights in self.knots_to_samples:
            slack_of_z = self._slack_map(weights)
            total += multiply(_transposed(slack_of_z), rho[:, None] * slack_of_z)
        return total

    def _build_output_rows(self) -> None:
        """Rows -y_j - s <= -low and y_j - s <= high at each constraint instant, for L1 and then T5."""
        design = self.design
        rows, states, bounds = [], [], []
        for instant in design.constraint_instants:
            slack_of_z = self._slack_map(self.knots_to_samples[instant - 1])
            for output in range(2):
                y_z, y_s = self.outputs_z[instant - 1][output], self.outputs_s[instant - 1][output]
                low, high = design.output_low[output] - self.y0[output], design.output_high[output] - self.y0[output]
                rows += [-y_z - slack_of_z[2 * output], y_z - slack_of_z[2 * output + 1]]
                states += [y_s, -y_s]
                bounds += [-low, high]
        self._output_rows, self._output_bounds = np.array(rows), np.array(bounds)
        self._output_states = np.ascontiguousarray(np.array(states).T)

    def _build_rate_rows(self) -> None:
        """Rows +-(u_b - u_a) <= (b - a) rate for each interval between decision instants, unless always true.

        The first interval starts at the input applied before the first knot.
        """
        design, limits = self.design, self.limits
        ranges = np.asarray(limits.high) - np.asarray(limits.low)
        rows, bounds, before, first = [], [], [], []
        starts = (design.decision_instants[0] - 1, *design.decision_instants[:-1])
        for knot, (start, end) in enumerate(zip(starts, design.decision_instants, strict=True)):
            for i in range(N_INPUTS):
                limit = (end - start) * limits.rate[i]
                if limit >= ranges[i]:
                    continue
                row = np.zeros(self.size)
                row[N_INPUTS * knot + i] = self.input_scale[i]
                if knot:
                    row[N_INPUTS * (knot - 1) + i] = -self.input_scale[i]
                for sign in (1.0, -1.0):
                    rows.append(sign * row)
                    bounds.append(limit)
                    first.append(knot == 0)
                    before.append(sign * np.eye(N_INPUTS)[i] * (knot == 0))
        gains = RATE_ROW_GAIN / np.abs(rows).max(axis=1)
        self._rate_rows = np.array(rows) * gains[:, None]
        self._rate_bounds, self._rate_first = np.array(bounds) * gains, np.array(first)
        self._rate_before = np.ascontiguousarray((np.array(before) * gains[:, None]).T)
        self.row_gains = np.concatenate([np.ones(len(self._output_rows)), gains])

    def _round(self) -> None:
        """Round every array to the type of the on-line arithmetic."""
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(self, name, value.astype(self._real, copy=False))

    # -- instances ---------------------------------------------------------------------------------------------------

    def at(self, situation: Situation) -> QuadraticProblem:
        """Return the instance of the problem for a situation."""
        share = self._real(self.limits.rate_share(situation.elapsed_ticks))
        phi, gamma, low, high, constant = instance(self.maps, situation.x, situation.w, situation.u_before, share)
        return QuadraticProblem(self.Phi, phi, self.Gamma, gamma, low, high, self._real(constant))

    def _make_maps(self) -> "Maps":
        low_u = (np.asarray(self.limits.low) - self._model.model.u0) / self.input_scale
        high_u = (np.asarray(self.limits.high) - self._model.model.u0) / self.input_scale
        slacks = N_SLACKS * self.n_knots
        return Maps(
            phi=self._phi_map,
            constant=self._constant_map,
            outputs=self._output_states,
            output_bounds=self._output_bounds,
            rate_bounds=self._rate_bounds,
            rate_first=self._rate_first.astype(float),
            rate_before=self._rate_before,
            low=np.concatenate([np.tile(low_u, self.n_knots), np.zeros(slacks)]),
            high=np.concatenate([np.tile(high_u, self.n_knots), np.full(slacks, np.inf)]),
            rate=np.asarray(self.limits.rate) / self.input_scale,
            input_scale=self.input_scale,
        )

    def memory(self) -> int:
        """Return the bytes of the constant arrays that an instance is made of: Phi, Gamma and the maps."""
        return sum(M.nbytes for M in (self.Phi, self.Gamma, *self.maps))

    # -- profiles ----------------------------------------------------------------------------------------------------

    def shifted(self, z: Array, ticks: int) -> Array:
        """Return the profile z shifted by `ticks` ticks."""
        if ticks <= SHIFTS:
            return shifted(self.shifts[ticks], z)
        S = shift(self.design.decision_instants, ticks / TICKS_PER_SAMPLE)
        return shifted(S.astype(self._real, copy=False), z)

    def inputs(self, z: Array, samples: int) -> Array:
        """Return the inputs of the first `samples` sampling periods, shape (samples, 3), in physical units.

        The rates between knots are rows of the problem, which a truncated solution may break; what is sent keeps them.
        """
        return inputs_of(self.knots_to_samples[:samples], z, self.input_scale, self._u0, self.rate)

    def outputs(self, z: Array, situation: Situation) -> Array:
        """Return L1 and T5 predicted for a profile at the end of each sampling period, shape (horizon, 2)."""
        outputs = self.resting_outputs.copy()
        apply(self.stacked_outputs_z, z, outputs)
        apply(self.stacked_outputs_x, situation.x, outputs)
        outputs += self.stacked_outputs_w * situation.w
        return outputs.reshape(-1, len(self._model.constrained))

    def hold(self, u: Array) -> Array:
        """Return the profile that keeps the input deviation u, without slack."""
        return np.concatenate(
            [np.tile(u / self.input_scale, self.n_knots), np.zeros(N_SLACKS * self.n_knots, self._real)]
        )


def _transposed(M: Array) -> Array:
    return np.ascontiguousarray(M.T)


class Maps(NamedTuple):
    """How an instance follows from a situation; the state and the load are stacked as s = (x, w)."""

    phi: Array
    """Shape (n_s, n)."""
    constant: Array
    """Shape (n_s, n_s)."""
    outputs: Array
    """Shape (n_s, 56)."""
    output_bounds: Array
    rate_bounds: Array
    rate_first: Array
    """1.0 for the rows of the interval before the first knot."""
    rate_before: Array
    """Shape (3, 38)."""
    low: Array
    high: Array
    rate: Array
    """Rates of the inputs, scaled."""
    input_scale: Array


@kernel
def shifted(S: Array, z: Array) -> Array:
    """Return the profile z (n,) whose values at the knots are combined by S (knots, knots), inputs and slacks alike."""
    result = np.zeros_like(z)
    knots, start = S.shape[0], 0
    for width in (N_INPUTS, N_SLACKS):
        for old in range(knots):
            for new in range(knots):
                if S[new, old] != z.dtype.type(0.0):
                    for i in range(width):
                        result[start + width * new + i] += S[new, old] * z[start + width * old + i]
        start += width * knots
    return result


@kernel
def instance(maps: Maps, x: Array, w: float, u_before: Array, share: float) -> tuple[Array, Array, Array, Array, float]:
    """Return phi, gamma, low, high and the constant of the cost."""
    zero, one = x.dtype.type(0.0), x.dtype.type(1.0)
    s = np.empty(x.shape[0] + 1, x.dtype)
    for i in range(x.shape[0]):
        s[i] = x[i]
    s[x.shape[0]] = w
    phi = np.zeros(maps.phi.shape[1], x.dtype)
    apply(maps.phi, s, phi)
    outputs, rates = maps.output_bounds.shape[0], maps.rate_bounds.shape[0]
    gamma = np.empty(outputs + rates, x.dtype)
    for r in range(outputs):
        gamma[r] = maps.output_bounds[r]
    for r in range(rates):
        gamma[outputs + r] = maps.rate_bounds[r] * (share if maps.rate_first[r] > zero else one)
    apply(maps.outputs, s, gamma[:outputs])
    apply(maps.rate_before, u_before, gamma[outputs:])
    low, high = maps.low.copy(), maps.high.copy()
    for i in range(u_before.shape[0]):  # the first knot stays within its rate of the input before it
        start = u_before[i] / maps.input_scale[i]
        reach = maps.rate[i] * share
        low[i] = min(max(start - reach, maps.low[i]), maps.high[i])
        high[i] = min(max(start + reach, maps.low[i]), maps.high[i])
    weighted = np.zeros(s.shape[0], x.dtype)
    apply(maps.constant, s, weighted)
    constant = zero
    for i in range(s.shape[0]):
        constant += s[i] * weighted[i]
    return phi, gamma, low, high, constant


@kernel
def inputs_of(weights: Array, z: Array, scale: Array, u0: Array, rate: Array) -> Array:
    """Return the inputs (samples, 3) of a profile z (n,), for the knots' weights (samples, knots) in each sample.

    They are in physical units, `u0` + `scale` z, and from one sample to the next within `rate`.
    """
    samples, m = weights.shape[0], scale.shape[0]
    u = np.empty((samples, m), z.dtype)
    for sample in range(samples):
        for i in range(m):
            value = z.dtype.type(0.0)
            for knot in range(weights.shape[1]):
                value += weights[sample, knot] * z[m * knot + i]
            u[sample, i] = value * scale[i] + u0[i]
            if sample:
                u[sample, i] = min(max(u[sample, i], u[sample - 1, i] - rate[i]), u[sample - 1, i] + rate[i])
    return u
