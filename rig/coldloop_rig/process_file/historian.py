"""The export of a historian made into a record: even times, held inputs, averaged outputs, pieces without gaps."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from coldloop.errors import UsageError
from coldloop.table import TIME, Table, is_good, plain, read_table
from coldloop_rig.process_file.linear_model import Array
from coldloop_rig.process_file.step_test import PIECE

Frame = Any
"""A table or column of pandas, which ships no complete types."""

TIMES: Final = {
    "time", "timestamp", "time stamp", "time_stamp", "time_s", "time_ms", "date", "datetime", "date/time", "date time",
    "date_time", "local time", "zeit", "zeitstempel", "datum", "datum/zeit", "uhrzeit", "horodatage", "fecha", "_time",
    "epoch", "ts", "utc", "sourcetimestamp", "source timestamp",
}  # fmt: skip
"""Names of columns of time."""
DATES, CLOCKS = {"date", "datum", "fecha"}, {"time", "zeit", "uhrzeit"}
"""Names of two columns that are one of time."""
TAGS: Final = {
    "tag", "tagname", "tag name", "tag_name", "name", "point", "signal", "variable", "item", "itemid", "sensor",
}  # fmt: skip
VALUES: Final = {"value", "val", "wert", "valeur", "valor", "_value", "reading"}
NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
WITH_ZONE: Final = r":\d\d.*(?:Z|UTC|GMT|[+-]\d\d(?::?\d\d)?)$"
SINCE_1970: Final = (1e8, 1e11, 1e14, 1e17)
"""Numbers from which on a time is since 1970, in seconds, milliseconds, microseconds, nanoseconds."""
UNITS: Final = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
DAYS: Final = (20_000.0, 80_000.0)
"""Range of a spreadsheet's times, days since 1900, where they are closer to each other than DAY_STEP."""
DAY_STEP: Final = 0.01
GAP: Final = 5.0  # periods without a reading beyond which a record is cut, unless another gap is given
BY_CHANGE: Final = 2.0
"""Periods between the readings of an input beyond which they are its changes, so that no reading is missing."""
MISSING: Final = 1.5
"""Usual periods of an input beyond which a reading is missing: if it steps there, it is not known when."""
STEP: Final = 0.1  # least step of an input, over its standard deviation
SNAP: Final = 0.01  # part by which a usual period is off a number of two digits that is meant
EARLY: Final = 1e-3  # part of a period by which the time of a reading may be rounded up
FEWEST: Final = 10  # rows of a piece


class Request(NamedTuple):
    """Export of a historian to be imported, with the options of the import."""

    path: Path
    names: Mapping[str, str]
    """Signals by tag; if empty, all columns with the name of a signal are read. TIME names the column of time."""
    inputs: tuple[str, ...]
    """Signals that hold between readings; the others are outputs."""
    zone: str | None = None
    """Time zone of stamps without one, such as Europe/Berlin."""
    good: tuple[str, ...] = ()
    """Texts of good quality, beside those of `is_good`."""
    every_s: float | None = None
    gap_s: float | None = None


def record_of(request: Request) -> tuple[str, list[str]]:
    """Return a record as CSV text, and what was assumed, done and dropped. Raises UsageError: none can be made."""
    table = read_table(request.path, TIMES | TAGS | {*request.names}, "name the export of a historian")
    said = [f"read       {table.where}: {', '.join((f'{len(table.rows)} lines', *table.notes))}"]
    readings = _good(_readings(table, request, said), table, request, said)
    spelt = {name.casefold(): name for name in request.inputs}
    signals = {
        spelt.get(name.casefold(), name): (one.time.to_numpy(float), one.value.to_numpy(float))
        for name, one in readings.groupby("name", sort=False)
        if len(one) > 1
    }
    missing = [name for name in (*request.inputs, *request.names.values()) if name not in {*signals, TIME}]
    if missing or len(signals) <= len(spelt):
        what = ", ".join(missing) or "outputs beside the inputs"
        why = "".join(f"; {' '.join(line.split())}" for line in said[1:] if line.startswith(("dropped", "left")))
        raise UsageError(
            f"{table.where}: no readings of {what}; there are some of {', '.join(signals) or 'nothing'}{why}"
        )
    return _record(signals, request, said), said


