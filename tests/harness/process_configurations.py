"""Configurations of runs of other processes than the cold box in one process."""

from collections.abc import Mapping
from typing import Final, NamedTuple

from coldloop.process.load_profile import LoadProfile
from tests.harness.configurations import PROGRAM

NOISE: Final = "plant.sensors.declared=1"


class Case(NamedTuple):
    """A run."""

    process: str
    assignments: tuple[str, ...] = ()
    load: str = "0:0.1,400:0.8,900:-0.9"
    events: frozenset[str] = frozenset()
    """Kinds of events that happen in the run."""
    ticks: int = 1200
    """Least number of ticks, out of 1500, that are compiled."""
    updates: float = 0.8
    """Least share of the updates that are compiled."""


ALARMS: Final = frozenset({"ALARM_RAISED", "ALARM_RETURNED"})
STEPS: Final = f"{PROGRAM}interrupting_load_step_w=0.01"
LONG: Final = f"{PROGRAM}updating_period_s=60"
CASES: Final[Mapping[str, Case]] = {
    "column": Case("column"),
    "column, noise, alarms": Case("column", (NOISE, "control_plc.alarms.bands.xD=[96.24,96.26]"), events=ALARMS),
    "column, load steps that interrupt": Case("column", (STEPS, LONG)),
    "column, single precision": Case("column", (f'{PROGRAM}arithmetic="float32"',)),
    "column, a borrowed solver": Case("column", (f'{PROGRAM}solver="osqp"', LONG), updates=0),
    "column, frozen sensors": Case("column", ("control_plc.sensors.frozen_s=24",), events=ALARMS | {"SENSOR"}),
    "small, noise": Case("small", (NOISE,), "0:0"),
    "large, alarms of several outputs": Case("large", events=ALARMS),
    "matrices": Case("matrices"),
    "matrices, noise, load steps that interrupt": Case("matrices", (NOISE, STEPS)),
    "matrices, state feedback": Case("matrices", (f'{PROGRAM}estimator.kind="state-feedback"',)),
    "foreseen": Case("foreseen", (f"{PROGRAM}updating_period_s=5",), updates=0),
    "lags, noise": Case("lags", (NOISE,)),
    "short samples": Case("short samples", ticks=1000),
    "a class": Case("tank", ticks=0, updates=0),
}


def load_of_shares(shares: str, mean: float, end: float) -> LoadProfile:
    """Return the load of `tick:share,...`: shares of the way from the mean load to the end of its span."""
    pairs = [pair.split(":") for pair in shares.split(",")]
    return LoadProfile(
        tuple(int(tick) for tick, _ in pairs), tuple(mean + float(part) * (end - mean) for _, part in pairs)
    )
