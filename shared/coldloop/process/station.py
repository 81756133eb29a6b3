"""Signals of the compression station and of the nitrogen pre-cooler of a refrigerator; bits of its model's range."""

from enum import IntFlag
from typing import Final

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