def _readings(table: Table, request: Request, said: list[str]) -> Frame:
    """Return name, stamp, value, quality and line of each reading, in the order of the file, for any of its shapes."""
    keys, tags = [plain(name) for name in table.names], {plain(tag): name for tag, name in request.names.items()}
    cells = pd.DataFrame([row[: len(keys)] for _, row in table.rows], dtype=object)
    times, quality = _times(table, keys, tags, cells), table.qualities()
    cells["line"] = [line for line, _ in table.rows]
    cells = cells[cells[times].ne("").any(axis=1) & (cells[[*range(len(keys))]].ne("").sum(axis=1) > 1)]
    if len(cells) < len(table.rows):
        said.append(f"dropped    {len(table.rows) - len(cells)} lines without a time or a reading")

    def readings(name: object, place: int, judge: int | None) -> Frame:
        stamp = cells[max((k for k in times if k <= place), default=times[0])]
        given = {"name": name, "stamp": stamp, "value": cells[place], "quality": "" if judge is None else cells[judge]}
        return pd.DataFrame({**given, "line": cells.line})[stamp.ne("")]

    tag, value = (next((k for k, key in enumerate(keys) if key in known), None) for known in (TAGS, VALUES))
    if tag is not None and value is not None:  # a line for each reading
        names = {each: _name(each, tags) for each in cells[tag].unique()}
        left = [each for each, name in names.items() if name is None]
        found = readings(cells[tag].map(names), value, next(iter(quality), None))
    else:
        own = {k: _name(table.names[k], tags) for k in range(len(keys)) if k not in {*times, *quality}}
        called = [name for name in own.values() if name is not None]
        if len({*called}) < len(called):
            raise UsageError(f"{table.where}: two columns are {max(called, key=called.count)}; remove one")
        judges = _judges(keys, [k for k, name in own.items() if name is not None], quality)
        left = [table.names[k] for k, name in own.items() if name is None and keys[k]]
        free = [table.names[k] for k in quality if k not in judges.values()]
        if free and called and not tags:
            raise UsageError(
                f"{table.where}: {', '.join(free)}: whose? name it as in h1.quality, or name the columns with --map"
            )
        left += free
        found = pd.concat([readings("", times[0], None)[:0], *(readings(own[k], k, judges[k]) for k in judges)])
    said += [f"left out   {', '.join(left)}"] if left else []
    found = found[found.name.notna()]
    if found.empty:
        raise UsageError(f"{table.where}: none of {', '.join(table.names)[:80]!r} is a signal; --map TAG=NAME names it")
    return found


def _name(tag: str, tags: Mapping[str, str]) -> str | None:
    """Return what a signal is called in the record, if it is in it."""
    bare = re.sub(r"\s*[\[(][^\[(]*[\])]$", "", tag)
    return tags.get(plain(tag)) if tags.keys() - {TIME} else bare if NAME.fullmatch(bare) else None


def _judges(keys: list[str], places: list[int], quality: list[int]) -> dict[int, int | None]:
    """Return the column of the quality of each: that with its name before it, the only one, or the next."""
    words = [re.split(r"[\W_]+", key) for key in keys]
    alone = [q for q in quality if len(words[q]) == 1 or words[q][-1] == "code"]
    named = {k: next((q for q in quality if words[q][:-1] == words[k]), None) for k in places}
    beside = {k: k + 1 for k in places if k + 1 in alone or (k + 1 in quality and words[k][0] == words[k + 1][0])}
    return {k: named[k] or (alone[0] if len(alone) == 1 else beside.get(k)) for k in places}


def _times(table: Table, keys: list[str], tags: Mapping[str, str], cells: Frame) -> list[int]:
    """Return the columns of time: one, one for each signal, or date and time of day, which are then both in each."""
    mapped = [k for k, key in enumerate(keys) if tags.get(key) == TIME]
    named = mapped or [k for k, key in enumerate(keys) if key in TIMES]
    named = named or [0] * (keys[:1] in ([""], ["index"], ["unnamed: 0"]))
    if not named or cells.empty:
        raise UsageError(
            f"{table.where}: no header with a column of time above readings: {','.join(table.names)[:80]!r}; "
            "--map COLUMN=time_s names it"
        )
    date, clock = (next((k for k in named if keys[k] in known), None) for known in (DATES, CLOCKS))
    if date is not None and clock is not None:
        cells[date] = cells[clock] = cells[date] + " " + cells[clock]
        return sorted((date, clock))
    return [k for k in named if keys[k] == keys[named[0]]]


