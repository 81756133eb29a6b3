"""The condensed quadratic problem: min z' Phi z + z' phi under Gamma z <= gamma and low <= z <= high.

z (n,) holds, knot by knot, the inputs (deviations from the operating point over `input_scale`) and then, knot by knot,
the slacks of the output bands, two each. It parametrises the input profile U_pwc(p), piecewise affine between the
decision instants and constant before the first. Instants count sampling periods: u_j holds during the j-th one, from
(j - 1) to j periods ahead.

The state and the load are stacked as s = (x, w), shape (n_x + 1,). phi and gamma are affine in s and in the input
applied before the first knot; Phi and Gamma are constant. There is no factor 1/2 before Phi (`studies/slips.md`, 11).
"""

from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop.process.settings import InputLimits, settings_of
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Array, Real, add_transposed_product, multiply, rounded
from coldloop_optimizer_plc.qp.prediction import PredictionModel, rest_of, state_cost
from coldloop_optimizer_plc.settings import ControlDesign, PenaltySettings, Target


@kernel
def interpolation(knots: Array, at: Array) -> Array:
    """Return the matrix (instants, knots) whose product with the knots' values is the profile `at` some instants.

    It has the floating-point type of the knots. Before the first knot and behind the last one values hold.
    """
    one, last = knots.dtype.type(1.0), knots.shape[0] - 1
    weights = np.zeros((at.shape[0], last + 1), knots.dtype)
    for row in range(at.shape[0]):
        position, right = min(max(at[row], knots[0]), knots[last]), 0
        while right < last and knots[right] <= position:
            right += 1
        left = max(right - 1, 0)
        span = knots[right] - knots[left]
        share = (position - knots[left]) / span if span > 0 else knots.dtype.type(0.0)
        weights[row, left] += one - share
        weights[row, right] += share
    return weights


@kernel
def shift(knots: Array, periods: float) -> Array:
    """Return the matrix that shifts a profile by `periods` sampling periods: the standard hot start.

    It has the floating-point type of the knots. The value behind the horizon is the last knot's.
    """
    return interpolation(knots, knots + periods)


@kernel
def shifted(S: Array, z: Array, n_inputs: int) -> Array:
    """Return the profile z (n,) whose values at the knots are combined by S (knots, knots), inputs and slacks alike.

    The first `n_inputs` variables are inputs at all knots.
    """
    result = np.zeros_like(z)
    knots, start = S.shape[0], 0
    for part in range(2):
        width = (n_inputs if part == 0 else z.shape[0] - n_inputs) // knots
        for old in range(knots):
            for new in range(knots):
                if S[new, old] != z.dtype.type(0.0):
                    for i in range(width):
                        result[start + width * new + i] += S[new, old] * z[start + width * old + i]
        start += width * knots
    return result


@kernel
def hold(u: Array, scale: Array, n_inputs: int, z: Array) -> None:
    """Make z (n,) the profile that keeps the input deviation u (3,), without slack."""
    z[:] = z.dtype.type(0.0)
    for k in range(n_inputs):
        i = k % scale.shape[0]
        z[k] = u[i] / scale[i]


@kernel
def write_inputs(weights: Array, z: Array, scale: Array, u0: Array, rate: Array, samples: int, u: Array) -> None:
    """Write the inputs of the first samples into u (at least as many, 3), by `weights` (samples, knots) of the knots.

    They are in physical units, `u0` + `scale` z, and from one sample to the next within `rate`.
    """
    m = scale.shape[0]
    for sample in range(samples):
        for i in range(m):
            value = z.dtype.type(0.0)
            for knot in range(weights.shape[1]):
                value += weights[sample, knot] * z[m * knot + i]
            u[sample, i] = value * scale[i] + u0[i]
            if sample > 0:
                u[sample, i] = min(max(u[sample, i], u[sample - 1, i] - rate[i]), u[sample - 1, i] + rate[i])


class Condensed(NamedTuple):
    """J_0 = z' Phi z + (phi_map' s)' z + s' constant_map s, and the constrained outputs of the N samples.

    J_0 is about the state at rest and the inputs that keep it there under the estimated disturbances. Phi (n, n) has
    the weights of the slacks; phi_map (n_x + 1, n), constant_map (n_x + 1, n_x + 1). outputs_z (N, bands, n) and
    outputs_s (N, bands, n_x + 1) give the outputs with a band at the end of each sample, as deviations.
    """

    Phi: Array
    phi_map: Array
    constant_map: Array
    outputs_z: Array
    outputs_s: Array


