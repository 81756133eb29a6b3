"""The condensed quadratic problem: min z' Phi z + z' phi under Gamma z <= gamma and low <= z <= high.

z holds, knot by knot, the inputs (deviations from the operating point over `input_scale`) and then, knot by knot, the
slacks of the output bands. phi and gamma are affine in the predicted state, the load and the input applied
before the first knot; Phi and Gamma are constant. There is no factor 1/2 before Phi (`report/slips.md`, 11).
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.limits import InputLimits
from coldloop.process.settings import settings_of
from coldloop_optimizer_plc.qp.arithmetic import DOUBLE, Real
from coldloop_optimizer_plc.qp.condensing import Condensed, condense, transposed
from coldloop_optimizer_plc.qp.constraints import OutputRows, RateRows, output_rows, rate_rows
from coldloop_optimizer_plc.qp.design import ControlDesign, Target
from coldloop_optimizer_plc.qp.instance import Maps, instance, keep_first_rate
from coldloop_optimizer_plc.qp.linear_algebra import add_transposed_product
from coldloop_optimizer_plc.qp.penalties import PenaltySettings
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.profile import hold, inputs_of, interpolation, shift, shifted
from coldloop_optimizer_plc.qp.target import rest_of

Array = NDArray[np.float64]


LONG_AGO: Final = 2**15
"""Ticks, more than any sampling period has."""


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
    """What an instance depends on, as deviations from the operating point."""

    x: Array
    w: float
    u_before: Array
    """Input applied just before the first knot takes effect."""
    elapsed_ticks: int = LONG_AGO
    """Time since the update before; matters when the rate limit follows the elapsed time."""
    target: Array | None = None
    """Scaled inputs, shape (3,), that the cost is about; None is the operating point."""


class PredictiveProblem:
    """Builds instances of the QP for one design and one prediction model.

    Penalties scale the rows: a problem that is solved exactly is the same whatever they are.

    Sizes: of the cold box n = 7 decision instants x 7 = 49 variables; m = 56 output rows and 38 rate rows with the
    paper's instants.
    """

    def __init__(
        self,
        prediction: PredictionModel,
        design: ControlDesign,
        limits: InputLimits,
        real: Real = DOUBLE,
        penalties: PenaltySettings | None = None,
    ) -> None:
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
        weights = interpolation(design.decision_instants, np.arange(1.0, design.horizon + 1))
        y0 = prediction.model.y0[list(prediction.constrained)]
        condensed = condense(prediction, design, weights)
        outputs, rates = output_rows(condensed, design, weights, y0), rate_rows(design, limits, penalties)
        n_states = prediction.n_states
        self.Phi = self._rounded(condensed.Phi)
        self.Gamma = self._rounded(np.ascontiguousarray(np.vstack([outputs.Gamma, rates.Gamma])))
        self.row_gains = self._rounded(np.concatenate([outputs.gains, rates.gains]))
        scaled_rate = np.asarray(limits.rate) / np.asarray(design.input_scale)
        first_rate = scaled_rate if penalties.first_knot_in_box else np.full(design.n_inputs, np.inf)
        u0 = np.array(prediction.model.u0)
        rest = np.zeros((0, n_states + 1))
        bath = prediction.process.bath
        if bath is not None and design.target is not Target.OPERATING_POINT:
            rest = rest_of(prediction, design, bath).states
        self.maps = Maps(*map(self._rounded, self._maps(condensed, outputs, rates, u0, first_rate, rest)))
        self.scaled_rate = self._rounded(scaled_rate)
        self.knots = np.array(design.decision_instants, real)
        self.knots_to_samples = self._rounded(weights)
        instants = np.array(design.decision_instants, DOUBLE)
        self.shifts = self._rounded(
            np.array([shift(instants, ticks / self.longest_ticks) for ticks in range(self.longest_ticks + 1)])
        )
        self.bands = self._rounded(np.array([design.output_low, design.output_high, design.violation_weight]))
        self.resting_outputs = self._rounded(np.tile(y0, design.horizon))
        self.stacked_outputs_z = self._rounded(transposed(condensed.outputs_z.reshape(-1, self.size)))
        stacked = condensed.outputs_s.reshape(-1, n_states + 1)
        self.stacked_outputs_x = self._rounded(transposed(stacked[:, :n_states]))
        self.stacked_outputs_w = self._rounded(np.array(stacked[:, n_states]))
        self.input_scale = self._rounded(np.asarray(design.input_scale))
        self.rate = self._rounded(np.asarray(limits.rate))
        self._u0 = self._rounded(u0)

    def _rounded(self, values: Array) -> Array:
        """Return an array in the type of the on-line arithmetic."""
        return values.astype(self._real, copy=False)

    def _maps(
        self, condensed: Condensed, outputs: OutputRows, rates: RateRows, u0: Array, first_rate: Array, rest: Array
    ) -> Maps:  # fmt: skip
        scale = np.asarray(self.design.input_scale)
        low_u, high_u = (np.asarray(self.limits.low) - u0) / scale, (np.asarray(self.limits.high) - u0) / scale
        slacks = self.design.n_slacks * self.n_knots
        held = np.tile(
            np.eye(len(rest), self.design.n_inputs), self.n_knots
        )  # profiles that hold an input of the target
        return Maps(
            phi=condensed.phi_map,
            constant=condensed.constant_map,
            outputs=outputs.states,
            output_bounds=outputs.bounds,
            rate_bounds=rates.bounds,
            rate_first=rates.first,
            rate_before=rates.before,
            low=np.concatenate([np.tile(low_u, self.n_knots), np.zeros(slacks)]),
            high=np.concatenate([np.tile(high_u, self.n_knots), np.full(slacks, np.inf)]),
            first_rate=first_rate,
            input_scale=scale,
            rest=rest,
            holding=np.ascontiguousarray(2.0 * held @ condensed.Phi[: self.n_inputs]),
        )

    # -- instances ---------------------------------------------------------------------------------------------------

    def at(self, parameters: QpParameters) -> QuadraticProblem:
        """Return the instance of the problem for these parameters.

        Raises:
            ValueError: The state is not one of this problem's model; kernels would read and write beyond it.
        """
        self._check(parameters)
        share = self._share(parameters)
        target = np.zeros(self.design.n_inputs, self._real) if parameters.target is None else parameters.target
        phi, gamma, low, high, constant = instance(
            self.maps, parameters.x, parameters.w, parameters.u_before, share, target
        )
        return QuadraticProblem(self.Phi, phi, self.Gamma, gamma, low, high, self._real(constant))

    def _share(self, parameters: QpParameters) -> float:
        """Return the share of the rate limit that an update may use."""
        share: float = self._real(self.limits.rate_share(parameters.elapsed_ticks))
        return share

    def _check(self, parameters: QpParameters) -> None:
        n_states = self.stacked_outputs_x.shape[0]
        if parameters.x.shape != (n_states,):
            raise ValueError(f"a state of shape {parameters.x.shape} for a problem with {n_states} states")

    def memory(self) -> int:
        """Return the bytes of the constant arrays that an instance is made of: Phi, Gamma and the maps."""
        return sum(M.nbytes for M in (self.Phi, self.Gamma, *self.maps))

    # -- profiles ----------------------------------------------------------------------------------------------------

    def shifted(self, z: Array, ticks: int) -> Array:
        """Return the profile z shifted by `ticks` ticks."""
        if ticks <= self.longest_ticks:
            return shifted(self.shifts[ticks], z, self.n_inputs)
        return shifted(shift(self.knots, self._real(ticks) / self._real(self.longest_ticks)), z, self.n_inputs)

    def within_first_rate(self, z: Array, parameters: QpParameters) -> Array:
        """Return the profile z with its first knot within the rate of the input before it, as it can be sent."""
        share = self._share(parameters)
        result = z.copy()
        keep_first_rate(self.maps, self.scaled_rate, parameters.u_before, share, result)
        return result

    def inputs(self, z: Array, samples: int) -> Array:
        """Return the inputs of the first `samples` sampling periods, shape (samples, 3), in physical units.

        The rates between knots are rows of the problem, which a truncated solution may break; what is sent keeps them.
        """
        return inputs_of(self.knots_to_samples[:samples], z, self.input_scale, self._u0, self.rate)

    def outputs(self, z: Array, parameters: QpParameters) -> Array:
        """Return the outputs with a band predicted at the end of each sampling period, shape (horizon, bands)."""
        self._check(parameters)
        outputs = self.resting_outputs.copy()
        add_transposed_product(self.stacked_outputs_z, z, outputs)
        add_transposed_product(self.stacked_outputs_x, parameters.x, outputs)
        outputs += self.stacked_outputs_w * parameters.w
        return outputs.reshape(-1, self._n_constrained)

    def hold(self, u: Array) -> Array:
        """Return the profile that keeps the input deviation u, without slack."""
        z = np.zeros(self.size, self._real)
        hold(u, self.input_scale, self.n_inputs, z)
        return z
