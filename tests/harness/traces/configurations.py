"""The configurations whose traces are on record."""

from collections.abc import Mapping
from typing import Final, NamedTuple

from tests.harness.configurations import COMPILED, LEFT_TO_PROGRAMS, NOISE, PROGRAM, REFRIGERATOR, SINGLE, UNUSUAL
from tests.harness.process_configurations import CASES
from tests.harness.process_configurations import NOISE as DECLARED_NOISE

COLD_BOX: Final = "cold box"
"""The process that programs have without a model file."""
LIVELY: Final = "lively"
"""Load that moves from the first minute on."""


class Configuration(NamedTuple):
    """A run of one process, as `OneProcessRig` does it."""

    assignments: tuple[str, ...] = ()
    load: str = LIVELY
    """`LIVELY`, a named load, or `tick:share,...`: shares of the way from the mean load to the end of its span."""
    ticks: int = 1000
    process: str = COLD_BOX
    """Name of a process file of `tests.harness.process_files`."""


STEPS: Final = "0:0.1,400:0.8,900:-0.9"
FURTHER: Final = {
    "twenty minutes": Configuration(load="2h", ticks=4800),
    "steps of 20 to 200 s": Configuration(load="c", ticks=2400),
    "pulses": Configuration(load="pulses", ticks=2400),
    "a quench": Configuration(load="quench", ticks=2400),
    "paper": Configuration((f'{PROGRAM}preset="paper"',), "d", 2400),
    "paper, noise": Configuration((f'{PROGRAM}preset="paper"', *NOISE)),
    "paper, interior point": Configuration(
        (f'{PROGRAM}preset="paper"', f'{PROGRAM}solver="interior-point"', f"{PROGRAM}updating_period_s=5")
    ),
    "single precision, interior point": Configuration((SINGLE, f'{PROGRAM}solver="interior-point"')),
    "single precision, hybrid": Configuration((SINGLE, f'{PROGRAM}solver="hybrid"', *NOISE)),
    "single precision, fast gradient": Configuration((SINGLE, f'{PROGRAM}solver="fast-gradient"')),
    "a load that is not measured": Configuration((f"{PROGRAM}estimator.load_known=false",)),
    "another cold box": Configuration(
        (
            "plant.mismatch.heat_transfer=0.9", "plant.mismatch.turbine_efficiency=0.95",
            "plant.mismatch.jt_valve=1.1", "plant.mismatch.turbine_valve=0.95",
        ),
    ),
    "late and weak inputs, a wrong gauge": Configuration(
        (
            "plant.mismatch.heater=0.95", "plant.mismatch.load=1.05", "plant.mismatch.level_gauge=1.02",
            "plant.mismatch.delay_ticks=3",
        ),
    ),
    "biased sensors": Configuration(
        (
            "plant.sensors.level_bias=0.2", "plant.sensors.temperature_bias=0.05", "plant.sensors.pressure_bias=0.01",
            "plant.sensors.pressure=0.002",
        ),
    ),
    "a refrigerator that begins warm": Configuration((REFRIGERATOR, 'plant.refrigerator.start="warm"'), ticks=2400),
    "a refrigerator on a warm day": Configuration(
        (
            REFRIGERATOR, "plant.refrigerator.ambient_k=305", "plant.refrigerator.daily_swing_k=10",
            "model.file=refrigerator",
        ),
    ),
    "tank, noise": Configuration((DECLARED_NOISE,), STEPS, 1200, "tank"),
    "tank, interior point": Configuration((f'{PROGRAM}solver="interior-point"',), STEPS, 1200, "tank"),
    "a step test": Configuration((DECLARED_NOISE,), STEPS, 1200, "record"),
    "an FMU": Configuration((DECLARED_NOISE,), STEPS, 1200, "fmu"),
}  # fmt: skip
"""Configurations that no comparison of the compiled loop with the programs covers."""


COMPARED_ONLY: Final = (
    "long sequences", "load steps that interrupt a rule", "not held at bounds", "sensors that freeze soon",
    "sequences that are refused, and load steps that interrupt", "column, load steps that interrupt",
    "matrices, state feedback",
)  # fmt: skip
"""Configurations whose parts others have as well: comparing the compiled loop with the programs is enough."""


def _all() -> Mapping[str, Configuration]:
    cold_box = COMPILED | LEFT_TO_PROGRAMS | UNUSUAL
    every = {
        **{name: Configuration(assignments) for name, assignments in cold_box.items()},
        **FURTHER,
        **{name: Configuration(case.assignments, case.load, 1200, case.process) for name, case in CASES.items()},
    }
    return {name: configuration for name, configuration in every.items() if name not in COMPARED_ONLY}


CONFIGURATIONS: Final = _all()
"""Configurations by name."""
