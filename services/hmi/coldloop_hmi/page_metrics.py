"""Metrics of the page for Prometheus: all registers it reads, alarms, the last update, and the page itself."""

from collections.abc import Iterator

from prometheus_client.core import Metric

from coldloop.registers.declaration import RegisterMap
from coldloop.registers.optimizer_plc import Optimization
from coldloop.service.event_text import alarm_word
from coldloop.service.metrics import block_families, build_family, gauge
from coldloop_hmi.process_image import Model
from coldloop_hmi.quality import RAW, Quality, qualities


def page_families(model: Model, browsers: int) -> Iterator[Metric]:
    """Yield everything; of a service that is silent only that it is."""
    yield build_family()
    live = [service for service in model.maps if model.is_live(service)]
    up = {service: service in live for service in model.maps}
    yield gauge("coldloop_up", "1 while a service answers the page", up, label="service")
    ages = {service: age for service in model.maps if (age := model.age_s(service)) is not None}
    yield gauge("coldloop_age_seconds", "Time since the last answer of a service", ages, label="service")
    yield gauge("coldloop_page_browsers", "Streams to browsers", browsers)
    for service in live:
        for block in model.maps[service].blocks:
            record = model.sources[service].records.get(block.name)
            if record is not None and block.writer is None:
                yield from block_families(service, block, record)
    yield _qualities(model, live)
    if "control_plc" in live:
        yield from _alarms(model)
    if "optimizer_plc" in live and model.updates:
        yield from _update(model.updates[-1], model.maps["optimizer_plc"])


def _qualities(model: Model, live: list[str]) -> Metric:
    """Return the quality of the outputs, wherever they are read, and of the last update, as page and API have them."""
    found, places = qualities(model.doubts, model.stale_prefixes(), model.process), ("control_plc.process.y.", *RAW)
    names = [
        f"{place}{name}" for place in places if place.partition(".")[0] in live for name in model.process.output_names
    ]
    if "optimizer_plc" in live and model.updates:
        names.append("update")
    worst = dict.fromkeys(names, 0)
    for number, quality in enumerate(Quality):
        entries = [entry for entry, one in found.items() if one is quality]
        concerned = [
            name
            for name in names
            if any(name == each or (each[-1] == "." and name.startswith(each)) for each in entries)
        ]
        worst.update(dict.fromkeys(concerned, number))
    description = ", ".join(f"{number} {quality}" for number, quality in enumerate(Quality))
    return gauge("coldloop_quality", f"Quality of a value: {description}", worst, label="signal")


def _alarms(model: Model) -> Iterator[Metric]:
    rows = [(alarm_word(kind, model.process), alarm) for kind, alarm in model.alarm_rows()]
    for name, description, values in (
        ("coldloop_alarm_active", "1 while the condition of an alarm holds", [row.active for _, row in rows]),
        ("coldloop_alarm_state",
         "0 normal, 1 unacknowledged, 2 acknowledged, 3 returned unacknowledged, 4 shelved, 5 out of service",
         [row.state for _, row in rows]),
        ("coldloop_alarm_raised", "Times that an alarm was raised", [row.times for _, row in rows]),
    ):  # fmt: skip
        yield gauge(name, description, dict(zip([alarm for alarm, _ in rows], values, strict=True)), label="alarm")


def _update(update: Optimization, of: RegisterMap) -> Iterator[Metric]:
    for (name, field), value in zip(of.block_of(Optimization).fields.items(), update, strict=True):
        unit = f" ({field.unit})" if field.unit else ""
        yield gauge(f"coldloop_update_{name}", f"Last update: {field.description}{unit}", value)
