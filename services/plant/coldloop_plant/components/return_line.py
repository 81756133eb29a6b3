"""Low-pressure return: two flow resistances in series, with the turbine's exhaust joining between them."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined
from coldloop_plant.numeric import at_least

LAMINAR = 2.5e4  # Pa s/kg, half of the slope of the pressure drop at rest; an exhaust of 22 g/s makes as much


class ReturnLine(NamedTuple):
    """The way of the vapour from the bath to the compressor."""

    cold_resistance: float
    """From the bath to the mixing point, Pa s2/kg2."""
    warm_resistance: float
    """From the mixing point to the compressor, Pa s2/kg2."""


@inlined
def return_flow(
    line: ReturnLine, P_bath: float, P_suction: float, joining_flow: float, thinness: float
) -> tuple[float, float]:
    """Return the mass flow of the vapour (kg/s) and the pressure at the mixing point (Pa).

    The flow m_v solves P_bath - P_suction = r_c m_v^2 + r_w (m_v + m_t)^2; nothing flows back into the bath. Where no
    exhaust joins, a laminar part keeps the flow's slope finite near rest. `thinness` is by how much the
    vapour is thinner than saturated vapour: its pressure drop grows in proportion. That of a dry bath is, by more than
    1; what carries liquid along is denser.
    """
    total = thinness * line.cold_resistance + line.warm_resistance
    half_slope = at_least(line.warm_resistance * joining_flow, LAMINAR) + (thinness - 1.0) * LAMINAR
    rest = at_least(P_bath - P_suction - line.warm_resistance * joining_flow * joining_flow, 0.0)
    vapour_flow = at_least(np.sqrt(half_slope * half_slope + total * rest) - half_slope, 0.0) / total
    sum_flow = vapour_flow + joining_flow
    return vapour_flow, P_suction + line.warm_resistance * sum_flow * sum_flow
