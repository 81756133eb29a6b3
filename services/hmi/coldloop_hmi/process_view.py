"""What the page shows of its process: its signals, and from where to where their bars go."""

import math
from typing import Any, Final

from coldloop.process.declaration import Process
from coldloop.process.sections import Output, Range

BESIDE_BAND: Final = 1.5
"""What a bar shows beside a band, on each side, over the width of the band."""
BESIDE_BOUNDS: Final = 0.125
"""The same of the bounds of an input."""
READABLE: Final = 1e-3
"""Share of a range that is worth a digit."""


def process_document(process: Process) -> dict[str, Any]:
    """Return the process as the page is told: bars of signals with their ends, words and unit of the load, if any."""
    load = process.load
    shown = {"word": load.title, "unit": load.unit, "span": load.span, "bar": load.bar or load.span}
    return {
        "name": process.name,
        "mimic": process.shipped_mimic or ("mimic.svg" if process.drawing else None),
        "sample_s": process.sampling_period_s,
        "inputs": [
            {"name": one.name, "label": one.name[: len(one.tag)], "register": one.tag, "unit": one.unit,
             "bounds": [one.low, one.high], "bar": one.bar or _widened(one.low, one.high, BESIDE_BOUNDS)}
            for one in process.inputs
        ],
        "controlled": [_output(one) for one in process.banded],
        "measured": [_output(one) for one in process.outputs if one.edges is None and not one.quantity],
        "load": shown if process.has_load else None,
        "disturbances": [_output(one) for one in process.measured_disturbances],
    }  # fmt: skip


def _output(one: Output) -> dict[str, Any]:
    band = one.kept
    loop = band.loop.input if band and band.loop else None
    dead_band = band.dead_band if band else 0.0
    bar = one.bar or _output_bar(one)
    return {"name": one.name, "unit": one.unit, "bar": bar, "loop": loop, "dead_band": dead_band}


def _output_bar(one: Output) -> Range:
    """Return the ends of the bar of an output: about its band within the range of its sensor, or that range."""
    if one.edges is None:
        return one.range
    low, high = _widened(*one.edges, BESIDE_BAND)
    return max(low, one.range[0]), min(high, one.range[1])


def _widened(low: float, high: float, share: float) -> Range:
    return low - share * (high - low), high + share * (high - low)


def decimals_by_unit(process: Process) -> dict[str, int]:
    """Return how many digits after the point values with the units of the process are shown with.

    The last digit is the noise of an output, and a tenth of the largest move of an input in a sampling period.
    """
    low, high = process.load.span
    steps = [(process.load.unit, READABLE * (high - low)), *((one.unit, one.rate / 10) for one in process.inputs)]
    steps += [(one.unit, one.noise) for one in process.outputs]
    found: dict[str, int] = {}
    for unit, step in steps:
        if unit not in process.decimals:
            found[unit] = max(found.get(unit, 0), math.ceil(-math.log10(step)))
    return found | dict(process.decimals)