def condense(prediction: PredictionModel, design: ControlDesign, weights: Array) -> Condensed:
    """Return the condensed cost and outputs; `weights` (N, knots) are those of the knots in each sample."""
    n, nx = (design.n_inputs + design.n_slacks) * weights.shape[1], prediction.n_states
    A, B, F = prediction.sample
    to_z = np.zeros((nx, n))
    to_s = np.hstack([np.eye(nx), np.zeros((nx, 1))])
    Q, n_x = np.zeros((nx, nx)), len(prediction.model.x0)  # disturbances weigh nothing
    Q[:n_x, :n_x] = state_cost(prediction.model, design)
    R = np.asarray(design.input_weight)
    resting = np.hstack([prediction.resting_inputs, np.zeros((design.n_inputs, 1))])
    weighted_resting = multiply(transposed(resting), np.diag(R))
    C, D, G = (matrix[list(prediction.constrained)] for matrix in (prediction.C, prediction.D, prediction.G))
    Phi, cross, constant = np.zeros((n, n)), np.zeros((nx + 1, n)), np.zeros((nx + 1, nx + 1))
    rho, of_slacks = np.repeat(design.violation_weight, 2), np.zeros((n, n))
    no_slacks = np.zeros((design.n_inputs, design.n_slacks * weights.shape[1]))
    outputs_z, outputs_s = [], []
    for sample, of_knots in enumerate(weights, 1):
        u_of_z = np.hstack([np.kron(of_knots, np.diag(design.input_scale)), no_slacks])
        slack_of_z = slack_map(of_knots, design)
        ahead = [one for one in prediction.ahead if one.first <= sample <= one.last]
        to_z = multiply(A, to_z) + multiply(B, u_of_z)
        to_s = multiply(A, to_s)
        to_s[:, -1] += F[:, 0]
        for one in ahead:
            to_s[:, one.place] += one.states
        weighted_z, weighted_s = multiply(Q, to_z), multiply(Q, to_s)
        Phi += multiply(transposed(to_z), weighted_z) + multiply(transposed(u_of_z), R[:, None] * u_of_z)
        of_slacks += multiply(transposed(slack_of_z), rho[:, None] * slack_of_z)
        cross += 2.0 * (multiply(transposed(to_s), weighted_z) - multiply(weighted_resting, u_of_z))
        constant += multiply(transposed(to_s), weighted_s) + multiply(weighted_resting, resting)
        outputs_z.append(multiply(C, to_z) + multiply(D, u_of_z))
        through_w = multiply(C, to_s)
        through_w[:, -1] += G[:, 0]
        for one in ahead:
            through_w[:, one.place] += one.outputs[list(prediction.constrained)]
        outputs_s.append(through_w)
    return Condensed(np.ascontiguousarray(Phi + of_slacks), cross, constant, np.array(outputs_z), np.array(outputs_s))


def slack_map(of_knots: Array, design: ControlDesign) -> Array:
    """Return the matrix (slacks, n) from z to the slacks at a sample with these knot weights (knots,)."""
    inputs = np.zeros((design.n_slacks, design.n_inputs * len(of_knots)))
    return np.hstack([inputs, np.kron(of_knots, np.eye(design.n_slacks))])


def transposed(M: Array) -> Array:
    """Return M' with its rows contiguous."""
    return np.ascontiguousarray(M.T)


class OutputMaps(NamedTuple):
    """Maps from a profile and the parameters to the b outputs with a band in turn, over the horizon of N samples.

    resting (b N,) are those at the operating point; of_z (n, b N), of_x (n_x, b N), of_w (b N,). bands (3, b) are low,
    high and weight of each, row_gains (m,) the factors that the rows of Gamma were multiplied by.
    """

    resting: Array
    of_z: Array
    of_x: Array
    of_w: Array
    bands: Array
    row_gains: Array


class Rows(NamedTuple):
    """Rows of Gamma z <= gamma, Gamma (rows, n), multiplied by gains (rows,): 1 for the output of the larger rho.

    bounds (rows,) are gamma at the operating point, with no input before; moved (n_x + 1 or inputs, rows) is its
    derivative with respect to s = (x, w), or to the input before.
    """

    Gamma: Array
    bounds: Array
    moved: Array
    gains: Array