def _good(readings: Frame, table: Table, request: Request, said: list[str]) -> Frame:
    """Return time in seconds and value of the readings that are good, in the order of time."""
    more = {text.casefold() for text in request.good}
    values = readings.value.map(table.number).astype(float)
    is_number, is_empty = np.isfinite(values), readings.value.eq("")
    judged = readings.quality.map({text: is_good(text, more) for text in readings.quality.unique()}).astype(bool)
    texts = {*readings.name} - {*readings.name[is_number]}
    said += [f"left out   {', '.join(sorted(texts))}: no numbers"] if texts else []
    for what, words in (
        ("not good by quality", readings.quality[is_number & ~judged]),
        ("no number", readings.value[~is_number & ~is_empty & ~readings.name.isin(texts)]),
    ):
        counts = ", ".join(f"{word!r} {count}" for word, count in words.value_counts().head(5).items())
        said += [f"dropped    {len(words)} readings, {what}: {counts}"] if len(words) else []
    readings = readings.assign(time=_seconds(readings.stamp, readings.line, table, request, said), value=values)
    steps = readings.groupby("name").time.diff()
    if (steps < 0).any() and not (steps > 0).any():
        said.append("turned     the newest reading was first")
        readings = readings[::-1]
    elif (steps < 0).any():
        back = readings[(steps < 0).to_numpy()].iloc[0]
        raise UsageError(
            f"{table.where}, line {back.line}: time goes back to {back.stamp}; sort it by time, and where clocks were "
            "put back export UTC, or stamps with the offset of their zone"
        )
    readings = readings[np.isfinite(readings.value) & readings.quality.map(lambda text: is_good(text, more))]
    double = readings.duplicated(["name", "time"], keep="last")
    said += [f"dropped    {double.sum()} readings at the time of a later one"] if double.any() else []
    return readings[~double]


def _seconds(stamps: Frame, lines: Frame, table: Table, request: Request, said: list[str]) -> Array:
    """Return stamps in seconds: numbers, or dates of any form that is the same in all."""
    texts = stamps.drop_duplicates()
    numbers = texts.map(table.number).to_numpy(float)
    if np.isfinite(numbers).all():
        found = pd.Series(numbers * _unit_s(numbers, table))
    else:
        clear = texts.str.replace(r"(:\d\d),(?=\d)", r"\1.", regex=True)
        zoned = clear.str.contains(WITH_ZONE)
        day = bool(clear.str.match(r"\d\d?\.\d").any())  # in 31.12.2026 the day comes first, in others it may
        forms: dict[str, Any] = {"format": "mixed", "utc": True, "errors": "coerce"}
        ways = [pd.to_datetime(clear, dayfirst=way, **forms) for way in (day, not day)]
        dates = min(ways, key=lambda way: (way.isna().sum(), np.ptp(way.dropna().astype("int64"))))
        if not zoned.any() and request.zone is not None:
            dates = dates.dt.tz_localize(None).dt.tz_localize(request.zone, ambiguous="NaT", nonexistent="NaT")
        dates = dates.where(zoned == zoned.iloc[0])
        if dates.isna().any():
            stamp = texts[dates.isna()].iloc[0]
            line = lines[(stamps == stamp).to_numpy()].iloc[0]
            raise UsageError(
                f"{table.where}, line {line}: {stamp!r} is no time, has no zone or one unlike the others, or is "
                "there twice or never as clocks are changed; export stamps as in 2026-03-29T01:30:00Z"
            )
        of = "" if zoned.any() or request.zone else ", of an unknown zone"
        said.append(f"times      {dates.min()} to {dates.max()}{of}")
        found = (dates - dates.min()).dt.total_seconds()
    return np.asarray(stamps.map(dict(zip(texts, found, strict=True))), float)


