"""The cold box of the paper as a process: what the programs are loaded with where nothing else is named."""

from typing import Final

from coldloop.process.declaration import Band, Bath, Input, Load, Loop, Output, Process, State

LEVEL_BAND: Final = (59.0, 61.0)
"""Band of L1, % (paper, section IV)."""
T5_BAND: Final = (9.0, 16.0)
"""Band of T5, K (paper, section IV)."""
DEAD_BAND: Final = 0.02
"""Of a band, over its width: 0.04 % and 0.14 K. L1 and T5 rest at an end of it where that is the optimum."""
LEVEL_LOOP: Final = Loop(input="NCR22_A", gain=-100.0, integral_time_s=300.0)
T5_LOOP: Final = Loop(input="CV156", gain=-5.0, integral_time_s=240.0)
"""How they were tuned is in `docs/science.md`."""

_VALVES: Final = (
    ("CV155", "cv155", "Opening of the Joule-Thomson valve", 0.5, 43.0),
    ("CV156", "cv156", "Opening of the turbine valve", 0.1, 36.0),
)
_JT_VALVE, _TURBINE_VALVE = (
    Input(
        name=name, unit="%", register=register, description=description, span=(0, 100), low=20.0, high=60.0,
        rate=rate, safe=safe, scale=10.0, weight=1e-2, walk=0.05,
    )
    for name, register, description, rate, safe in _VALVES
)  # fmt: skip
_HEATER: Final = Input(
    name="NCR22_A", unit="W", register="ncr22", description="Actuator part of the bath heater's power",
    span=(0, 1000), low=0.0, high=150.0, rate=10.0, safe=75.0, scale=50.0, weight=4e-4, walk=0.5,
    has_constant=False, bar=(-10.0, 160.0),
)  # fmt: skip


_HEAT_LOAD: Final = Load(
    name="NCR22_HL", unit="W", span=(0, 10_000.0), walk=3.0, noun="Heat load", word="heat load", bar=(200.0, 600.0),
    has_named_loads=True,
)  # fmt: skip
_BANDED: Final = {
    name: (
        Band(
            low=low, high=high, weight=100.0, dead_band=DEAD_BAND * (high - low), alarm_word=alarm_word, loop=loop
        ),
        bar,
    )
    for name, (low, high), alarm_word, loop, bar in (
        ("L1", LEVEL_BAND, "level band", LEVEL_LOOP, (56.0, 64.0)),
        ("T5", T5_BAND, "t5 band", T5_LOOP, (6.0, 20.0)),
    )
}  # fmt: skip


def _output(name: str, unit: str, quantity: str) -> Output:
    band, bar = _BANDED.get(name, (None, None))
    return Output(name=name, unit=unit, quantity=quantity, band=band, bar=bar)


_TEMPERATURES: Final = tuple(
    State(name=f"T_{exchanger}_{i}", unit="K")
    for exchanger, cells in (("nef1", 8), ("nef2", 6), ("nef34", 12))
    for i in range(1, cells + 1)
)

COLD_BOX: Final = Process(
    name="cold-box",
    tick_s=0.25,
    ticks_per_sample=20,
    inputs=(_JT_VALVE, _HEATER, _TURBINE_VALVE),
    outputs=(
        _output("L1", "%", "level"),
        _output("V1", "Hz", "speed"),
        *(_output(f"T{i}", "K", "temperature") for i in range(1, 11)),
        *(_output(f"P{i}", "bar", "pressure") for i in range(1, 11)),
    ),
    states=(
        State(name="P1", unit="Pa"),
        State(name="V_l", unit="m3"),
        *_TEMPERATURES,
    ),
    load=_HEAT_LOAD,
    constants=("V1", *(f"T{i}" for i in range(1, 11)), *(f"P{i}" for i in range(1, 11))),
    decision_instants=(1, 2, 4, 8, 16, 50, 100),
    constraint_instants=(1, 2, 3, 4, 6, 8, 16, 24, 32, 48, 60, 72, 84, 100),
    bath=Bath(
        level="L1",
        temperature="T1",
        feed="CV155",
        feed_temperature="T2",
        heater="NCR22_A",
        turbine_valve="CV156",
        turbine_outlet="T5",
        turbine_speed="V1",
        turbine_pressures=("P6", "P5"),
        pressure_state="P1",
        level_state="V_l",
        temperature_states=tuple(state.name for state in _TEMPERATURES),
        holdable_load=(128.0, 515.0),
        load_reserve=20.0,
        least_load_error=25.0,
    ),
    moves_as_one=True,
    tuned={
        "estimator": {"disturbances": ("outputs",), "load_walk_w": 1.0},
        "unmeasured": {"load_walk_w": 10.0},
        "adaptive": {"rule": "contraction"},
        "cold_end": {"approach_k": 0.3},
        "design": {"band_margin": (0.1, 0.3)},
        "plausibility": {"sigmas": 6.0},
    },
    plants=("cold-box", "refrigerator"),
    shipped_mimic="static/mimic.svg",
    decimals={"%": 2, "K": 3, "bar": 3, "W": 1, "Hz": 1},
    notable={"W": 2.0, "%": 0.2, "Hz": 5.0, "K": 0.05, "bar": 0.005},
)

L1, V1, T1, T2, T5, P1 = map([output.name for output in COLD_BOX.outputs].index, ("L1", "V1", "T1", "T2", "T5", "P1"))
"""Places of its outputs: for its plants, its studies and its tests, as what follows. Services ask the process."""

TICK_S: Final = COLD_BOX.tick_s
TICKS_PER_SAMPLE: Final = COLD_BOX.ticks_per_sample
SAMPLING_PERIOD_S: Final = COLD_BOX.sampling_period_s
INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES = COLD_BOX.input_names, COLD_BOX.output_names, COLD_BOX.state_names
INPUT_UNITS, OUTPUT_UNITS, STATE_UNITS = COLD_BOX.input_units, COLD_BOX.output_units, COLD_BOX.state_units
CONTROLLED: Final = COLD_BOX.controlled
