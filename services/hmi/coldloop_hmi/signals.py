"""The signals of the page and their quality, derived from the register declarations: a new one appears by itself.

A signal is a register of a block with one row; its name is `service.block.register`, such as `plant.measurement.y.T5`.
"""

import math
from collections.abc import Iterable, Mapping
from enum import StrEnum
from functools import cache, lru_cache
from typing import Any, Final, NamedTuple

from coldloop.process.declaration import Process
from coldloop.process.sections import Output, Range
from coldloop.registers.codec import from_words
from coldloop.registers.declaration import Block, Kind, RegisterMap

BESIDE_BAND: Final = 1.5
"""Margin of a bar beside a band, on each side, over the width of the band."""
BESIDE_BOUNDS: Final = 0.125
"""The same of the bounds of an input."""
READABLE: Final = 1e-3
"""Share of a range that is worth a digit."""
DECIMALS: Final = {
    "%": 2, "K": 3, "bar": 3, "W": 1, "s": 3, "ms": 2, "ppm": 1, "Pa": 0, "m3": 5, "g/s": 2, "kg": 2, "kW": 1,
}  # fmt: skip
"""Digits after the point: of PLCs, links, states and a refrigerator's station. Those of the process come first."""
DIGITS: Final = 7
TICKS: Final = {"Tick": "time", "Ticks": "ticks"}
"""Quantity that a register counts, by the first word of its description."""
RAW = ("plant.measurement.y.", "control_plc.update.y.")  # have a bad reading as it is; elsewhere it is replaced
STATES = ("plant.measurement.x.", "control_plc.update.x.")  # are of the simulation: no sensor measures them


def process_document(process: Process) -> dict[str, Any]:
    """Return the process as the page gets it: bars of signals with their ends, words and unit of the load, if any."""
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
    bar = one.bar or one.range
    if one.edges is not None and one.bar is None:  # about its band, within the range of its sensor
        low, high = _widened(*one.edges, BESIDE_BAND)
        bar = max(low, one.range[0]), min(high, one.range[1])
    return {"name": one.name, "unit": one.unit, "bar": bar, "loop": loop, "dead_band": dead_band}


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


class Signal(NamedTuple):
    """One value that the page can show."""

    name: str
    block: str
    label: str
    unit: str
    decimals: int | None
    """Digits after the point; None for whole numbers, and for those with `digits`."""
    digits: int | None
    """Significant digits of a number that has no unit, or one without a scale."""
    counts: str
    """`time` of a tick, `ticks` of a number of ticks: shown as plant time; empty for other signals."""
    words: dict[int, str]
    """Meaning of the numbers of an enumeration; empty for other signals."""
    description: str
    address: int
    writer: str


def shown_blocks(register_map: RegisterMap) -> list[Block]:
    """Return the blocks that the page shows value by value: those with one row that mean something."""
    return [block for block in register_map.shown if block.rows == 1]


def _texts(block: Block) -> set[str]:
    return {name for name, field in block.fields.items() if field.is_text}


@cache
def signals_of(register_map: RegisterMap) -> tuple[Signal, ...]:
    """Return the signals of a service, in the order of their registers."""
    found: list[Signal] = []
    digits_of = DECIMALS | decimals_by_unit(register_map.process)
    for block in shown_blocks(register_map):
        texts, seen = _texts(block), set[str]()
        for register in block.registers():
            field = register.name.partition(".")[0]
            label = field if field in texts else register.name
            if label in seen:
                continue
            seen.add(label)
            floating = register.kind is Kind.F32
            has_scale = register.unit or label.startswith(("u.", "y."))  # others may be of any size
            decimals = digits_of.get(register.unit) if floating and has_scale else None
            found.append(
                Signal(
                    name=f"{register_map.service}.{block.name}.{label}", block=block.name, label=label,
                    unit=register.unit, decimals=decimals, digits=DIGITS if floating and decimals is None else None,
                    counts=TICKS.get(register.description.partition(" ")[0], ""),
                    words={one.value: one.text for one in register.meanings}, description=register.description,
                    address=register.address, writer=register.writer.value if register.writer else "",
                )
            )  # fmt: skip
    return tuple(found)


def values_of(service: str, block: Block, record: tuple[Any, ...]) -> dict[str, float | int | str]:
    """Return the values of a record by the names of their signals; texts are decoded."""
    values: dict[str, float | int | str] = {}
    texts = _texts(block)
    prefix = f"{service}.{block.name}."
    for (name, field), value in zip(block.fields.items(), record, strict=True):
        if name in texts:
            values[prefix + name] = from_words(value)
        elif field.elements:
            before = prefix if field.each else f"{prefix}{name}."
            values.update((before + element, one) for element, one in zip(field.elements, value, strict=True))
        else:
            values[prefix + name] = value
    return values


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


SOUND = Doubts()


@lru_cache(256)  # those of successive samples are the same
def doubted(doubts: Doubts, process: Process) -> dict[str, Quality]:
    """Return the outputs in doubt, and the worst quality of each."""
    every = zip((Quality.SUSPECT, Quality.HELD, Quality.BAD, Quality.SIMULATED), doubts, strict=True)
    return {name: quality for quality, bits in every for i, name in enumerate(process.output_names) if bits >> i & 1}


def qualities(doubts: Doubts, stale: Iterable[str], process: Process) -> Mapping[str, Quality]:
    """Return the quality of all signals that are not good, by name; a name that ends with a dot is a beginning.

    `stale` names what is not current.
    """
    found = [(name, Quality.STALE) for name in stale]
    for name, quality in doubted(doubts, process).items():
        found.append((f"control_plc.process.y.{name}", quality))
        found += [(f"{raw}{name}", Quality.BAD if quality is Quality.HELD else quality) for raw in RAW]
    found += [(name, Quality.SIMULATED) for name in STATES]
    return dict(sorted(found, key=lambda one: list(Quality).index(one[1])))