def _unit_s(numbers: Array, table: Table) -> float:
    """Return the seconds that 1 is: by its size since 1970, else by the end of the name of the column."""
    largest = float(np.abs(numbers).max())
    if largest > SINCE_1970[0]:
        return float(1e-3 ** sum(largest > bound for bound in SINCE_1970[1:]))
    name = next((name for name in table.names if plain(name) in TIMES), "")
    named = next((factor for unit, factor in UNITS.items() if re.search(rf"[\W_]{unit}\W*$", name)), None)
    is_day = DAYS[0] < numbers.min() and largest < DAYS[1] and np.median(np.abs(np.diff(numbers))) < DAY_STEP
    return named or (86_400.0 if is_day else 1.0)


def _record(signals: Mapping[str, tuple[Array, Array]], request: Request, said: list[str]) -> str:
    usual = {name: float(np.median(np.diff(times))) for name, (times, _) in signals.items()}
    longest = max(each for name, each in usual.items() if name not in request.inputs)
    meant = float(f"{longest:.2g}")
    period_s = request.every_s or (meant if abs(meant - longest) < SNAP * longest else longest)
    even = [name for name in signals if name not in request.inputs or usual[name] <= BY_CHANGE * period_s]
    start = max(times[0] for times, _ in signals.values())
    length_s = max(0.0, min(signals[name][0][-1] for name in even) - start)
    grid = np.arange(int(length_s / period_s + EARLY) + 1, dtype=np.float64) * np.float64(period_s)
    columns, covered = {"time_s": grid}, np.ones(len(grid), bool)
    for name, (times, values) in signals.items():
        at = times - start
        without, step = np.diff(at), np.abs(np.diff(values)) > STEP * values.std() if name in request.inputs else False
        cut = (without > (request.gap_s or GAP * period_s)) | (step & (without > MISSING * usual[name]))
        for k in np.flatnonzero(cut) if name in even else ():
            covered &= (grid <= at[k]) | (grid >= at[k + 1])
        columns[name] = (_held if name in request.inputs else _averaged)(at, values, grid, period_s)
    pieces = np.split(np.arange(len(grid)), np.flatnonzero(np.diff(covered)) + 1)
    pieces = [piece for piece in pieces if covered[piece].all() and len(piece) >= FEWEST]
    if not pieces:
        raise UsageError(f"{request.path}: too short: nowhere {FEWEST} rows of {period_s:g} s with all signals")
    outputs = ", ".join(name for name in signals if name not in request.inputs)
    spans = ", ".join(f"{grid[piece[0]]:g} to {grid[piece[-1]]:g} s" for piece in pieces)
    said.append(f"resampled  to {period_s:g} s: held {', '.join(request.inputs)}; averaged {outputs}")
    said.append(f"record     {sum(map(len, pieces))} of {len(grid)} rows, pieces without gaps: {spans}")
    rows = np.concatenate(pieces)
    number = np.repeat(np.arange(1, len(pieces) + 1), [len(piece) for piece in pieces])
    lines = np.column_stack([number, *(column[rows] for column in columns.values())])
    cells = (",".join(f"{value:.10g}" for value in line) for line in lines)
    return "\n".join([",".join([PIECE, *columns]), *cells]) + "\n"


def _held(at: Array, values: Array, grid: Array, period_s: float) -> Array:
    """Return the mean of a signal that holds its values, from each time of the grid to the next."""
    edges = np.append(grid, grid[-1] + period_s)
    times = np.append(at, max(at[-1], edges[-1]) + period_s)
    areas = np.concatenate([[0.0], np.cumsum(values * np.diff(times))])
    return np.asarray(np.diff(np.interp(edges, times, areas)) / period_s)


def _averaged(at: Array, values: Array, grid: Array, period_s: float) -> Array:
    """Return the mean of the readings in the period up to each time; where they are too few, the line between two."""
    places = np.ceil(at / period_s - EARLY).astype(int)
    inside = (places >= 0) & (places < len(grid))
    counts, sums = (np.bincount(places[inside], of, len(grid)) for of in (inside[inside], values[inside]))
    if np.median(np.diff(at)) > period_s / 2:
        return np.interp(grid, at, values)
    return np.interp(grid, grid[counts > 0], sums[counts > 0] / counts[counts > 0])
