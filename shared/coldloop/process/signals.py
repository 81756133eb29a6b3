"""The signals of the process that cross the link: names, units and order; and its time (paper, section IV)."""

from typing import Final

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.loaded import PROCESS

TICK_S: Final = PROCESS.tick_s
"""Length of a tick, the basic period tau_1 of the paper, in seconds of plant time."""

STRETCH: Final = TICK_S / COLD_BOX.tick_s
"""How much longer a tick is than the cold box's: as much longer are the defaults of times in the process."""

TICK_UNIT: Final = f"{TICK_S:g} s"

TICKS_PER_SAMPLE: Final = PROCESS.ticks_per_sample

SAMPLING_PERIOD_S: Final = TICKS_PER_SAMPLE * TICK_S
"""Sampling period of the prediction model, in seconds of plant time."""

LAST_TICK: Final = 2**32 - 2**16 - 1
"""Last tick of a session, after 34 years: what is planned from there still fits a register."""

LAST_NUMBER: Final = LAST_TICK
"""Largest number of an update, or of a sequence."""

INPUT_NAMES: Final = tuple(one.name for one in PROCESS.inputs)
INPUT_UNITS: Final = tuple(one.unit for one in PROCESS.inputs)

OUTPUT_NAMES: Final = tuple(one.name for one in PROCESS.outputs)
OUTPUT_UNITS: Final = tuple(one.unit for one in PROCESS.outputs)

STATE_NAMES: Final = tuple(one.name for one in PROCESS.states)
STATE_UNITS: Final = tuple(one.unit for one in PROCESS.states)

CONTROLLED: Final = tuple(OUTPUT_NAMES.index(one.name) for one in PROCESS.banded)
"""Outputs that have a band: L1 and T5 of the cold box."""
BATH: Final = PROCESS.bath
"""Which of the signals are those of a bath with a cold end; None where there is none."""

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
