"""The signals of the process that cross the link: names, units and order (paper, section IV)."""

from typing import Final

TICK_S: Final = 0.25
"""Length of a tick, the basic period tau_1 of the paper, in seconds of plant time."""

SAMPLING_PERIOD_S: Final = 5.0
"""Sampling period of the prediction model, in seconds of plant time."""

LAST_TICK: Final = 2**32 - 2**16 - 1
"""Last tick of a session, after 34 years: what is planned from there still fits a register."""

LAST_NUMBER: Final = LAST_TICK
"""Largest number of an update, or of a sequence."""

TICKS_PER_SAMPLE: Final = int(SAMPLING_PERIOD_S / TICK_S)

INPUT_NAMES: Final = ("CV155", "NCR22_A", "CV156")
INPUT_UNITS: Final = ("%", "W", "%")

OUTPUT_NAMES: Final = ("L1", "V1", *(f"T{i}" for i in range(1, 11)), *(f"P{i}" for i in range(1, 11)))
OUTPUT_UNITS: Final = ("%", "Hz", *("K" for _ in range(10)), *("bar" for _ in range(10)))

STATE_NAMES: Final = (
    "P1",
    "V_l",
    *(f"T_nef1_{i}" for i in range(1, 9)),
    *(f"T_nef2_{i}" for i in range(1, 7)),
    *(f"T_nef34_{i}" for i in range(1, 13)),
)
STATE_UNITS: Final = ("Pa", "m3", *("K" for _ in range(26)))

L1: Final = OUTPUT_NAMES.index("L1")
T1: Final = OUTPUT_NAMES.index("T1")
T2: Final = OUTPUT_NAMES.index("T2")
T5: Final = OUTPUT_NAMES.index("T5")

STATION_VALVE_NAMES: Final = ("CV956", "CV952", "CV953", "CV167")
"""Bypass, discharge into the buffer, charge out of it, nitrogen feed."""
STATION_SIGNAL_NAMES: Final = (
    "P11", "P12", "P13", "T11", "T13", "M12", "M_NC", "M_CV956", "M_CV952", "M_CV953", "M_out", "E_NC", "Q_NC",
    "L_N2", "CV167", "M_GN2", "helium", "lost", "T_ambient",
)  # fmt: skip
STATION_SIGNAL_UNITS: Final = (
    *["bar"] * 3, "K", "K", *["g/s"] * 6, "kW", "kW", "%", "%", "g/s", "kg", "kg", "K",
)  # fmt: skip
"""Of the compression station and the nitrogen pre-cooler, where the plant is the whole refrigerator.

P11, T11: low-pressure line; P12, M12: high-pressure line, and its flow to the cold box; P13: buffer; T13: cold end of
NEF6; M_NC, E_NC, Q_NC: compressors' flow, electrical power, heat to the surroundings; M_out: relief valves and leak;
L_N2, M_GN2: level and boil-off of the nitrogen bath; helium, lost: in the circuit, and gone from it.
"""
