"""The cold box of the paper: the process of programs where nothing else is named. It is declared in a process file."""

from importlib.resources import files
from typing import Final

from coldloop.parsing import parsed_toml
from coldloop.process.declaration import Process

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
