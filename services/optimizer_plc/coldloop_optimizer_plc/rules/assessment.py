"""The quantities of Algorithm 1 (section II of the paper), from five costs: E^r, D^r, K^r, response time and Gamma."""

import math
from typing import NamedTuple

from coldloop.kernels.compiled import kernel


class Observation(NamedTuple):
    """What is known at t_{k+1} of the period that ends there; costs are positive (Assumption 1 of the paper)."""

    q: int
    """q(t_k), the number of the period in the ladder."""
    iterations: int
    """Those that it held: for the increments per iteration."""
    period_s: float
    """t_{k+1} - t_k."""
    effective_before: float
    """J_k: p(t_k) at the state reached at t_k."""
    hot_start: float
    """J+_k: the shifted profile at the state predicted for t_{k+1}."""
    last_but_one: float
    """J after all iterations but one, at the predicted state."""
    delivered: float
    """Ĵ_{k+1}: after all iterations, at the predicted state."""
    effective: float
    """J_{k+1}: p(t_{k+1}) at the state reached at t_{k+1}."""


class Assessment(NamedTuple):
    """The quantities of Algorithm 1. `gamma` is the gradient whose sign decides; n are iterations, the paper's q."""

    efficiency: float
    """E^r."""
    mismatch: float
    """D^r."""
    contraction: float
    """K^r = E^r D^r."""
    mismatch_increment: float
    """Delta D^r / Delta n."""
    efficiency_increment: float
    """Delta E^r / Delta n."""
    contraction_increment: float
    """Delta K^r / Delta n."""
    response_increment: float
    """Delta t_r / Delta n; infinite at K^r = 1, where the response time is."""
    gamma: float


def assess(observation: Observation) -> Assessment:
    """Compute the quantities of Algorithm 1 as printed, in the floating-point type of the costs."""
    o = observation
    real = type(o.effective)
    zero, one, n = real(0.0), real(1.0), real(o.iterations)
    E = o.delivered / o.hot_start
    D = (o.effective * o.hot_start) / (o.delivered * o.effective_before)
    K = E * D
    dD = (D - one) / n
    dE = (o.delivered - o.last_but_one) / o.hot_start
    dK = E * dD + D * dE
    log_K = real(math.log(K))
    dt_r = (-log_K + n / K * dK) / (log_K * log_K) if log_K != zero else real(math.copysign(real(math.inf), dK))
    return Assessment(E, D, K, dD, dE, dK, dt_r, dK if one <= K else dt_r)


assessed = kernel(assess)
