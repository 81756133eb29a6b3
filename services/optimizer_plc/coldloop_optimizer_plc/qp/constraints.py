"""The rows of Gamma z <= gamma: bands of the outputs, which slacks widen, and rates of the inputs."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.limits import InputLimits
from coldloop_optimizer_plc.qp.condensing import Condensed, slack_map
from coldloop_optimizer_plc.qp.design import ControlDesign
from coldloop_optimizer_plc.qp.penalties import PenaltySettings

Array = NDArray[np.float64]


class OutputRows(NamedTuple):
    """Rows -y_j - s <= -low and y_j - s <= high at each constraint instant, output by output."""

    Gamma: Array
    """Shape (rows, n)."""
    bounds: Array
    """gamma at the operating point, shape (rows,)."""
    states: Array
    """How gamma depends on s = (x, w), shape (n_x + 1, rows)."""
    gains: Array
    """What the rows were multiplied by, shape (rows,): 1 for the output of the larger rho."""


class RateRows(NamedTuple):
    """Rows +-(u_b - u_a) <= (b - a) rate for each interval between decision instants, unless always true.

    The first interval starts at the input applied before the first knot.
    """

    Gamma: Array
    """Shape (rows, n)."""
    bounds: Array
    """gamma with no input before, shape (rows,)."""
    first: Array
    """1.0 for the rows of the first interval, shape (rows,)."""
    before: Array
    """How gamma depends on the input before, shape (inputs, rows)."""
    gains: Array
    """What the rows were multiplied by, shape (rows,)."""


def output_rows(condensed: Condensed, design: ControlDesign, weights: Array, y0: Array) -> OutputRows:
    """Return the rows of the bands; `weights` (N, knots) are those of the knots, `y0` the outputs at rest."""
    rho = np.array(design.violation_weight)
    rows, states, bounds, gains = [], [], [], []
    for instant in design.constraint_instants:
        slack_of_z = slack_map(weights[instant - 1], design)
        for output in range(len(rho)):
            y_z, y_s = condensed.outputs_z[instant - 1][output], condensed.outputs_s[instant - 1][output]
            margin = design.band_margin[output]
            low = design.output_low[output] + margin - y0[output]
            high = design.output_high[output] - margin - y0[output]
            rows += [-y_z - slack_of_z[2 * output], y_z - slack_of_z[2 * output + 1]]
            states += [y_s, -y_s]
            bounds += [-low, high]
            gains += 2 * [np.sqrt(rho[output] / rho.max())]
    gain = np.array(gains)
    return OutputRows(
        Gamma=np.array(rows) * gain[:, None],
        bounds=np.array(bounds) * gain,
        states=np.ascontiguousarray((np.array(states) * gain[:, None]).T),
        gains=gain,
    )


def rate_rows(design: ControlDesign, limits: InputLimits, penalties: PenaltySettings) -> RateRows:
    """Return the rows of the rates, scaled by what breaking them costs; there may be none."""
    ranges = np.asarray(limits.high) - np.asarray(limits.low)
    n_inputs = design.n_inputs
    size = (n_inputs + design.n_slacks) * len(design.decision_instants)
    gains_of_inputs = np.sqrt(penalties.rate_rows) / np.array(design.input_scale)
    rows, bounds, before, first, gained = [], [], [], [], []
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
                first.append(float(knot == 0))
                before.append(sign * np.eye(n_inputs)[i] * (knot == 0))
                gained.append(gains_of_inputs[i])
    gains = np.array(gained)
    return RateRows(
        Gamma=np.reshape(rows, (-1, size)) * gains[:, None],
        bounds=np.array(bounds) * gains,
        first=np.array(first),
        before=np.ascontiguousarray((np.reshape(before, (-1, n_inputs)) * gains[:, None]).T),
        gains=gains,
    )
