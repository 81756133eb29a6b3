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
