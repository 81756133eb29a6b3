"""The cold box of the paper: the process of programs where nothing else is named. It is declared in a process file.

Beside it: signals of the compression station and the nitrogen pre-cooler of a refrigerator; bits of its model's range.
"""

from enum import IntFlag
from importlib.resources import files
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop.process.declaration import Process
from coldloop.text import parsed_toml

COLD_BOX: Final = Process.model_validate(
    parsed_toml((files("coldloop.process") / "data" / "cold_box.toml").read_text(encoding="utf-8"))
)

L1, V1, T1, T2, T5, P1 = map(COLD_BOX.output_names.index, ("L1", "V1", "T1", "T2", "T5", "P1"))
"""Places of its outputs: for its plants, its studies and its tests, as what follows. Services ask the process."""

TICK_S: Final = COLD_BOX.tick_s
TICKS_PER_SAMPLE: Final = COLD_BOX.ticks_per_sample
SAMPLING_PERIOD_S: Final = COLD_BOX.sampling_period_s
INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES = COLD_BOX.input_names, COLD_BOX.output_names, COLD_BOX.state_names
INPUT_UNITS, OUTPUT_UNITS, STATE_UNITS = COLD_BOX.input_units, COLD_BOX.output_units, COLD_BOX.state_units
LEVEL_LOOP, T5_LOOP = (output.loop for output in COLD_BOX.outputs if output.loop is not None)
LEVEL_BAND, T5_BAND = ((band.low, band.high) for band in COLD_BOX.bands)
"""Bands of L1 (%) and T5 (K) (paper, section IV)."""

STATION_VALVE_NAMES: Final = ("CV956", "CV952", "CV953", "CV167")
"""Bypass, discharge into the buffer, charge out of it, nitrogen feed."""
STATION_SIGNAL_NAMES: Final = (
    "P11", "P12", "P13", "T11", "T13", "M12", "M_NC", "M_CV956", "M_CV952", "M_CV953", "M_out", "E_NC", "Q_NC",
    "L_N2", "CV167", "M_GN2", "helium", "lost", "T_ambient",
)  # fmt: skip
STATION_SIGNAL_UNITS: Final = (
    *["bar"] * 3, "K", "K", *["g/s"] * 6, "kW", "kW", "%", "%", "g/s", "kg", "kg", "K",
)  # fmt: skip
"""Units of the signals of compression station and nitrogen pre-cooler, where the plant is the whole refrigerator.

P11, T11: low-pressure line; P12, M12: high-pressure line, and its flow to the cold box; P13: buffer; T13: cold end of
NEF6; M_NC, E_NC, Q_NC: compressors' flow, electrical power, heat to the surroundings; M_out: relief valves and leak;
L_N2, M_GN2: level and boil-off of the nitrogen bath; helium, lost: in the circuit, and gone from it.
"""


class ModelRange(IntFlag):
    """Parts of the simulation outside its property tables, one bit each."""

    BATH_PRESSURE = 1
    SUPPLY_PRESSURE = 2
    RETURN_PRESSURE = 4
    COLD_CELL = 8
    WARM_CELL = 16
    WARM_BATH = 32


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
