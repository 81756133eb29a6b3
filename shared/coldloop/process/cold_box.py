"""The cold box of the paper: the process of programs where nothing else is named. It is declared in a process file.

Beside it: signals of the compression station and the nitrogen pre-cooler of a refrigerator; bits of its model's range.
"""

from enum import IntFlag
from importlib.resources import files
from typing import Final

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
