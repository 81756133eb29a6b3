"""A refrigerator before its cool-down: everything at ambient temperature, and its helium in the buffer.

No compressor runs. The low-pressure line is at its set point and the bath, a vessel of vapour, with it; what is left of
the helium of the operating point is on the high-pressure side and in the buffer, at one pressure. The nitrogen bath is
empty.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from coldloop_plant.components.gas_volume import gas_mass
from coldloop_plant.components.phase_separator import SUPERHEAT, content
from coldloop_plant.helium.properties import Helium, saturation, vapour_enthalpy_and_cp
from coldloop_plant.numeric import RealArray
from coldloop_plant.refrigerator.physics import (
    BOX_STATES,
    STATE_NAMES,
    STATION,
    Refrigerator,
    high_pressure_mass,
    inventory,
)

COIL, M_LOST = STATE_NAMES.index("T_nef5"), STATE_NAMES.index("M_lost")
TRIALS: Final = 20


def warm_state(
    rest: Sequence[float], plant: Refrigerator, helium: Helium, *, ambient: float, low_pressure: float
) -> RealArray:
    """Return the state, shape (48,), of a warm refrigerator with as much helium as it holds at rest.

    Args:
        rest: State at the operating point, 48 numbers.
        plant: Parameters.
        helium: Tables.
        ambient: Temperature of everything but the high-pressure line, which has that of the cooler's gas, K.
        low_pressure: Of the low-pressure line and the bath, Pa.
    """
    station, bath = plant.station, plant.box.separator
    total = inventory(np.array(rest), plant, helium)
    saturated = saturation(low_pressure, helium)
    h, _ = vapour_enthalpy_and_cp(low_pressure, ambient, saturated.T, helium.vapour)
    x = np.zeros(len(STATE_NAMES))
    x[0], x[1] = low_pressure, (saturated.h_v - h) / SUPERHEAT * bath.volume
    x[STATE_NAMES.index("T_nef1_1") : BOX_STATES] = x[BOX_STATES : COIL + 1] = ambient
    lp_line = gas_mass(station.lp, low_pressure, ambient)
    elsewhere = total - lp_line - content(bath, x[0], x[1], helium).mass
    pressure = low_pressure
    for _ in range(TRIALS):  # masses are nearly in proportion to the pressure
        high = high_pressure_mass(x, pressure, ambient, plant, helium)
        pressure *= elsewhere / (high + gas_mass(station.buffer, pressure, ambient))
    x[STATION:M_LOST] = high, lp_line, elsewhere - high
    return x
