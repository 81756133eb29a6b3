"""What the page and other programs are sent, as JSON; `docs/operator-page.md` describes every field."""

import json
import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any, Final

from coldloop import __version__
from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, SAMPLING_PERIOD_S, TICK_S
from coldloop.registers.audit import EventKind
from coldloop.registers.control_plc import Mode, OperatorMode, Plan
from coldloop.registers.maps import MAPS
from coldloop.registers.optimizer_plc import (
    BANDED_OUTPUTS,
    INPUT_SAMPLES,
    PREDICTED_SAMPLES,
    ModelDeviation,
    Optimization,
    Prediction,
    outputs_of,
)
from coldloop.registers.safety import Alarm, AlarmAction, AlarmKind, AlarmPriority, AlarmState
from coldloop.service.event_text import alarm_cause, alarm_word, word
from hmi.compression_station import plant_document
from hmi.explanation import explain
from hmi.process_image import JournalEntry, Model
from hmi.process_view import process_document
from hmi.sentences import deviation, sentence
from hmi.signals import signals_of
from hmi.trends import NAMES, Gap, mode_name, rounded, thin

Document = dict[str, Any]

MARKED: Final = {
    word(EventKind.ALARM_RAISED): "alarm",
    word(EventKind.LIVE_LOAD): "load",
    word(EventKind.LOAD): "load",
    word(EventKind.OPERATOR_MODE): "operator",
    word(EventKind.SETPOINT): "operator",
    word(EventKind.SENSOR_FAULT): "fault",
}
"""Kinds of events that are marked on the trends, and what as."""
BEGUN: Final = word(EventKind.SESSION)
MOST_MARKS: Final = 200
EARLIER_PREDICTIONS: Final = 12


def encoded(document: Document) -> bytes:
    """Return a document as JSON; numbers that are not finite are null."""
    try:
        return _json(document)
    except ValueError:
        return _json(_finite_parts(document))


def _json(document: object) -> bytes:
    return json.dumps(document, ensure_ascii=False, separators=(",", ":"), default=str, allow_nan=False).encode()


def _finite_parts(part: object) -> object:
    if isinstance(part, dict):
        return {key: _finite_parts(value) for key, value in part.items()}
    if isinstance(part, list | tuple):
        return [_finite_parts(value) for value in part]
    return None if isinstance(part, float) and not math.isfinite(part) else part


def finite(value: float | str) -> float | int | str | None:
    """Return a value that JSON has."""
    if isinstance(value, float):
        return rounded(value) if math.isfinite(value) else None
    return value


def catalog(*, training: bool, replay: bool) -> Document:
    """Return what the page is made from: signals, alarms, modes."""
    return {
        "version": __version__,
        "training": training,
        "replay": replay,
        "services": list(MAPS),
        "signals": {
            signal.name: {
                "service": service, "block": signal.block, "label": signal.label, "unit": signal.unit,
                "decimals": signal.decimals, "words": signal.words, "description": signal.description,
                "address": signal.address, "writer": signal.writer,
            }
            for service in MAPS
            for signal in signals_of(service)
        },
        "trended": list(NAMES),
        "process": process_document(),
        "inputs": list(INPUT_NAMES),
        "outputs": list(OUTPUT_NAMES),
        "modes": [mode_name(mode) for mode in Mode],
        "operator_modes": [word(mode) for mode in OperatorMode],
        "alarm_actions": {word(action): int(action) for action in AlarmAction},
        "tick_s": TICK_S,
    }  # fmt: skip


def alarm_document(kind: AlarmKind, alarm: Alarm) -> Document:
    """Return one alarm in words."""
    known = alarm.state in AlarmState.__members__.values()
    return {
        "number": int(kind),
        "name": alarm_word(kind),
        "state": word(AlarmState(alarm.state)) if known else str(alarm.state),
        "active": bool(alarm.active),
        "cause": alarm_cause(kind, alarm.cause) if alarm.times else "",
        "priority": int(alarm.priority),
        "priority_word": word(AlarmPriority(alarm.priority))
        if alarm.priority in AlarmPriority.__members__.values()
        else "",
        "times": alarm.times,
        "raised_s": alarm.raised * TICK_S,
        "returned_s": alarm.returned * TICK_S,
        "shelved_until_s": alarm.shelved_until * TICK_S,
    }


def alarms_document(model: Model) -> list[Document]:
    """Return all alarms, those that want an operator first, then by priority and age."""
    rank: dict[int, int] = {AlarmState.UNACKNOWLEDGED: 0, AlarmState.RETURNED: 0, AlarmState.ACKNOWLEDGED: 1}
    rows = sorted(
        model.alarm_rows(),
        key=lambda row: (rank.get(row[1].state, 2), -row[1].priority, not row[1].active, -row[1].raised),
    )
    return [alarm_document(kind, alarm) for kind, alarm in rows]


def event_document(entry: JournalEntry) -> Document:
    """Return one event in words."""
    text = entry.text
    return {
        "service": entry.service, "number": entry.number, "boot": entry.boot, "utc": entry.utc, "tick": entry.tick,
        "time_s": entry.tick * TICK_S, "kind": text.kind, "subject": text.subject, "cause": text.cause,
        "value": text.value, "unit": text.unit, "who": text.who, "sentence": text.sentence,
    }  # fmt: skip