def output_rows(condensed: Condensed, design: ControlDesign, weights: Array, y0: Array) -> Rows:
    """Return the rows -y_j - s <= -low and y_j - s <= high at each constraint instant, output by output.

    `weights` (N, knots) are those of the knots, `y0` the outputs at rest.
    """
    rho, places, y0 = np.array(design.violation_weight), np.array(design.constraint_instants) - 1, np.asarray(y0)
    slacks = np.array([slack_map(weights[place], design) for place in places])
    y_z, y_s, margin = condensed.outputs_z[places], condensed.outputs_s[places], np.array(design.band_margin)
    ends = np.array([-(design.output_low + margin - y0), design.output_high - margin - y0])
    rows = np.stack([-y_z - slacks[:, ::2], y_z - slacks[:, 1::2]], axis=2).reshape(-1, y_z.shape[-1])
    states = np.stack([y_s, -y_s], axis=2).reshape(-1, y_s.shape[-1])
    gain = np.tile(np.repeat(np.sqrt(rho / rho.max()), 2), len(places))
    return Rows(rows * gain[:, None], np.tile(ends.T.ravel(), len(places)) * gain, (states * gain[:, None]).T, gain)


def rate_rows(design: ControlDesign, limits: InputLimits, penalties: PenaltySettings) -> Rows:
    """Return the rows +-(u_b - u_a) <= (b - a) rate of each interval between decision instants, unless always true.

    The first interval starts at the input before the first knot. Gains are what breaking the rows costs.
    """
    ranges = np.asarray(limits.high) - np.asarray(limits.low)
    n_inputs = design.n_inputs
    size = (n_inputs + design.n_slacks) * len(design.decision_instants)
    gains_of_inputs = np.sqrt(penalties.rate_rows) / np.array(design.input_scale)
    rows, bounds, before, gained = [], [], [], []
    starts = (design.decision_instants[0] - 1, *design.decision_instants[:-1])
    for knot, (start, end) in enumerate(zip(starts, design.decision_instants, strict=True)):
        for i in range(n_inputs):
            limit = (end - start) * limits.rate[i]
            if limit >= ranges[i]:
                continue
            row = np.zeros(size)
            row[n_inputs * knot + i] = design.input_scale[i]
            if knot:
                row[n_inputs * (knot - 1) + i] = -design.input_scale[i]
            for sign in (1.0, -1.0):
                rows.append(sign * row)
                bounds.append(limit)
                before.append(sign * np.eye(n_inputs)[i] * (knot == 0))
                gained.append(gains_of_inputs[i])
    gains = np.array(gained)
    moved = (np.reshape(before, (-1, n_inputs)) * gains[:, None]).T
    return Rows(np.reshape(rows, (-1, size)) * gains[:, None], np.array(bounds) * gains, moved, gains)


class Maps(NamedTuple):
    """Maps from the parameters to an instance; the state and the load are stacked as s = (x, w).

    phi (n_s, n), constant (n_s, n_s), outputs (n_s, 56), rate_before (3, 38). rate_first is 1.0 for the rows of the
    interval before the first knot; first_rate are the rates of the inputs, scaled, where they bound the first knot as a
    box, infinite where they do not. rest (3, n_s) is s at rest by the target, scaled inputs, holding (3, n) 2 Phi times
    a profile that holds an input: (0, n_s) and (0, n) where the target is the operating point.
    """

    phi: Array
    constant: Array
    outputs: Array
    output_bounds: Array
    rate_bounds: Array
    rate_first: Array
    rate_before: Array
    low: Array
    high: Array
    first_rate: Array
    input_scale: Array
    rest: Array
    holding: Array


@kernel
def first_knot_range(maps: Maps, rate: Array, u_before: Array, share: float, i: int) -> tuple[float, float]:
    """Return the range of input i at the first knot, within a share of its rate (3,) of the input before it, scaled."""
    start = u_before[i] / maps.input_scale[i]
    reach = rate[i] * share
    return min(max(start - reach, maps.low[i]), maps.high[i]), min(max(start + reach, maps.low[i]), maps.high[i])


@kernel
def keep_first_rate(maps: Maps, rate: Array, u_before: Array, share: float, z: Array) -> None:
    """Move the inputs of the first knot of z (n,) to within their rate (3,), scaled, of the input before it (3,)."""
    for i in range(u_before.shape[0]):
        low, high = first_knot_range(maps, rate, u_before, share, i)
        z[i] = min(max(z[i], low), high)


