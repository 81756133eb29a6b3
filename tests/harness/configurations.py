"""Configurations of runs of the cold box in one process: what the compiled loop and the programs are compared with."""

from typing import Final

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.load_profile import LoadProfile
from coldloop_plant.load import find_load

PROGRAM: Final = "optimizer_plc.program."
NOISE: Final = ("plant.sensors.level=0.02", "plant.sensors.speed=0.5", "plant.sensors.temperature=0.02")
SUSPECTS: Final = tuple(
    f"{PROGRAM}plausibility.{each}"
    for each in ("sigmas=1.5", "settled_s=5", "agreeing_s=5", "longest_s=9", "spike_s=0")
)
REFRIGERATOR: Final = "plant.kind=refrigerator"
SINGLE: Final = f'{PROGRAM}arithmetic="float32"'
TRIP: Final = (
    'plant.refrigerator.events=[{at_s=90, target="nc1", value=0}, {at_s=120, target="nc1", value=1}, '
    '{at_s=30, target="cv155", value=0}, {at_s=45, target="heater", value=2}, {at_s=60, target="heater", value=1}, '
    '{at_s=65, target="turbine", value=0}, {at_s=75, target="turbine", value=1}, {at_s=80, target="cv155", value=1}, '
    '{at_s=85, target="blocked_nef2", value=5.0}, {at_s=150.25, target="leak", value=2.0}]'
)
COMPILED: Final[dict[str, tuple[str, ...]]] = {
    "adaptive": (),
    "fixed": (f"{PROGRAM}updating_period_s=2.5",),
    "contraction": (f'{PROGRAM}adaptive.rule="contraction"',),
    "noise": NOISE,
    "state-feedback": (f'{PROGRAM}estimator.kind="state-feedback"',),
    "rates that count elapsed time": ('limits.rate_reference="elapsed"',),
    "long sequences": (f"{PROGRAM}sequence_ticks=240",),
    "a fast PLC": (f"{PROGRAM}budget.power=10",),
    "interior point": (f'{PROGRAM}solver="interior-point"', f"{PROGRAM}updating_period_s=5"),
    "interior point, cut off": (f'{PROGRAM}solver="interior-point"', f'{PROGRAM}adaptive.rule="contraction"'),
    "hybrid": (f'{PROGRAM}solver="hybrid"', f"{PROGRAM}updating_period_s=1.5"),
    "fast gradient": (f'{PROGRAM}solver="fast-gradient"',),
    "loads that cannot be held": (
        f"{PROGRAM}holdable_load_w=[330,345]",
        "control_plc.alarms.rules.capacity.on_delay_s=2",
    ),
    "suspects": (*SUSPECTS, *NOISE),
    "suspects in single precision": (SINGLE, *SUSPECTS, *NOISE),
    "load steps that interrupt": (f"{PROGRAM}updating_period_s=5", f"{PROGRAM}interrupting_load_step_w=10"),
    "load steps that interrupt a rule": (
        f'{PROGRAM}adaptive.rule="contraction"',
        f"{PROGRAM}interrupting_load_step_w=10",
        f'{PROGRAM}solver="hybrid"',
    ),
    "refrigerator": (REFRIGERATOR, TRIP, "plant.station.noise_bar=0.005", *NOISE),
    "refrigerator with PI and a model of its own": (
        REFRIGERATOR,
        "plant.station.control=pi",
        "model.file=refrigerator",
        f"{PROGRAM}updating_period_s=2.5",
    ),
    "as printed": (f'{PROGRAM}preset="as-printed"',),
    "as printed, interior point": (f'{PROGRAM}preset="as-printed"', f'{PROGRAM}solver="interior-point"'),
    "soft rows": (f"{PROGRAM}penalties.output_rows=1", f"{PROGRAM}penalties.rate_rows=[1, 2, 3]"),
    "a box penalty alone": (f"{PROGRAM}penalties.box=2",),
    "first knot as rows": (f"{PROGRAM}penalties.first_knot_in_box=false",),
    "no look-ahead rows": (f"{PROGRAM}ode.look_ahead_rows=false",),
    "not held at bounds": (f"{PROGRAM}ode.hold_at_bounds=false",),
    "single precision": (SINGLE,),
    "single precision, fixed": (SINGLE, f"{PROGRAM}updating_period_s=2.5", *NOISE),
}
"""Configurations whose updates are compiled too."""
LEFT_TO_PROGRAMS: Final[dict[str, tuple[str, ...]]] = {
    "osqp": (f'{PROGRAM}solver="osqp"', f"{PROGRAM}updating_period_s=5"),
    "daqp": (f'{PROGRAM}solver="daqp"', *NOISE),
    "qpoases": (f'{PROGRAM}solver="qpoases"',),
    "qpoases and a refrigerator": (f'{PROGRAM}solver="qpoases"', REFRIGERATOR),
}
"""Configurations of which only the ticks are compiled, where that is worth while."""
UNUSUAL: Final[dict[str, tuple[str, ...]]] = {
    "narrow alarm bands": ("control_plc.alarms.bands.L1=[59.9,60.1]", "control_plc.alarms.bands.T5=[12,13]"),
    "sensors out of range": ("control_plc.sensors.level=[59.9,60.1]",),
    "sensors that freeze soon": ("control_plc.sensors.frozen_s=0.5",),
    "sequences that are refused": ("limits.slew_s=4",),
    "sequences that are refused, and load steps that interrupt": (
        "limits.slew_s=4",
        f"{PROGRAM}interrupting_load_step_w=10",
    ),
    "an impatient watchdog": ("control_plc.ladder.optimizer_timeout_s=2",),
    "the classical loops": ('control_plc.driver="classical"',),
}
"""Configurations that fall back to the programs in some of the ticks, or in all of them."""


def lively(mean_load: float) -> LoadProfile:
    """Return a load that moves from the first minute on, about the load of the operating point, W."""
    e = find_load("e", mean_load, COLD_BOX)
    return LoadProfile((0, *(time - e.times[1] + 60 for time in e.times[1:])), e.watts)
