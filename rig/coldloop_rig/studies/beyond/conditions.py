"""Plants that are not as their model, and sensors that are not as their plant: the conditions of `robustness`."""

from typing import Final

from coldloop_rig.studies.study import NOISE, PROGRAM, noise

MISMATCH: Final = "plant.mismatch."
OFF: Final = (0.8, 0.9, 1.1, 1.2)
PARAMETERS: Final = {
    "UA": ("heat_transfer",),
    "turbine efficiency": ("turbine_efficiency",),
    "valves": ("jt_valve", "turbine_valve"),
}
NOMINAL: Final = "as its model"
ESTIMATED: Final = "load estimated"
CONDITIONS: Final = {
    NOMINAL: (),
    **{
        f"{name} {100 * (factor - 1):+.0f} %": tuple(f"{MISMATCH}{key}={factor}" for key in keys)
        for name, keys in PARAMETERS.items() for factor in OFF
    },
    "sensor noise": NOISE,
    "sensor noise doubled": noise(2.0),
    "sensor bias": (
        "plant.sensors.level_bias=0.2", "plant.sensors.temperature_bias=0.2", "plant.sensors.pressure_bias=0.005",
    ),
    ESTIMATED: (f"{PROGRAM}estimator.load_known=false",),
}  # fmt: skip
"""What differs from what the controller believes. Bias: 0.2 % of level, 0.2 K, 5 mbar."""
_OTHERS: Final = {"heater": ("heater", 0.2), "load as announced": ("load", 0.05), "level gauge": ("level_gauge", 0.01)}
BESIDE_THE_BOX: Final = {
    **{
        f"{name} {100 * part:+.0f} %": (f"{MISMATCH}{key}={1 + part}",)
        for name, (key, size) in _OTHERS.items() for part in (-size, size)
    },
    **{f"delay of {ticks} ticks": (f"{MISMATCH}delay_ticks={ticks}",) for ticks in (1, 2)},
}  # fmt: skip
"""The same of heater, load, gauge and actuators, for which no loop is compiled."""
_LOADS: Final = {
    ESTIMATED: CONDITIONS[ESTIMATED], "load 5 % above its measurement": BESIDE_THE_BOX["load as announced +5 %"],
}  # fmt: skip
_PLANTS: Final = (*(f"{name} {sign}10 %" for name in PARAMETERS for sign in "-+"), "sensor bias")
UNKNOWN_LOADS: Final = {
    f"{plant}, {load}, noise": (*CONDITIONS[plant], *changes, *NOISE)
    for plant in _PLANTS for load, changes in _LOADS.items()
}  # fmt: skip
"""A plant that is off and a load that is not known, with noise: what each of them does alone stands above."""
LINEAR: Final = {
    "linear plant": (), "linear plant, sensor noise": NOISE, "linear plant, sensor bias": CONDITIONS["sensor bias"],
}  # fmt: skip
"""Controls: the model itself in the place of the plant."""
LEFT_OUT: Final = (
    "Sensors that fail are not tried; of several errors at once a plant that is off with a load that is not known. "
    "The load of the cold box is never forecast. "
    "Costs and bands are of true values under bias, and of measured ones, which are noisy, under noise. "
    f"Under '{ESTIMATED}' no period can be interrupted: rules run without."
)