@kernel
def instance(
    maps: Maps, x: Array, w: float, u_before: Array, share: float, target: Array
) -> tuple[Array, Array, Array, Array, float]:  # fmt: skip
    """Return phi, gamma, low, high and the constant of the cost, which is about a target (3,) of scaled inputs.

    With its states at rest taken from s, and its inputs from z, the cost is as about the operating point.
    """
    zero, one, half = x.dtype.type(0.0), x.dtype.type(1.0), x.dtype.type(0.5)
    s = np.empty(x.shape[0] + 1, x.dtype)
    s[:-1] = x
    s[x.shape[0]] = w
    deviation = s.copy()
    add_transposed_product(maps.rest, -target, deviation)
    phi = np.zeros(maps.phi.shape[1], x.dtype)
    add_transposed_product(maps.phi, deviation, phi)
    about_rest = phi.copy()
    add_transposed_product(maps.holding, -target, phi)
    outputs, rates = maps.output_bounds.shape[0], maps.rate_bounds.shape[0]
    gamma = np.empty(outputs + rates, x.dtype)
    gamma[:outputs] = maps.output_bounds
    for r in range(rates):
        gamma[outputs + r] = maps.rate_bounds[r] * (share if maps.rate_first[r] > zero else one)
    add_transposed_product(maps.outputs, s, gamma[:outputs])
    add_transposed_product(maps.rate_before, u_before, gamma[outputs:])
    low, high = maps.low.copy(), maps.high.copy()
    for i in range(u_before.shape[0]):
        low[i], high[i] = first_knot_range(maps, maps.first_rate, u_before, share, i)
    weighted = np.zeros(s.shape[0], x.dtype)
    add_transposed_product(maps.constant, deviation, weighted)
    constant = zero
    for i in range(s.shape[0]):
        constant += deviation[i] * weighted[i]
    inputs = 0
    while inputs < phi.shape[0] and np.isfinite(maps.high[inputs]):  # slacks have no upper bound
        inputs += 1
    for i in range(maps.holding.shape[0]):
        for j in range(i, inputs, u_before.shape[0]):
            constant -= half * (about_rest[j] + phi[j]) * target[i]
    return phi, gamma, low, high, constant


LONG_AGO: Final = 2**15  # ticks, more than any sampling period has


class QuadraticProblem(NamedTuple):
    """One instance of the problem; shapes (n, n), (n,), (m, n), (m,), (n,), (n,). `constant` completes the cost."""

    Phi: Array
    phi: Array
    Gamma: Array
    gamma: Array
    low: Array
    high: Array
    constant: float


class QpParameters(NamedTuple):
    """Parameters of an instance, as deviations from the operating point.

    u_before is applied just before the first knot takes effect; the ticks elapsed since the update before matter when
    the rate limit follows them. The cost is about the target, scaled inputs, shape (3,); None is the operating point.
    """

    x: Array
    w: float
    u_before: Array
    elapsed_ticks: int = LONG_AGO
    target: Array | None = None


