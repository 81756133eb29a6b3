"""Documents for the page and other programs: JSON (`docs/operator-page.md` describes every field), and metrics.

Signals are derived from the register declarations: a new one appears by itself. A signal is a register of a block with
one row; its name is `service.block.register`, such as `plant.measurement.y.T5`.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from itertools import islice, pairwise
from typing import Any, Final, NamedTuple

from prometheus_client.core import Metric

from coldloop import __version__
from coldloop.process.declaration import Process
from coldloop.process.sections import Output, Range
from coldloop.registers import codec, common, control_plc, declaration, optimizer_plc, plant
from coldloop.registers.common import AlarmAction, AlarmPriority, AlarmState
from coldloop.registers.optimizer_plc import ModelDeviation, Optimization, Prediction
from coldloop.service import journal, monitoring
from coldloop.text import finite_json
from coldloop_hmi import explanation
from coldloop_hmi import process_image as image

KIND: Final = "plant.kind"
REFRIGERATOR: Final = "refrigerator"
SIGNALS: Final = "plant.station.signals."
ALARMS: Final = "plant.station.alarms."
LIMITS: Final = {
    "P12": ("hp_low_bar", "hp_high_bar"),
    "P11": ("lp_low_bar", "lp_high_bar"),
    "L_N2": ("nitrogen_low", None),
    "lost": (None, "helium_lost_kg"),
}
"""Limits at which the station's alarms begin, by signal: below, above."""
MARKED: Final = {
    common.EventKind.ALARM_RAISED.word: "alarm",
    common.EventKind.LIVE_LOAD.word: "load",
    common.EventKind.LOAD.word: "load",
    common.EventKind.OPERATOR_MODE.word: "operator",
    common.EventKind.SETPOINT.word: "operator",
    common.EventKind.SENSOR_FAULT.word: "fault",
}
"""Kinds of events that are marked on the trends, and what as."""
BEGUN: Final = common.EventKind.SESSION.word
MOST_MARKS: Final = 1000
EARLIER_PREDICTIONS: Final = 12
PERIODS: Final = ("tau_u", "q")
QUANTITIES: Final[Mapping[str, Callable[[Optimization, float], float]]] = {
    "tau_u": lambda one, tick_s: one.tau_u * tick_s,
    "q": lambda one, _: float(one.q),
    "J": lambda one, _: one.j_effective,
    "J_predicted": lambda one, _: one.j_delivered,
}


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


def qualities(doubts: image.Doubts, stale: Iterable[str], process: Process) -> Mapping[str, image.Quality]:
    """Return the quality of all signals that are not good, by name; a name that ends with a dot is a beginning.

    `stale` names what is not current.
    """
    found = [(name, image.Quality.STALE) for name in stale]
    for name, quality in image.doubted(doubts, process).items():
        found.append((f"control_plc.process.y.{name}", quality))
        found += [(f"{raw}{name}", image.Quality.BAD if quality is image.Quality.HELD else quality) for raw in RAW]
    found += [(name, image.Quality.SIMULATED) for name in STATES]
    return dict(sorted(found, key=lambda one: list(image.Quality).index(one[1])))


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


@cache
def signals_of(register_map: declaration.RegisterMap) -> tuple[Signal, ...]:
    """Return the signals of a service, in the order of their registers."""
    found: list[Signal] = []
    digits_of = DECIMALS | decimals_by_unit(register_map.process)
    for block in image.shown_blocks(register_map):
        texts, seen = {name for name, one in block.fields.items() if one.is_text}, set[str]()
        for register in block.registers():
            field = register.name.partition(".")[0]
            label = field if field in texts else register.name
            if label in seen:
                continue
            seen.add(label)
            floating = register.kind is declaration.Kind.F32
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


def plant_document(model: image.Model) -> dict[str, Any]:
    """Return the kind of the plant as it reports it; of a refrigerator also the state of its station."""
    kind = model.configuration.get(KIND, "")
    if kind != REFRIGERATOR:
        return {"kind": kind}
    status = model.record("plant", plant.StationStatus) or plant.StationStatus()
    return {
        "kind": kind,
        "mode": plant.StationMode.word_of(status.mode),
        "alarms": journal.flag_words(plant.StationAlarm(status.alarms)),
        "bands": {
            f"{SIGNALS}{name}": [model.configuration.get(f"{ALARMS}{key}") for key in keys]
            for name, keys in LIMITS.items()
        },
    }


Document = dict[str, Any]


