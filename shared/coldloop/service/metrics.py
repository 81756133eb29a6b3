"""Registers in Prometheus' text format: each number is a gauge, named by service, block and register.

coldloop_plant_measurement_y{element="T5"} 12.5
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from prometheus_client import generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from coldloop import __version__
from coldloop.registers.bank import RegisterBank
from coldloop.registers.declaration import Block

_NOT_IN_NAMES: Final = re.compile(r"[^a-zA-Z0-9_]+")


def gauge(name: str, description: str, values: float | Mapping[str, float], *, label: str = "") -> Metric:
    """Return a gauge: one number, or one for each value of a label."""
    if not isinstance(values, Mapping):
        return GaugeMetricFamily(name, description, value=values)
    family = GaugeMetricFamily(name, description, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def build_family() -> Metric:
    """Return the version of the program as a label of the number 1."""
    return gauge("coldloop_build_info", "Version of Coldloop", {__version__: 1.0}, label="version")


def block_families(service: str, block: Block, record: tuple[Any, ...]) -> Iterator[Metric]:
    """Yield the registers of a record; texts are left out."""
    for (name, field), value in zip(block.fields.items(), record, strict=True):
        if field.is_text or name == "crc":
            continue
        unit = field.unit or (field.units[0] if len(set(field.units)) == 1 else "")
        description = f"{field.description} ({unit})" if unit else field.description
        values = dict(zip(field.elements, value, strict=True)) if field.elements else value
        yield gauge(metric_name(service, block.name, name), description, values, label="element")


def bank_families(bank: RegisterBank) -> Iterator[Metric]:
    """Yield all registers of a service that are not rows of a table and that no client writes."""
    yield build_family()
    for block in bank.map.shown:
        if block.rows == 1 and block.writer is None:
            yield from block_families(bank.map.service, block, bank.get(block.record))


def metric_name(*parts: str) -> str:
    """Return a name of Prometheus made of these parts."""
    return _NOT_IN_NAMES.sub("_", "_".join(("coldloop", *parts))).lower()


class _Families(Collector):
    """Metrics, made anew for each answer."""

    def __init__(self, families: Iterable[Metric]) -> None:
        self._families = families

    def collect(self) -> Iterator[Metric]:
        """Return it."""
        yield from self._families


def exposition(families: Iterable[Metric]) -> bytes:
    """Return families in Prometheus' text format."""
    return generate_latest(_Families(families))
