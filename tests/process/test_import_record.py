"""`coldloop import`: shapes in which historians and spreadsheets write the same record, and what is found in it."""

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.errors import ColdloopError
from coldloop_rig.process_file.historian import Request, record_of
from coldloop_rig.process_file.reading import read_process_file
from coldloop_rig.process_file.step_test import from_step_test
from tests.process.test_step_test import FILE, answered, steps

Array = NDArray[np.float64]
Row = list[Any]
SAMPLES: Final = 200
SPRING: Final = datetime(2026, 3, 29, 0, 50, tzinfo=UTC)
"""Ten minutes before the clocks of Berlin are put forward."""
AUTUMN: Final = datetime(2026, 10, 25, 0, 50, tzinfo=UTC)
"""And back."""
BERLIN: Final = ZoneInfo("Europe/Berlin")
HEADER: Final = ["time_s", "a", "b", "y", "z"]


def readings() -> list[Row]:
    """Return times and values of a record of sensors with a noise of 0.005."""
    u = steps(SAMPLES, seed=4)
    rows = np.column_stack([5.0 * np.arange(SAMPLES), u + np.array([10.0, 5.0]), answered(u, noise=0.005)])
    return [[float(f"{value:.7g}") for value in row] for row in rows]


CLEAN: Final = readings()


def text(
    rows: Sequence[Sequence[object]], separator: str = ",", end: str = "\n", header: Sequence[str] = HEADER
) -> str:  # fmt: skip
    """Return rows as a file."""
    return "".join(separator.join(map(str, row)) + end for row in [header, *rows])


def stamped(form: Callable[[datetime], str], begin: datetime = SPRING, rows: Sequence[Row] = CLEAN) -> list[Row]:
    """Return rows with dates for seconds."""
    return [[form(begin + timedelta(seconds=row[0])), *row[1:]] for row in rows]


def strftime(form: str, zone: Any = UTC) -> Callable[[datetime], str]:  # noqa: ANN401
    """Return what writes a date in a form, in the time of a zone."""
    return lambda date: date.astimezone(zone).strftime(form)


def iso(date: datetime) -> str:
    """Return a date as of ISO 8601, with zone."""
    return date.isoformat()


def with_cells(column: int, every: int, cell: object) -> list[Row]:
    """Return rows with another cell in each so many."""
    return [[*row[:column], cell if k % every == 3 else row[column], *row[column + 1 :]] for k, row in enumerate(CLEAN)]


def commas(row: Row) -> Row:
    """Return cells with decimal commas."""
    return [cell if isinstance(cell, str) else str(cell).replace(".", ",") for cell in row]


def long(rows: Sequence[Row], order: Callable[[Row], Any] = lambda _: 0) -> list[Row]:
    """Return a row for each reading."""
    found = [[row[0], name, value] for row in rows for name, value in zip(HEADER[1:], row[1:], strict=True)]
    return sorted(found, key=order)