def encoded(document: Document) -> bytes:
    """Return a document as JSON; numbers that are not finite are null."""
    return finite_json(document).encode()


def finite(value: float | str) -> float | int | str | None:
    """Return a value that JSON has."""
    if isinstance(value, float):
        return image.rounded(value) if math.isfinite(value) else None
    return value


def catalog(model: image.Model, *, training: bool, replay: bool) -> Document:
    """Return what the page is made from: signals, alarms, modes."""
    process = model.process
    return {
        "version": __version__,
        "training": training,
        "replay": replay,
        "services": list(model.maps),
        "signals": {
            signal.name: {"service": service, **signal._asdict()}
            for service, register_map in model.maps.items()
            for signal in signals_of(register_map)
        },
        "trended": [name for name in model.trends.names if name != "load" or process.has_load],
        "process": process_document(process),
        "outputs": list(process.output_names),
        "alarm_actions": {action.word: int(action) for action in AlarmAction},
        "alarm_states": {state.word: state.text for state in AlarmState},
        "tick_s": process.tick_s,
    }  # fmt: skip


def alarms_document(model: image.Model) -> list[Document]:
    """Return all alarms in words: the active ones first, of these the unacknowledged, then by priority and age."""
    rank: dict[int, int] = {AlarmState.UNACKNOWLEDGED: 0, AlarmState.ACKNOWLEDGED: 1, AlarmState.RETURNED: 2}
    rows = sorted(
        enumerate(model.alarms), key=lambda row: (rank.get(row[1].state, 3), -row[1].priority, -row[1].raised)
    )
    process = model.process
    return [
        {
            "number": kind,
            "name": journal.alarm_word(kind, process),
            "state": AlarmState.word_of(alarm.state),
            "active": bool(alarm.active),
            "cause": journal.alarm_cause(kind, alarm.cause, process) if alarm.times else "",
            "priority": int(alarm.priority),
            "priority_word": AlarmPriority.word_of(alarm.priority),
            "times": alarm.times,
            "raised_s": alarm.raised * process.tick_s,
            "returned_s": alarm.returned * process.tick_s,
            "shelved_until_s": alarm.shelved_until * process.tick_s,
        }
        for kind, alarm in rows
    ]


def event_document(entry: image.JournalEntry, tick_s: float) -> Document:
    """Return one event in words."""
    text = entry.text
    return {
        "service": entry.service, "number": entry.number, "boot": entry.boot, "utc": entry.utc, "tick": entry.tick,
        "time_s": entry.tick * tick_s, "kind": text.kind, "subject": text.subject, "cause": text.cause,
        "value": text.value, "unit": text.unit, "who": text.who, "sentence": text.sentence,
    }  # fmt: skip


def services_document(model: image.Model) -> Document:
    """Return whether each service is live, and the age of what is known of it."""
    found = {}
    for service, source in model.sources.items():
        age = model.age_s(service)
        live = model.is_live(service)
        found[service] = {
            "live": live,
            "age_s": None if age is None else round(age, 2),
            "reason": "" if live else source.reason or "does not answer",
        }
    return found


def state_document(model: image.Model, changed: Iterable[str] | None = None) -> Document:
    """Return the state of everything that is shown; of signals only those that have changed, if these are named."""
    process = model.process
    names = model.values if changed is None else [name for name in changed if name in model.values]
    found = model.record("optimizer_plc", ModelDeviation) or codec.blank(ModelDeviation, model.maps["optimizer_plc"])
    stale, replaced = model.stale_prefixes(), model.doubts.held | model.doubts.bad
    not_current = [f"control_plc.process.y.{name}" for i, name in enumerate(process.output_names) if replaced >> i & 1]
    document: Document = {
        "whole": changed is None,
        "tick": model.tick,
        "time_s": model.tick * process.tick_s,
        "services": services_document(model),
        "plant": plant_document(model),
        "deviation": explanation.deviation(found, process, model.doubts.suspect),
        "commands": model.commands,
        "stale": stale + not_current,
        "quality": dict(qualities(model.doubts, stale, process)),
        "values": {name: finite(model.values[name]) for name in names},
    }
    if model.replay is not None:
        document["replay"] = model.replay
    parts = set(changed) if changed is not None else {"alarms", "updates"}
    if "alarms" in parts:
        document["alarms"] = alarms_document(model)
    if "updates" in parts:
        document["update"] = explanation_document(model, None)
    return document


