"""The signals of the process that cross the link: names, units and order (paper, section IV)."""

from typing import Final

TICK_S: Final = 0.25
"""Length of a tick, the basic period tau_1 of the paper, in seconds of plant time."""

SAMPLING_PERIOD_S: Final = 5.0
"""Sampling period of the prediction model, in seconds of plant time."""

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
T5: Final = OUTPUT_NAMES.index("T5")