class PredictiveProblem:
    """Builds instances of the QP for one design and one prediction model.

    Penalties scale the rows: a problem that is solved exactly is the same whatever they are. Of the cold box, with the
    paper's instants, n = 7 decision instants x 7 = 49 variables, m = 56 output rows and 38 rate rows.
    """

    def __init__(
        self, prediction: PredictionModel, design: ControlDesign, limits: InputLimits, real: Real = DOUBLE,
        penalties: PenaltySettings | None = None,
    ) -> None:  # fmt: skip
        if penalties is None:
            with settings_of(prediction.process):
                penalties = PenaltySettings()
        self.design = design
        self.longest_ticks = prediction.process.ticks_per_sample
        """Longest updating period: shifts are tabulated up to it."""
        self.limits = limits
        self.n_knots = len(design.decision_instants)
        self.n_inputs = design.n_inputs * self.n_knots
        self.size = (design.n_inputs + design.n_slacks) * self.n_knots
        self._real = real
        self._n_constrained = len(prediction.constrained)
        instants, ticks = np.array(design.decision_instants, DOUBLE), range(self.longest_ticks + 1)
        weights = interpolation(instants, np.arange(1.0, design.horizon + 1))
        y0 = prediction.model.y0[list(prediction.constrained)]
        condensed = condense(prediction, design, weights)
        outputs, rates = output_rows(condensed, design, weights, y0), rate_rows(design, limits, penalties)
        n_states, scale, u0 = prediction.n_states, np.asarray(design.input_scale), np.array(prediction.model.u0)
        rate, rest, bath = np.asarray(limits.rate), np.zeros((0, n_states + 1)), prediction.process.bath
        if bath is not None and design.target is not Target.OPERATING_POINT:
            rest = rest_of(prediction, design, bath).states
        low_u, high_u = ((np.asarray(bounds) - u0) / scale for bounds in (limits.low, limits.high))
        slacks = np.zeros(self.size - self.n_inputs)
        held = np.tile(np.eye(len(rest), design.n_inputs), self.n_knots)  # profiles that hold an input of the target
        maps = Maps(
            phi=condensed.phi_map, constant=condensed.constant_map, outputs=outputs.moved,
            output_bounds=outputs.bounds, rate_bounds=rates.bounds, rate_first=1.0 * np.any(rates.moved, axis=0),
            rate_before=rates.moved, low=np.concatenate([np.tile(low_u, self.n_knots), slacks]),
            high=np.concatenate([np.tile(high_u, self.n_knots), slacks + np.inf]),
            first_rate=rate / scale if penalties.first_knot_in_box else np.full(design.n_inputs, np.inf),
            input_scale=scale, rest=rest, holding=2.0 * held @ condensed.Phi[: self.n_inputs],
        )  # fmt: skip
        stacked = condensed.outputs_s.reshape(-1, n_states + 1)
        predicted = OutputMaps(
            np.tile(y0, design.horizon), condensed.outputs_z.reshape(-1, self.size).T, stacked[:, :n_states].T,
            stacked[:, n_states], np.array([design.output_low, design.output_high, design.violation_weight]),
            np.concatenate([outputs.gains, rates.gains]),
        )  # fmt: skip
        self.maps, self.predicted = rounded(maps, real), rounded(predicted, real)
        self.Phi, self.Gamma = rounded(condensed.Phi, real), rounded(np.vstack([outputs.Gamma, rates.Gamma]), real)
        self.knots, self.knots_to_samples = rounded(instants, real), rounded(weights, real)
        self.shifts = rounded(np.array([shift(instants, each / self.longest_ticks) for each in ticks]), real)
        self.input_scale, self.rate = rounded(scale, real), rounded(rate, real)
        self.scaled_rate, self._u0 = rounded(rate / scale, real), rounded(u0, real)

    def at(self, parameters: QpParameters) -> QuadraticProblem:
        """Return the instance of the problem for these parameters.

        Raises ValueError if the state is not one of this problem's model: kernels would read and write beyond it.
        """
        self._check(parameters)
        share = self._share(parameters)
        target = np.zeros(self.design.n_inputs, self._real) if parameters.target is None else parameters.target
        phi, gamma, low, high, constant = instance(
            self.maps, parameters.x, parameters.w, parameters.u_before, share, target
        )
        return QuadraticProblem(self.Phi, phi, self.Gamma, gamma, low, high, self._real(constant))

    def _share(self, parameters: QpParameters) -> float:
        share: float = self._real(self.limits.rate_share(parameters.elapsed_ticks))
        return share

    def _check(self, parameters: QpParameters) -> None:
        n_states = self.predicted.of_x.shape[0]
        if parameters.x.shape != (n_states,):
            raise ValueError(f"a state of shape {parameters.x.shape} for a problem with {n_states} states")

    def memory(self) -> int:
        """Return the bytes of the constant arrays that an instance is made of: Phi, Gamma and the maps."""
        return sum(M.nbytes for M in (self.Phi, self.Gamma, *self.maps))

    def shifted(self, z: Array, ticks: int) -> Array:
        """Return the profile z shifted by `ticks` ticks."""
        if ticks <= self.longest_ticks:
            return shifted(self.shifts[ticks], z, self.n_inputs)
        return shifted(shift(self.knots, self._real(ticks) / self._real(self.longest_ticks)), z, self.n_inputs)

    def within_first_rate(self, z: Array, parameters: QpParameters) -> Array:
        """Return the profile z with its first knot within the rate of the input before it, as it can be sent."""
        result = z.copy()
        keep_first_rate(self.maps, self.scaled_rate, parameters.u_before, self._share(parameters), result)
        return result

    def inputs(self, z: Array, samples: int) -> Array:
        """Return the inputs of the first `samples` sampling periods, shape (samples, 3), in physical units.

        The rates between knots are rows of the problem, which a truncated solution may break; what is sent keeps them.
        """
        u = np.empty((samples, self.design.n_inputs), z.dtype)
        write_inputs(self.knots_to_samples, z, self.input_scale, self._u0, self.rate, samples, u)
        return u

    def outputs(self, z: Array, parameters: QpParameters) -> Array:
        """Return the outputs with a band predicted at the end of each sampling period, shape (horizon, bands)."""
        self._check(parameters)
        maps = self.predicted
        outputs = maps.resting.copy()
        add_transposed_product(maps.of_z, z, outputs)
        add_transposed_product(maps.of_x, parameters.x, outputs)
        outputs += maps.of_w * parameters.w
        return outputs.reshape(-1, self._n_constrained)

    def hold(self, u: Array) -> Array:
        """Return the profile that keeps the input deviation u, without slack."""
        z = np.zeros(self.size, self._real)
        hold(u, self.input_scale, self.n_inputs, z)
        return z
