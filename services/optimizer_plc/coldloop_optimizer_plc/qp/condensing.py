"""Condensing: the prediction over the horizon and its cost as functions of the decision variables z alone.

z (n,) holds, knot by knot, the 3 inputs (deviations from the operating point over `input_scale`) and then, knot by
knot, the 4 slacks of the output bands. The state and the load are stacked as s = (x, w), shape (n_x + 1,).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.design import ControlDesign
from coldloop_optimizer_plc.qp.linear_algebra import multiply
from coldloop_optimizer_plc.qp.prediction import PredictionModel, state_cost

Array = NDArray[np.float64]


class Condensed(NamedTuple):
    """J_0 = z' Phi z + (phi_map' s)' z + s' constant_map s, and the constrained outputs of the N samples.

    J_0 is about the state at rest and the inputs that keep it there under the estimated disturbances.
    """

    Phi: Array
    """Shape (n, n), with the weights of the slacks."""
    phi_map: Array
    """Shape (n_x + 1, n)."""
    constant_map: Array
    """Shape (n_x + 1, n_x + 1)."""
    outputs_z: Array
    """Outputs with a band at the end of each sample, as deviations, shape (N, bands, n)."""
    outputs_s: Array
    """Shape (N, bands, n_x + 1)."""


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
    outputs_z, outputs_s = [], []
    for sample, of_knots in enumerate(weights, 1):
        u_of_z = input_map(of_knots, design)
        ahead = [one for one in prediction.ahead if one.first <= sample <= one.last]
        to_z = multiply(A, to_z) + multiply(B, u_of_z)
        to_s = multiply(A, to_s)
        to_s[:, -1] += F[:, 0]
        for one in ahead:
            to_s[:, one.place] += one.states
        weighted_z, weighted_s = multiply(Q, to_z), multiply(Q, to_s)
        Phi += multiply(transposed(to_z), weighted_z) + multiply(transposed(u_of_z), R[:, None] * u_of_z)
        cross += 2.0 * (multiply(transposed(to_s), weighted_z) - multiply(weighted_resting, u_of_z))
        constant += multiply(transposed(to_s), weighted_s) + multiply(weighted_resting, resting)
        outputs_z.append(multiply(C, to_z) + multiply(D, u_of_z))
        through_w = multiply(C, to_s)
        through_w[:, -1] += G[:, 0]
        for one in ahead:
            through_w[:, one.place] += one.outputs[list(prediction.constrained)]
        outputs_s.append(through_w)
    Phi = np.ascontiguousarray(Phi + _slack_weights(weights, design))
    return Condensed(Phi, cross, constant, np.array(outputs_z), np.array(outputs_s))


def input_map(of_knots: Array, design: ControlDesign) -> Array:
    """Return the matrix (inputs, n) from z to the input deviation at a sample with these knot weights (knots,)."""
    u_of_z = np.zeros((design.n_inputs, (design.n_inputs + design.n_slacks) * len(of_knots)))
    for knot, weight in enumerate(of_knots):
        for i in range(design.n_inputs):
            u_of_z[i, design.n_inputs * knot + i] = weight * design.input_scale[i]
    return u_of_z


def slack_map(of_knots: Array, design: ControlDesign) -> Array:
    """Return the matrix (slacks, n) from z to the slacks at a sample with these knot weights (knots,)."""
    n_inputs = design.n_inputs * len(of_knots)
    slack_of_z = np.zeros((design.n_slacks, n_inputs + design.n_slacks * len(of_knots)))
    for knot, weight in enumerate(of_knots):
        for i in range(design.n_slacks):
            slack_of_z[i, n_inputs + design.n_slacks * knot + i] = weight
    return slack_of_z


def _slack_weights(weights: Array, design: ControlDesign) -> Array:
    rho = np.repeat(design.violation_weight, 2)
    n = (design.n_inputs + design.n_slacks) * weights.shape[1]
    total = np.zeros((n, n))
    for of_knots in weights:
        slack_of_z = slack_map(of_knots, design)
        total += multiply(transposed(slack_of_z), rho[:, None] * slack_of_z)
    return total


def transposed(M: Array) -> Array:
    """Return M' with its rows contiguous."""
    return np.ascontiguousarray(M.T)