def changes(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield a row for each reading, of the inputs only where they change."""
    last: dict[str, object] = {}
    for time_s, name, value in long(rows):
        if name in "yz" or last.get(name) != value:
            yield [time_s, name, value]
        last[name] = value


def own_periods() -> list[Row]:
    """Return rows with y each second, z and b each 5 s, and a by its changes: cells without a reading are empty."""
    rows = fine(1.0)
    return [
        [row[0], row[1] if k == 0 or row[1] != rows[k - 1][1] else "", row[2] if k % 5 == 0 else "", row[3],
         row[4] if k % 5 == 0 else ""]
        for k, row in enumerate(rows)
    ]  # fmt: skip


def fine(period_s: float) -> list[Row]:
    """Return a record of shorter periods: inputs are held, outputs between readings lie on a line."""
    times, found = np.arange(0.0, CLEAN[-1][0], period_s), np.array(CLEAN)
    held = found[(times // 5.0).astype(int), 1:3]
    return np.column_stack([times, held, *(np.interp(times, found[:, 0], found[:, k]) for k in (3, 4))]).tolist()


def uneven() -> list[Row]:
    """Return a record at times that are late by up to a tenth of the period."""
    late = np.random.default_rng(3).uniform(0.0, 0.5, SAMPLES)
    found = np.array(CLEAN)
    at = found[:, 0] + late
    outputs = [np.interp(at, found[:, 0], found[:, k]) for k in (3, 4)]
    return np.column_stack([at, found[:, 1:3], *outputs]).round(6).tolist()


def pairs() -> list[Row]:
    """Return a column of time for each signal, as spreadsheets are filled by a historian."""
    return [[cell for value in row[1:] for cell in (iso(SPRING + timedelta(seconds=row[0])), value)] for row in CLEAN]


NO_ZONE: Final = strftime("%Y-%m-%d %H:%M:%S", BERLIN)
CALL: Final[dict[str, Any]] = {"zone": "Europe/Berlin"}
SHAPES: Final[dict[str, tuple[str | bytes, dict[str, Any]]]] = {
    "plain": (text(CLEAN), {}),
    "byte order mark": ("\ufeff" + text(CLEAN), {}),
    "CR LF": (text(CLEAN, end="\r\n"), {}),
    "quotes": (text([[f'"{cell}"' for cell in row] for row in CLEAN]), {}),
    "blanks": (text(CLEAN, separator=" , "), {}),
    "seconds since 1970": (text([[SPRING.timestamp() + row[0], *row[1:]] for row in CLEAN]), {}),
    "milliseconds since 1970": (text([[int(1e3 * (SPRING.timestamp() + row[0])), *row[1:]] for row in CLEAN]), {}),
    "milliseconds from the start": (
        text([[1000 * row[0], *row[1:]] for row in CLEAN], header=["time_ms", *HEADER[1:]]), {},
    ),
    "days of a spreadsheet": (
        text([[46110.0 + row[0] / 86400.0, *row[1:]] for row in CLEAN], header=["Time", *HEADER[1:]]), {},
    ),
    "another start": (text([[row[0] + 1234.5, *row[1:]] for row in CLEAN]), {}),
    "semicolons": (text(CLEAN, separator=";"), {}),
    "semicolons, decimal commas": (text(map(commas, CLEAN), separator=";"), {}),  # type: ignore[arg-type]
    "tabs": (text(CLEAN, separator="\t"), {}),
    "a hint at the separator": ("sep=;\n" + text(CLEAN, separator=";"), {}),
    "UTF-16": (text(CLEAN, separator="\t").encode("utf-16"), {}),
    "Latin-1": (text(CLEAN, header=[*HEADER[:3], "y (\u00b0C)", "z"]).encode("latin-1"), {}),
    "ISO, UTC": (text(stamped(strftime("%Y-%m-%dT%H:%M:%SZ"))), {}),
    "ISO, offset": (text(stamped(iso)), {}),
    "ISO, offset in summer and winter": (text(stamped(strftime("%Y-%m-%dT%H:%M:%S%z", BERLIN), AUTUMN)), {}),
    "zone by option, spring": (text(stamped(NO_ZONE)), CALL),
    "no zone at all": (text(stamped(strftime("%Y-%m-%d %H:%M:%S"))), {}),
    "fractions of a second": (text(stamped(lambda date: (date + timedelta(milliseconds=250)).isoformat(" "))), {}),
    "day before month": (
        text(stamped(strftime("%d.%m.%Y %H:%M:%S"), datetime(2026, 3, 2, 0, 50, tzinfo=UTC))), {"zone": "UTC"},
    ),
    "German dates": (text(map(commas, stamped(strftime("%d.%m.%Y %H:%M:%S"))), separator=";"), {}),  # type: ignore[arg-type]
    "American dates": (text(stamped(strftime("%m/%d/%Y %I:%M:%S %p"))), {}),
    "names of months": (text(stamped(strftime("%d-%b-%y %H:%M:%S"))), {}),
    "date and time of day": (
        text([[*row[0].split(), *row[1:]] for row in stamped(NO_ZONE)], header=["Date", "Time", *HEADER[1:]]), CALL,
    ),
    "empty cells": (text(with_cells(3, 17, "")), {}),
    "missing lines": (text([row for k, row in enumerate(CLEAN) if k % 23 != 5]), {}),
    "double lines": (text([row for k, row in enumerate(CLEAN) for _ in range(1 + (k % 9 == 0))]), {}),
    "gaps": (text([row for k, row in enumerate(CLEAN) if not (50 < k < 70 or 120 < k < 132)]), {}),
    "a word for a reading": (text(with_cells(4, 29, "Bad")), {}),
    "words of historians": (text(with_cells(3, 31, "[-11059] No Good Data For Calculation")), {}),
    "quality 192": (
        text([[*row, 0 if row[3] == 999.0 else 192] for row in with_cells(3, 31, 999.0)], header=[*HEADER, "Quality"]),
        {},
    ),
    "quality of each": (
        text([[*row[:4], "Good", row[4], "Uncertain" if row[4] == 999.0 else "Good (192)"]
              for row in with_cells(4, 31, 999.0)],
             header=["Time", "a", "b", "y", "y.Status", "z", "z.Quality"]), {},
    ),
    "quality beside each": (
        text([[row[0], *(cell for value in row[1:] for cell in (value, "G"))] for row in CLEAN],
             header=["Time", *(cell for name in HEADER[1:] for cell in (name, "Quality"))]), {},
    ),
    "quality of OPC UA": (text([[*row, 0] for row in CLEAN], header=[*HEADER, "StatusCode"]), {"good": ("0",)}),
    "units below the header": (text([["s", "V", "V", "cm", "-"], *CLEAN]), {}),
    "units in the header": (text(CLEAN, header=["Time [s]", "a [V]", "b [V]", "y (cm)", "z"]), {}),
    "a header over two lines": (text(CLEAN, header=["time_s", "a", "b", '"y\n(cm)"', "z"]), {}),
    "other capitals": (text(CLEAN, header=["TIMESTAMP", "A", "B", "Y", "Z"]), {}),
    "lines before and behind": (
        "Report of 2026-04-01\nServer;PI01\n\n" + text(CLEAN, separator=";") + "(300 rows)\n", {},
    ),
    "a column of remarks": (text([[*row, "calm"] for row in CLEAN], header=[*HEADER, "remark"]), {}),
    "tags": (
        text([[*row, 1.0] for row in CLEAN], header=["Time", "P1.SP", "P2.SP", "\\\\PI01\\LT1.PV", "LT2.PV", "spare"]),
        {"names": {"P1.SP": "a", "P2.SP": "b", "\\\\PI01\\LT1.PV": "y", "LT2.PV": "z"}},
    ),
    "no name of the time": (text(CLEAN, header=["", *HEADER[1:]]), {}),
    "the newest first": (text(CLEAN[::-1]), {}),
    "each second": (text(fine(1.0)), {"every_s": 5.0}),
    "uneven times": (text(uneven()), {}),
    "a period for each": (text(own_periods()), {}),
    "a time for each": (text(pairs(), header=[cell for name in HEADER[1:] for cell in ("Time", name)]), {}),
    "a line for each reading": (text(long(stamped(iso)), header=["Timestamp", "Tag", "Value"]), {}),
    "sorted by tag": (text(long(CLEAN, lambda row: row[1]), header=["Time", "TagName", "Value"]), {}),
    "inputs where they change": (text([*changes(CLEAN)], header=["time", "tag", "value"]), {}),
}  # fmt: skip
TOLD: Final = {
    "semicolons, decimal commas": "semicolons between columns, decimal commas",
    "Latin-1": "read as Latin-1",
    "day before month": "times      2026-03-02 00:50:00+00:00 to 2026-03-02",
    "no zone at all": "of an unknown zone",
    "double lines": "92 readings at the time of a later one",
    "gaps": "pieces without gaps: 0 to 250 s, 350 to 600 s, 660 to 995 s",
    "a word for a reading": "7 readings, no number: 'Bad' 7",
    "quality 192": "28 readings, not good by quality: '0' 28",
    "quality of each": "7 readings, not good by quality: 'Uncertain' 7",
    "units below the header": "line 2 taken for units",
    "lines before and behind": "1 lines without a time or a reading",
    "a column of remarks": "left out   remark: no numbers",
    "tags": "left out   spare",
    "the newest first": "the newest reading was first",
}


def imported(folder: Path, content: str | bytes, given: dict[str, Any]) -> tuple[str, str]:
    """Return the record of a file, and what was said of it."""
    path = folder / "export.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    record, said = record_of(Request(path, **{"names": {}, "inputs": ("a", "b")} | given))
    return record, "\n".join(said)


def gains(folder: Path, record: str) -> Array:
    """Return what the model found in a record rests at."""
    (folder / "record.csv").write_text(record, encoding="utf-8")
    (folder / "process.toml").write_text(FILE, encoding="utf-8")
    model = from_step_test(read_process_file(folder / "process.toml"), folder / "record.csv")
    return np.asarray(model.C @ np.linalg.solve(-model.A, model.B))


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Array:
    """Return the gains of the record as it is."""
    return gains(tmp_path_factory.mktemp("clean"), text(CLEAN))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_of_a_record_gives_its_gains(shape: str, known: Array, tmp_path: Path) -> None:
    record, said = imported(tmp_path, *SHAPES[shape])
    assert gains(tmp_path, record) == pytest.approx(known, rel=0.01)
    assert TOLD.get(shape, "") in said


REFUSED: Final[dict[str, tuple[str, dict[str, Any], str]]] = {
    "no header": ("".join(text(CLEAN).partition("\n")[2:]), {}, "no header with a column of time"),
    "no lines": (text([]), {}, "no header with a column of time above readings"),
    "time that goes back": (
        text([*CLEAN[:50], CLEAN[51], CLEAN[50], *CLEAN[52:]]), {}, "line 53: time goes back to 250.0",
    ),
    "an hour that is there twice": (text(stamped(NO_ZONE, AUTUMN)), {}, "time goes back to 2026-10-25 02:00:00"),
    "such an hour, zone by option": (text(stamped(NO_ZONE, AUTUMN)), CALL, "line 2: '2026-10-25 02:50:00' is no time"),
    "too short": (text(CLEAN[:8]), {}, "too short: nowhere 10 rows of 5 s"),
    "no such tag": (text(CLEAN), {"names": {"LT3": "x"}}, "none of 'time_s, a, b, y, z' is a signal"),
    "two columns of one name": (text(CLEAN, header=["time", "a", "b", "y", "y"]), {}, "two columns are y; remove one"),
    "no outputs": (text(CLEAN), {"inputs": tuple("abyz")}, "no readings of outputs beside the inputs"),
    "quality that belongs to none": (
        text([[*row, 192, 192] for row in CLEAN], header=[*HEADER, "p.Quality", "r.Quality"]), {},
        "p.Quality, r.Quality: whose?",
    ),
    "nothing that is good": (
        text([[*row, 0] for row in CLEAN], header=[*HEADER, "quality"]), {},
        "no readings of a, b; there are some of nothing; dropped 800 readings, not good by quality: '0' 800",
    ),
    "a workbook": ("PK\x03\x04\0\0", {}, "no header"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_an_export_that_is_no_record_gets_one_line(case: str, tmp_path: Path) -> None:
    content, given, told = REFUSED[case]
    with pytest.raises(ColdloopError) as refused:
        imported(tmp_path, content, given)
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)
