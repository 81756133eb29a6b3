"""The quality of each value that is shown: one word, the worst that applies, in page, trends, CSV and API."""

from collections.abc import Iterable, Mapping
from enum import StrEnum
from functools import cache, lru_cache
from typing import NamedTuple

from coldloop.process.declaration import Process
from coldloop.registers.maps import maps_of
from coldloop_hmi.signals import signals_of


class Quality(StrEnum):
    """Quality of a value, from the best to the worst."""

    GOOD = "good"
    SUSPECT = "suspect"
    """The optimiser does without it: prediction and other readings contradict it."""
    HELD = "held"
    """The last good value in the place of a bad one."""
    BAD = "bad"
    """Its sensor is bad, by the fail-safe ladder."""
    STALE = "stale"
    """Its source is silent, or does not move."""
    SIMULATED = "simulated"
    """Not measured: a state of the simulation, or a fault that was put into the sensor for training."""


class Doubts(NamedTuple):
    """Outputs whose readings are in doubt; bit i is output i."""

    suspect: int = 0
    held: int = 0
    bad: int = 0
    simulated: int = 0

    def named(self, process: Process) -> dict[str, Quality]:
        """Return the outputs in doubt, and the worst quality of each."""
        return _named(self, process)


_DOUBTED = (Quality.SUSPECT, Quality.HELD, Quality.BAD, Quality.SIMULATED)
SOUND = Doubts()


@lru_cache(256)  # those of successive samples are the same
def _named(doubts: Doubts, process: Process) -> dict[str, Quality]:
    every = zip(_DOUBTED, doubts, strict=True)
    return {name: quality for quality, bits in every for i, name in enumerate(process.output_names) if bits >> i & 1}


RAW = ("plant.measurement.y.", "control_plc.update.y.")  # have a bad reading as it is; elsewhere it is replaced


@cache
def _simulated(process: Process) -> frozenset[str]:
    signals = (one for each in maps_of(process) for one in signals_of(each))
    return frozenset(f"{one.name.rpartition('.')[0]}." for one in signals if "Simulated" in one.description)


def qualities(doubts: Doubts, stale: Iterable[str], process: Process) -> Mapping[str, Quality]:
    """Return the quality of all signals that are not good, by name; a name that ends with a dot is a beginning.

    Args:
        doubts: Of the outputs.
        stale: Names of what is not current.
        process: Of which they are.
    """
    found = [(name, Quality.STALE) for name in stale]
    for name, quality in doubts.named(process).items():
        found.append((f"control_plc.process.y.{name}", quality))
        found += [(f"{raw}{name}", Quality.BAD if quality is Quality.HELD else quality) for raw in RAW]
    found += [(name, Quality.SIMULATED) for name in _simulated(process)]
    return dict(sorted(found, key=lambda one: list(Quality).index(one[1])))
