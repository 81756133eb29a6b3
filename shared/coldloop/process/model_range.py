"""Where the plant's model has left the range of its property tables: beyond it, properties are held or go on straight.

Balances still close there, but temperatures and flows are not to be believed.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop.process.cold_box import COLD_BOX, STATION_SIGNAL_NAMES, ModelRange

SATURATION_BAR: Final = (0.3, 2.25)
"""Pressures of bath and return, bar; helium's critical point is at 2.28 bar."""
SUPPLY_BAR: Final = (5.0, 19.0)
"""Pressures of the high-pressure side, where its properties are fitted, bar."""
WARMEST_CELL_K: Final = 310.0
"""Warmest cell of the exchangers, K: the tables end at 300 K, and up to 340 K helium is perfect within 3 mK and 0.2 %.
"""
WARMEST_BATH_M3: Final = -6.37
"""V_l of a dry bath that is at 310 K."""
COLD_BOX_BAR: Final = (16.0, 1.05)
"""Supply and return of a cold box alone; those of a plant file are within the same ranges."""
FIRST_CELL: Final = [state.name for state in COLD_BOX.states].index("T_nef1_1")
COLDEST_K, COLDEST_IN_TURBINE_K = 2.5, 5.3
COLDEST_CELLS_K: Final = np.array([COLDEST_K] * (len(COLD_BOX.states) - FIRST_CELL - 1) + [COLDEST_IN_TURBINE_K])
"""Shape (26,); the last is before the turbine, whose table of entropy ends at 6.1 kJ/kg: 5.3 K at 5 bar, 3.9 at 16."""
HP, LP = STATION_SIGNAL_NAMES.index("P12"), STATION_SIGNAL_NAMES.index("P11")


def model_range(x: NDArray[Any], supply: NDArray[Any] | float, suction: NDArray[Any] | float) -> NDArray[np.int32]:
    """Return the bits of `ModelRange` for states of the cold box, shape (..., 28), and pressures in bar."""
    cells, bath = x[..., FIRST_CELL:], 1e-5 * x[..., 0]
    outside = {
        ModelRange.BATH_PRESSURE: _outside(bath, SATURATION_BAR),
        ModelRange.SUPPLY_PRESSURE: _outside(supply, SUPPLY_BAR),
        ModelRange.RETURN_PRESSURE: _outside(suction, SATURATION_BAR),
        ModelRange.COLD_CELL: np.any(cells < COLDEST_CELLS_K, axis=-1),
        ModelRange.WARM_CELL: np.max(cells, axis=-1) > WARMEST_CELL_K,
        ModelRange.WARM_BATH: x[..., 1] < WARMEST_BATH_M3,
    }
    bits = np.zeros(bath.shape, np.int32)
    for bit, left in outside.items():
        bits |= np.where(left, np.int32(bit), np.int32(0))
    return bits


def present_model_range(x: NDArray[Any], supply: float, suction: float) -> int:
    """Return the same for one state, shape (28,): one that is inside, as in nearly all ticks, is known in 3 us."""
    pascals, liquid, *cells = x.tolist()
    inside = (
        SATURATION_BAR[0] <= 1e-5 * pascals <= SATURATION_BAR[1]
        and SUPPLY_BAR[0] <= supply <= SUPPLY_BAR[1]
        and SATURATION_BAR[0] <= suction <= SATURATION_BAR[1]
        and min(cells) >= COLDEST_K
        and cells[-1] >= COLDEST_IN_TURBINE_K
        and max(cells) <= WARMEST_CELL_K
        and liquid >= WARMEST_BATH_M3
    )
    return 0 if inside else int(model_range(x, supply, suction))


def recorded_model_range(x: NDArray[Any], station: NDArray[Any]) -> NDArray[np.int32]:
    """Return the same for recorded ticks: states (N, 28) and the station's columns, which a cold box alone has not."""
    if not station.size:
        return model_range(x, *COLD_BOX_BAR)
    return model_range(x, station[:, HP], station[:, LP])


def _outside(value: NDArray[Any] | float, ends: tuple[float, float]) -> NDArray[np.bool_]:
    low, high = ends
    return (np.asarray(value) < low) | (np.asarray(value) > high)