def explanation_document(model: image.Model, number: int | None, at_tick: int | None = None) -> Document | None:
    """Return the explanation of the period of an update: by number, at a tick, or the last one; None without it."""
    updates = model.updates
    place = len(updates) - 1
    if at_tick is not None:
        place = bisect_right(updates, at_tick, key=lambda update: update.tick) - 1
    elif number is not None:
        place = next((i for i in range(len(updates) - 1, -1, -1) if updates[i].update == number), -1)
    if place < 0:
        return None
    update = updates[place]
    before = updates[place - 1] if place else None
    after = updates[place + 1] if place + 1 < len(updates) else None
    try:
        found = explanation.explain(update, before, after, model.rule, model.process)
    except (ArithmeticError, ValueError):  # numbers that no optimiser of ours writes
        return None
    prediction = next((one for one in reversed(model.predictions) if one.update == update.update), None)
    document = asdict(found)
    document["sentence"] = explanation.sentence(found, model.rule)
    document["update"] = update._asdict()
    document["before"] = found.before._asdict() if found.before is not None else None
    document["time_s"] = update.tick * model.process.tick_s
    document["neighbours"] = [before.update if before else None, after.update if after else None]
    document["rule"] = model.rule._asdict()
    document["prediction"] = prediction_document(prediction, model.process) if prediction else None
    return document


def prediction_document(prediction: Prediction, process: Process) -> Document:
    """Return a prediction as curves over plant time."""
    start, sample_s = prediction.tick * process.tick_s, process.sampling_period_s
    names, banded = process.input_names, zip(process.banded, optimizer_plc.outputs_of(prediction), strict=True)
    inputs = [prediction.u[i :: len(names)] for i in range(len(names))]
    return {
        "update": prediction.update,
        "time": [start + sample * sample_s for sample in optimizer_plc.PREDICTED_SAMPLES],
        **{one.name: list(map(image.rounded, ahead)) for one, ahead in banded},
        "input_time": [start + sample * sample_s for sample in optimizer_plc.INPUT_SAMPLES],
        **{name: [image.rounded(value) for value in one] for name, one in zip(names, inputs, strict=True)},
    }