def services_document(model: Model) -> Document:
    """Return whether each service is live, and the age of what is known of it."""
    found = {}
    for service in MAPS:
        age = model.age_s(service)
        live = model.is_live(service)
        found[service] = {
            "live": live,
            "age_s": None if age is None else round(age, 2),
            "reason": "" if live else model.sources[service].reason or "does not answer",
        }
    return found


def state_document(model: Model, changed: Iterable[str] | None = None) -> Document:
    """Return the state of everything that is shown; of signals only those that have changed, if these are named."""
    names = model.values if changed is None else [name for name in changed if name in model.values]
    plan = model.record("control_plc", Plan) if model.mode == Mode.MPC else None
    document: Document = {
        "whole": changed is None,
        "tick": model.tick,
        "time_s": model.tick * TICK_S,
        "services": services_document(model),
        "plant": plant_document(model),
        "deviation": deviation(
            model.record("optimizer_plc", ModelDeviation) or ModelDeviation(), plan.suspects if plan else 0
        ),
        "stale": model.stale_prefixes(),
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


def explanation_document(model: Model, number: int | None, at_tick: int | None = None) -> Document | None:
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
        found = explain(update, before, after, model.rule)
    except (ArithmeticError, ValueError):  # numbers that no optimiser of ours writes
        return None
    prediction = next((one for one in reversed(model.predictions) if one.update == update.update), None)
    document = asdict(found)
    document["sentence"] = sentence(found, model.rule)
    document["update"] = update._asdict()
    document["before"] = found.before._asdict() if found.before is not None else None
    document["increments"] = found.increments._asdict() if found.increments else None
    document["budget"]["slack"] = found.budget.slack
    document["time_s"] = update.tick * TICK_S
    document["neighbours"] = [before.update if before else None, after.update if after else None]
    document["rule"] = model.rule._asdict()
    document["prediction"] = prediction_document(prediction) if prediction else None
    return document


def prediction_document(prediction: Prediction) -> Document:
    """Return a prediction as curves over plant time."""
    start = prediction.tick * TICK_S
    inputs = [prediction.u[i :: len(INPUT_NAMES)] for i in range(len(INPUT_NAMES))]
    return {
        "update": prediction.update,
        "time": [start + sample * SAMPLING_PERIOD_S for sample in PREDICTED_SAMPLES],
        **{name: list(map(rounded, ahead)) for name, ahead in zip(BANDED_OUTPUTS, outputs_of(prediction), strict=True)},
        "input_time": [start + sample * SAMPLING_PERIOD_S for sample in INPUT_SAMPLES],
        **{name: [rounded(value) for value in one] for name, one in zip(INPUT_NAMES, inputs, strict=True)},
    }


def trend_document(model: Model, names: Sequence[str], start: int, end: int, points: int) -> Document:
    """Return everything that is drawn between two ticks."""
    times, series = model.trends.thinned(names, start, end, points)
    gaps = model.trends.gaps(start, end)
    updates = [update for update in model.updates if start <= update.tick <= end]
    update_times, update_series = thin(
        [update.tick * TICK_S for update in updates],
        {
            "tau_u": [update.tau_u * TICK_S for update in updates],
            "q": [float(update.q) for update in updates],
            "J": [update.j_effective for update in updates],
            "J_predicted": [update.j_delivered for update in updates],
        },
        points,
        _lost_updates(updates, gaps),
    )
    shown = [one for one in model.predictions if one.tick >= start]
    limits = model.limits
    return {
        "from_s": start * TICK_S,
        "to_s": end * TICK_S,
        "now_s": model.tick * TICK_S,
        "time": times,
        "series": series,
        "updates": {"time": update_times, **update_series},
        "modes": [
            {"from": one.start, "to": one.end, "mode": mode_name(one.mode)} for one in model.trends.modes(start, end)
        ],
        "substituted": {name: found for name, found in model.trends.substituted(start, end).items() if name in names},
        "marks": _marks(model, start, end),
        "predictions": [prediction_document(one) for one in _some(shown)],
        "planned": model.is_planned,
        "gaps": [[max(gap.start, start) * TICK_S, min(gap.end, end) * TICK_S] for gap in gaps],
        "bands": _ranges(BANDED_OUTPUTS, limits.output_low, limits.output_high),
        "bounds": _ranges(INPUT_NAMES, limits.input_low, limits.input_high),
    }


def _lost_updates(updates: Sequence[Optimization], gaps: Sequence[Gap]) -> list[float]:
    """Return the times of the updates, s, before which some are missing because nothing could be read."""
    return [
        after.tick * TICK_S
        for before, after in pairwise(updates)
        if after.update != before.update + 1 and any(before.tick < gap.end and gap.start < after.tick for gap in gaps)
    ]


def _ranges(names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> Document:
    return {name: list(ends) for name, *ends in zip(names, low, high, strict=True)}


def _some(predictions: list[Prediction]) -> list[Prediction]:
    """Return the newest prediction and some of the earlier ones, evenly spaced."""
    every = max(1, -(-len(predictions) // EARLIER_PREDICTIONS))
    return predictions[::-1][::every][::-1]


def _marks(model: Model, start: int, end: int) -> list[Document]:
    begun = max((e.utc for e in model.events if e.service == "plant" and e.text.kind == BEGUN), default="")
    found = [
        entry
        for entry in model.events
        if entry.text.kind in MARKED and start <= entry.tick <= end and entry.utc >= begun  # not of a session before
    ]
    return [
        {"time": entry.tick * TICK_S, "kind": MARKED[entry.text.kind], "text": entry.text.sentence}
        for entry in found[-MOST_MARKS:]
    ]
