"""Longest updating period of a plant with an unstable mode.

A mode of the linear model is z' = a z + v (B u + F w), v its left eigenvector. Its worst case: the load steps from one
end of its span to the other just after a measurement. The next one, a period tau later, shows it; the answer acts
another tau later. z grows for 2 tau; then the inputs move to their limits, by their rate in each update, and bring back
|z| < integral of exp(-a t) v B u(t) dt and nothing else, the null-controllable set (Hu and Lin, Control Systems with
Actuator Saturation, 2001). An oscillation is pushed at its best phase, by the mean of |cos|, more than twice a cycle.
Modes count one by one, random walks of states by three standard deviations.
"""

from collections.abc import Callable
from math import ceil, expm1, floor, log, pi
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.declaration import Process
from coldloop.process.lti_model import LtiModel, discretise
from coldloop.process.updating_periods import ROUNDING, SHORTEST_TICKS
from coldloop_optimizer_plc.qp.linear_algebra import Array

RESERVE: Final = 2.0
"""Disturbance that the inputs can reject over the largest one, a gain margin of 6 dB: plants are not linear."""
NOTHING: Final = 1e-12
"""Growth rate, 1/s, below which a mode counts as an integrator or a constant disturbance: the rest is rounding."""


class Waiting(NamedTuple):
    """Updating periods with which a PLC can hold a plant with an unstable mode."""

    growth: float
    """Growth rate of the fastest unstable mode, 1/s."""
    longest_s: float
    """Longest updating period that has the reserve."""
    limit_s: float
    """Longest updating period without the reserve; 0 if there is none."""

    def text(self, period_s: float, whose: str) -> str:
        """Return what a period means for this plant; `whose` says which period it is."""
        if not self.limit_s:
            return "its inputs cannot hold it within the span of the load, however short the updating period"
        end = f"an answer may be late by {2 * (self.longest_s - period_s):.2g} s"
        if period_s > self.longest_s:
            end = "no reserve is left" if period_s <= self.limit_s else "it cannot hold this plant"
        return (
            f"any step of the load is held with updating periods up to {self.longest_s:.3g} s (half of what the inputs "
            f"bring back is in reserve), none above {self.limit_s:.3g} s; {whose} is {period_s:.3g} s: {end}"
        )


def waiting(
    model: LtiModel, process: Process, limits: Array, share: Callable[[int], float] = lambda _: 1.0
) -> Waiting | None:
    """Return the updating periods that a plant needs; None where all its modes are stable.

    `limits` are low, high and rate of the inputs, shape (3, inputs); `share` is that of the rate after so many ticks.
    """
    values, left = np.linalg.eig(model.A.T)
    if not (modes := [(a, v) for a, v in zip(values, left.T, strict=True) if a.real > NOTHING and a.imag >= 0]):
        return None
    growth, tick_s = float(max(value.real for value, _ in modes)), process.tick_s
    reach = limits - [model.u0, model.u0, 0.0 * model.u0]

    def longest(reserve: float) -> float:
        held, lost = 0, floor(25.0 / (growth * tick_s)) + 2  # z grows by exp(50)
        while lost - held > 1:
            ticks = (held + lost) // 2
            now = reach * [[1.0], [1.0], [share(ticks)]]
            kept = all(_is_kept(model, process, now, mode, ticks * tick_s, reserve) for mode in modes)
            held, lost = (ticks, lost) if kept and _is_measured(model, process, ticks, reserve) else (held, ticks)
        return held * tick_s

    return Waiting(growth, longest(RESERVE), longest(1.0))


def _is_kept(
    model: LtiModel, process: Process, reach: Array, mode: tuple[Any, NDArray[Any]], period_s: float, reserve: float
) -> bool:  # fmt: skip
    """Return whether inputs bring back what two periods make of the worst step and of the walks, with a reserve."""
    (value, v), span = mode, np.array(process.load.span if process.has_load else (model.w0, model.w0)) - model.w0
    a, omega, b, f = value.real, value.imag, v @ model.B, v @ model.F
    grown, rate = expm1(2.0 * a * period_s), float(np.abs(b) @ reach[2])
    walks = v * [state.walk or 0.0 for state in process.states] / (process.tick_s * process.ticks_per_sample) ** 0.5
    walked = 3.0 * np.linalg.norm(walks) * (a * grown * (grown + 2.0) / 2.0) ** 0.5
    if omega:
        most = min(np.abs(b) @ np.abs(reach[:2]).min(axis=0), rate * pi / (2.0 * omega * period_s))
        step = abs(f) * (span[1] - span[0]) * (grown + 2.0) * a / abs(value)
        room = 2.0 / pi * (most - abs(f) * np.abs(span).max())
        return bool(reserve * period_s < pi / omega and reserve * (step + walked) < room)
    (down, up), (least, largest) = np.sort(b.real * reach[:2], axis=0).sum(axis=1), np.sort(f.real * span)
    unanswered = reserve * ((largest - least) * grown + walked)
    return all(
        load + unanswered < _pushed(before, most, rate, -expm1(-a * period_s))
        for before, load, most in ((least, largest, -down), (-largest, -least, up))
    )


def _pushed(before: float, most: float, rate: float, share: float) -> float:
    """Return the mean of a push from `before` to `most` by `rate` an update; the first has the `share`, others less."""
    steps = max(floor(min((most - before) / rate, 1e9)), 0) if rate else 0
    left = (1.0 - share) ** steps
    return before * (1.0 - left) + rate * ((1.0 - left) / share - steps * left) + most * left


def _is_measured(model: LtiModel, process: Process, ticks: int, reserve: float) -> bool:
    """Return whether outputs with a band stay in the range of their sensor until a step of the load is answered."""
    moved = model.C @ discretise(model.A, model.B, model.F, 2 * ticks * process.tick_s).F + model.G
    found = zip(model.y0, reserve * abs(moved) * np.ptp(process.load.span), process.outputs, strict=True)
    return all(move < min(one.range[1] - at, at - one.range[0]) for at, move, one in found if one.edges)


def leaves_its_band(model: LtiModel, process: Process) -> str:
    """Return which output leaves its band first, after the largest load step, within the horizon; empty: none."""
    move, x = max(process.load.span, key=lambda end: abs(end - model.w0)) - model.w0, np.zeros(len(model.A))
    for ticks in range(process.decision_instants[-1] * process.ticks_per_sample + 1 if process.has_load else 0):
        for value, at, one in zip(model.y0 + model.C @ x + model.G * move, model.y0, process.outputs, strict=True):
            if one.edges and one.edges[0] <= at <= one.edges[1] and not one.edges[0] <= value <= one.edges[1]:
                at_s = f"{ticks * process.tick_s:.3g} s"
                return f"; {one.name} leaves its band {at_s} after a load step of {move:g} {process.load.unit}".rstrip()
        x = model.A_tick @ x + model.F_tick * move
    return ""


def shortest_period_s(needed_s: float, tick_s: float) -> float:
    """Return the shortest updating period in which a PLC does what takes it so long, s."""
    return max(SHORTEST_TICKS, ceil(needed_s / tick_s * (1.0 - ROUNDING))) * tick_s


def digits_last_s(growth: float, real: type[np.floating]) -> float:
    """Return the horizon, s, beyond which a condensed problem, whose condition is about a growth's square, has none."""
    return float(-log(np.finfo(real).eps) / (2.0 * growth))
