"""Registers in Prometheus' text format: each number is a gauge, named by service, block and register.

coldloop_plant_measurement_y{element="T5"} 12.5
"""

import math
import re
from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

from coldloop import __version__
from coldloop.registers.bank import RegisterBank
from coldloop.registers.declaration import Block, fields_of

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_NOT_IN_NAMES: Final = re.compile(r"[^a-zA-Z0-9_]+")


class Sample(NamedTuple):
    """One number, with the labels that tell it from the others of its family."""

    value: float
    labels: tuple[tuple[str, str], ...] = ()


class MetricFamily(NamedTuple):
    """Samples of one name."""

    name: str
    description: str
    samples: tuple[Sample, ...]


def build_family() -> MetricFamily:
    """Return the version of the program as a label of the number 1."""
    return MetricFamily("coldloop_build_info", "Version of Coldloop", (Sample(1.0, (("version", __version__),)),))


def block_families(service: str, block: Block, record: tuple[Any, ...]) -> Iterator[MetricFamily]:
    """Yield the registers of a record; texts are left out."""
    for (name, field), value in zip(fields_of(block.record).items(), record, strict=True):
        if field.is_text or name == "crc":
            continue
        unit = field.unit or (field.units[0] if len(set(field.units)) == 1 else "")
        description = f"{field.description} ({unit})" if unit else field.description
        if field.elements:
            samples = tuple(
                Sample(float(one), (("element", element),)) for element, one in zip(field.elements, value, strict=True)
            )
        else:
            samples = (Sample(float(value)),)
        yield MetricFamily(metric_name(service, block.name, name), description, samples)


def bank_families(bank: RegisterBank) -> Iterator[MetricFamily]:
    """Yield all registers of a service that are not rows of a table and that no client writes."""
    yield build_family()
    for block in bank.map.blocks:
        if block.rows == 1 and block.writer is None:
            yield from block_families(bank.map.service, block, bank.get(block.record))


def metric_name(*parts: str) -> str:
    """Return a name of Prometheus made of these parts."""
    return _NOT_IN_NAMES.sub("_", "_".join(("coldloop", *parts))).lower()


def exposition(families: Iterable[MetricFamily]) -> str:
    """Return families in Prometheus' text format."""
    lines: list[str] = []
    for family in families:
        lines.append(f"# HELP {family.name} {_escaped(family.description)}")
        lines.append(f"# TYPE {family.name} gauge")
        lines += [f"{family.name}{_labels(sample)} {_number(sample.value)}" for sample in family.samples]
    return "\n".join(lines) + "\n"


def _labels(sample: Sample) -> str:
    if not sample.labels:
        return ""
    return "{" + ",".join(f'{name}="{_escaped(value, quotes=True)}"' for name, value in sample.labels) + "}"


def _escaped(text: str, *, quotes: bool = False) -> str:
    escaped = text.replace("\\", r"\\").replace("\n", r"\n")
    return escaped.replace('"', r"\"") if quotes else escaped


def _number(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return f"{value:.9g}"