def trend_document(
    model: image.Model, names: Sequence[str], start: int, end: int, points: int, *, is_brief: bool = False
) -> Document:
    """Return everything that is drawn between two ticks; in brief without predictions, and of updates tau_u only."""
    process, tick_s = model.process, model.process.tick_s
    times, series = model.trends.thinned(names, start, end, points)
    gaps = model.trends.gaps(start, end)
    modes = model.trends.modes(start, end)
    in_force = model.trends.modes(
        start - 2 * process.ticks_per_sample, end
    )  # with the update that the window begins with
    shown = [one for one in model.predictions if one.tick >= start and not is_brief]
    every = max(1, -(-len(shown) // EARLIER_PREDICTIONS))  # the newest, and of the earlier ones some
    quantities = ("tau_u",) if is_brief else tuple(QUANTITIES)
    limits = model.limits
    begun = max((e.utc for e in model.events if e.service == "plant" and e.text.kind == BEGUN), default="")
    known = [entry for entry in model.events if entry.utc >= begun]  # not of a session before
    marked = MARKED.keys() - ({common.EventKind.LOAD.word} if not process.has_load else ())
    found = [entry for entry in known if entry.text.kind in marked and start <= entry.tick <= end]
    is_cut = len(found) > MOST_MARKS or (len(known) == model.events.maxlen and known[0].tick > start)
    return {
        "now_s": model.tick * tick_s,
        "time": times,
        "series": series,
        "updates": updates_document(model.updates, in_force, gaps, points, quantities, tick_s),
        "modes": [{"from": one.start, "to": one.end, "mode": control_plc.Mode.word_of(one.value)} for one in modes],
        "doubtful": {name: found for name, found in model.trends.doubtful(start, end).items() if name in names},
        "marks": [
            {"time": entry.tick * tick_s, "kind": MARKED[entry.text.kind], "text": entry.text.sentence}
            for entry in found[-MOST_MARKS:]
        ],
        "marks_since_s": (found[-MOST_MARKS:] or known)[0].tick * tick_s if is_cut else None,
        "predictions": [prediction_document(one, process) for one in shown[::-1][::every][::-1]],
        "planned": model.is_planned,
        "gaps": [[max(gap.start, start) * tick_s, min(gap.end, end) * tick_s] for gap in gaps],
        "bands": _ranges([one.name for one in process.banded], limits.output_low, limits.output_high),
        "bounds": _ranges(process.input_names, limits.input_low, limits.input_high),
    }


def updates_document(
    updates: Sequence[Optimization], modes: Sequence[image.Stretch[int]], gaps: Sequence[image.Gap], points: int,
    quantities: Sequence[str], tick_s: float,
) -> Document:  # fmt: skip
    """Return times, updating periods and costs of updates as far as they were in force: while MPC was active.

    A period lasts until the next one, or until its stretch ends. A cost is of an instant. Elsewhere there is None, also
    between updates of which some are missing because nothing could be read.
    """
    found: Document = {name: [] for name in ("time", *quantities)}
    for stretch in modes:
        if stretch.value != control_plc.Mode.MPC:
            continue
        first, last = (round(time / tick_s) for time in (stretch.start, stretch.end))
        start = bisect_left(updates, first, key=lambda one: one.tick)
        inside = [*islice(updates, start, bisect_right(updates, last, key=lambda one: one.tick))]
        if not inside:
            continue
        columns = {name: [QUANTITIES[name](one, tick_s) for one in inside] for name in quantities}
        lost = [  # updates before which some are missing because nothing could be read
            after.tick * tick_s
            for before, after in pairwise(inside)
            if after.update != before.update + 1
            and any(before.tick < gap.end and gap.start < after.tick for gap in gaps)
        ]
        times, thinned = image.thin([one.tick * tick_s for one in inside], columns, points, tick_s, lost)
        found["time"] += [*times, last * tick_s, (last + 1) * tick_s]
        for name, values in thinned.items():
            found[name] += [*values, values[-1] if name in PERIODS else None, None]
    return found


def _ranges(names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> Document:
    return {name: list(ends) for name, *ends in zip(names, low, high, strict=True)}


def page_families(model: image.Model, browsers: int) -> Iterator[Metric]:
    """Yield everything; of a service that is silent only that it is."""
    yield monitoring.build_family()
    live = [service for service in model.maps if model.is_live(service)]
    up = {service: service in live for service in model.maps}
    yield monitoring.gauge("coldloop_up", "1 while a service answers the page", up, label="service")
    ages = {service: age for service in model.maps if (age := model.age_s(service)) is not None}
    yield monitoring.gauge("coldloop_age_seconds", "Time since the last answer of a service", ages, label="service")
    yield monitoring.gauge("coldloop_page_browsers", "Streams to browsers", browsers)
    for service in live:
        for block in model.maps[service].blocks:
            record = model.sources[service].records.get(block.name)
            if record is not None and block.writer is None:
                yield from monitoring.block_families(service, block, record)
    found, places = qualities(model.doubts, model.stale_prefixes(), model.process), ("control_plc.process.y.", *RAW)
    read = [place for place in places if place.partition(".")[0] in live]
    names = [f"{place}{name}" for place in read for name in model.process.output_names]
    names += ["update"] if "optimizer_plc" in live and model.updates else []
    worst = dict.fromkeys(names, 0)
    for entry, quality in found.items():  # the worst is the last
        concerned = [name for name in names if name == entry or (entry[-1] == "." and name.startswith(entry))]
        worst.update(dict.fromkeys(concerned, list(image.Quality).index(quality)))
    description = ", ".join(f"{number} {quality}" for number, quality in enumerate(image.Quality))
    yield monitoring.gauge("coldloop_quality", f"Quality of a value: {description}", worst, label="signal")
    if "control_plc" in live:
        words, rows = [journal.alarm_word(kind, model.process) for kind in range(len(model.alarms))], model.alarms
        states = ", ".join(f"{state.value} {state.text}" for state in AlarmState)
        for name, description, values in (
            ("coldloop_alarm_active", "1 while the condition of an alarm holds", [row.active for row in rows]),
            ("coldloop_alarm_state", states, [row.state for row in rows]),
            ("coldloop_alarm_raised", "Times that an alarm was raised", [row.times for row in rows]),
        ):
            yield monitoring.gauge(name, description, dict(zip(words, values, strict=True)), label="alarm")
    if "optimizer_plc" in live and model.updates:
        fields = model.maps["optimizer_plc"].block_of(Optimization).fields
        for (name, field), value in zip(fields.items(), model.updates[-1], strict=True):
            unit = f" ({field.unit})" if field.unit else ""
            yield monitoring.gauge(f"coldloop_update_{name}", f"Last update: {field.description}{unit}", value)
