"""The signals of the page, derived from the register declarations: a new register or alarm appears by itself.

A signal is a register of a block with one row; its name is `service.block.register`, such as `plant.measurement.y.T5`.
"""

import re
from functools import cache
from typing import Any, Final, NamedTuple

from coldloop.registers.declaration import Block, Kind, RegisterMap
from coldloop.registers.text import from_words
from coldloop_hmi.process_view import decimals_by_unit

DECIMALS: Final = {
    "%": 2, "K": 3, "bar": 3, "W": 1, "s": 3, "ms": 2, "ppm": 1, "Pa": 0, "m3": 5, "g/s": 2, "kg": 2, "kW": 1,
}  # fmt: skip
"""Digits after the point: of PLCs, links, states and a refrigerator's station. Those of the process come first."""
DIGITS: Final = 7
TICKS: Final = {"Tick": "time", "Ticks": "ticks"}
"""What a register counts whose description begins with this word."""
_WORD: Final = re.compile(r"(\d+) ([^,;:()]+?)(?: \([^)]*\))?(?=[,;:]|$)")


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


def words_in(description: str) -> dict[int, str]:
    """Return what a description such as "0 auto, 1 classical loops" says of each number; empty when it says nothing."""
    found = {int(number): text.strip() for number, text in _WORD.findall(description)}
    return found if len(found) > 1 and re.match(r"\d+ ", description) else {}


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
                    words={} if floating else words_in(register.description), description=register.description,
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
