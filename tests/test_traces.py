"""The judge of traces on record, by tables written by hand; no run."""

from copy import deepcopy
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.harness.traces import __main__ as program
from tests.harness.traces import record as files
from tests.harness.traces.checks import BLOCK_ROWS, Table, checked, difference
from tests.harness.traces.configurations import CONFIGURATIONS
from tests.harness.traces.judge import Left, Names, differences, unmatched
from tests.harness.traces.record import Found, Platform, Record, RecordError

ROWS = 100
NAMES = Names(
    trace=["load", "u0", "u1", "y0", "y1", "y2"], updates=["update", "tick", "j_dev"], indicators=["J_dev", "c1"]
)
HERE = Platform(python="3.11.7", numpy="2.4.6", scipy="1.17.1", numba="0.68.1", processor="Haswell")
TODAY = date(2026, 1, 31)


def groups() -> list[Any]:
    """Return three columns of inputs and three of outputs."""
    numbers = np.arange(ROWS * 6, dtype=np.float32).reshape(ROWS, 6)
    return [numbers[:, :3].copy(), numbers[:, 3:].copy()]


def updates() -> list[Any]:
    numbers = np.arange(30, dtype=float).reshape(10, 3)
    return [numbers[:, :2].copy(), numbers[:, 2:].copy()]


def left(trace: list[Any] | None = None, made: list[Any] | None = None, processor: str = "") -> Left:
    found = Left(
        process="cold box",
        trace=checked(trace or groups()),
        end=["1.5 2.5", "0.1"],
        updates=checked(made or updates()),
        instants=" ".join(str(10 * number) for number in range(10)),
        events=["0 2 40 7 1", "0 3 90 7 1"],
        indicators=["0.1", "nan"],
    )
    if processor:
        found["processor"] = processor
    return found


def found_of(**configurations: Left) -> Found:
    return Found(
        made_with=HERE, services=["control_plc", "plant"], names={"cold box": NAMES}, configurations=configurations
    )


def record_of(**configurations: Left) -> Record:
    return files.renewed(None, found_of(**configurations), [*configurations], "first", TODAY)


def told(recorded: Left, found: Left) -> list[str]:
    return list(differences(recorded, found, NAMES))


def test_what_is_the_same_has_no_difference() -> None:
    assert told(left(), left()) == []


@pytest.mark.parametrize("tick", [0, BLOCK_ROWS - 1, BLOCK_ROWS, 57, ROWS - 1])
@pytest.mark.parametrize(
    ("group", "place", "named"), [(0, 0, "0 load"), (0, 2, "2 u1"), (1, 0, "3 y0"), (1, 2, "5 y2")]
)
def test_the_last_bit_of_one_value_is_named_by_tick_and_column(tick: int, group: int, place: int, named: str) -> None:
    trace = groups()
    trace[group][tick, place] = np.nextafter(trace[group][tick, place], np.float32(np.inf))
    assert told(left(), left(trace)) == [f"tick {tick}: column {named}"]


def test_columns_that_differ_later_are_counted_only() -> None:
    trace = groups()
    trace[0][40:, 1] += 1.0
    trace[1][41:] += 1.0
    assert told(left(), left(trace)) == ["tick 40: column 1 u0; 3 other columns elsewhere"]


def test_every_nan_is_the_same_and_zero_has_a_sign() -> None:
    one, other, signed = groups(), groups(), groups()
    one[0][5, 1] = np.nan
    other[0][5, 1] = np.array(0x7FC0_0001, dtype=np.uint32).view(np.float32)
    assert told(left(one), left(other)) == []
    signed[0][0, 0] = -0.0
    assert told(left(), left(signed)) == ["tick 0: column 0 load"]


def test_a_row_whose_check_is_the_same_by_chance_is_named_by_its_block() -> None:
    """What the rows do not tell the blocks do, and what these do not the digests."""
    recorded = checked(groups())
    found = deepcopy(recorded)
    words = found["blocks"][2].split()
    words[-1] = words[-1][:2] + ("00" if words[-1][2:4] != "00" else "01") + words[-1][4:]
    found["blocks"][2] = " ".join(words)
    found["columns"][0] = _other_digest(found, 1)
    seen = difference(recorded, found)
    assert seen is not None
    assert (seen.first, seen.last, seen.columns) == (32, 47, (1,))
    found["blocks"] = recorded["blocks"]
    seen = difference(recorded, found)
    assert seen is not None
    assert (seen.first, seen.last, seen.columns) == (0, ROWS - 1, (1,))


def _other_digest(table: Table, column: int) -> str:
    digests = table["columns"][0].split()
    digests[column] = "0" * 8
    return " ".join(digests)


def test_a_trace_that_is_shorter_says_so_and_is_compared_as_far_as_it_goes() -> None:
    short = [group[:90] for group in groups()]
    assert told(left(), left(short)) == ["ticks: 100 on record, now 90"]
    short[1][20, 1] = -1.0
    assert told(left(), left(short)) == [
        "ticks: 100 on record, now 90", "tick 20: column 4 y1; 5 other columns elsewhere"
    ]  # fmt: skip


def test_a_column_more_is_said_without_a_comparison() -> None:
    wider = [groups()[0], np.hstack([groups()[1], groups()[1][:, :1]])]
    assert told(left(), left(wider)) == ["columns: 3 + 3 on record, now 3 + 4"]


def test_the_last_bit_of_a_state_after_the_last_tick_is_named() -> None:
    found = left()
    found["end"] = ["1.5 2.5", "0.10000000000000002"]
    assert told(left(), found) == ["after tick 99: column 5 y2: 0.1, now 0.10000000000000002"]
    found["end"] = ["1.5 2.6", "0.10000000000000002"]
    assert told(left(), found) == ["after tick 99: column 4 y1: 2.5, now 2.6; 1 other columns too"]


def test_an_update_is_named_by_number_and_field() -> None:
    made = updates()
    made[1][7, 0] += 1e-12
    assert told(left(), left(made=made)) == ["update 7 at tick 70: field 2 j_dev"]


def test_no_updates_are_a_table_too() -> None:
    none = [np.empty((0, 2)), np.empty((0, 1))]
    assert told(left(made=none), left(made=none)) == []
    assert told(left(made=none), left()) == ["updates: 0 on record, now 10"]


def test_a_changed_event_and_a_new_one_are_named_once() -> None:
    found = left()
    found["events"] = ["0 2 40 7 1", "0 3 91 7 1", "0 2 95 7 1"]
    assert told(left(), found) == [
        "events: 2 on record, now 3", "event 1: 0 3 90 7 1 on record, now 0 3 91 7 1"
    ]  # fmt: skip


def test_an_indicator_differs_in_its_last_digit_and_nan_does_not() -> None:
    found = left()
    found["indicators"] = ["0.10000000000000002", "nan"]
    assert told(left(), found) == ["indicator 0 J_dev: 0.1 on record, now 0.10000000000000002"]


def test_a_renaming_moves_no_trace() -> None:
    others = Names(trace=[*"abcdef"], updates=[*"abc"], indicators=[*"ab"])
    assert list(differences(left(), left(), others)) == []


def test_what_is_missing_and_what_is_too_much_are_named() -> None:
    assert list(unmatched(["kept", "gone"], ["kept", "new"], ["kept", "new"])) == [
        "new: is not on record", "gone: is on record, and no such configuration exists"
    ]  # fmt: skip


def test_another_kind_of_processor_is_skipped_where_it_matters() -> None:
    trace = groups()
    trace[0][3, 0] += 1.0
    record, found = (
        record_of(a=left(processor="Zen"), b=left()),
        found_of(a=left(trace, processor="Haswell"), b=left(trace)),
    )
    line = "a: skipped: its last bits are those of LAPACK on Zen, and this is Haswell"
    assert list(program.skips(record, found, "ab")) == [("a", line)]
    assert list(program.judged(record, found, "ab")) == ["b: tick 3: column 0 load"]


def test_a_record_with_its_reason_is_read_as_it_was_written(tmp_path: Path) -> None:
    file, trace = tmp_path / "traces.json", groups()
    trace[0][3, 0] += 1.0
    record = record_of(a=left(), b=left())
    assert record["reasons"] == [{"date": "2026-01-31", "reason": "first", "configurations": ["a", "b"]}]
    files.write(record, file)
    assert files.read(file) == record
    again = files.renewed(files.read(file), found_of(b=left(trace), c=left()), ["b", "c"], "b moves", TODAY)
    assert [*again["configurations"]] == ["b", "c"], "a is gone"
    assert [each["configurations"] for each in again["reasons"]] == [["b", "c"], ["a", "b"]]
    assert list(program.judged(again, found_of(b=left(trace)), ["b"])) == []


def test_a_file_that_is_too_large_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "traces.json"
    files.write(record_of(a=left()), file)
    before = file.read_text(encoding="utf-8")
    monkeypatch.setattr(files, "LARGEST_BYTES", len(before))
    with pytest.raises(RecordError, match=r"would have \d+ bytes, at most \d+: shorten some runs"):
        files.write(record_of(a=left(), b=left()), file)
    assert file.read_text(encoding="utf-8") == before


def test_a_file_that_is_missing_or_damaged_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="make one with scripts/traces --record REASON"):
        files.read(tmp_path / "none.json")
    (tmp_path / "half.json").write_text('{"reasons": [', encoding="utf-8")
    with pytest.raises(RecordError, match="take it back from the last commit"):
        files.read(tmp_path / "half.json")


def test_the_check_names_configuration_tick_and_column_and_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = [*CONFIGURATIONS][:2]
    trace = groups()
    trace[1][57, 1] += 1.0
    file = tmp_path / "traces.json"
    files.write(record_of(**{one: left(), other: left()}), file)
    monkeypatch.setattr(files, "FILE", file)
    monkeypatch.setattr(program, "found_now", lambda _: found_of(**{one: left(), other: left(trace)}))
    assert program.main([one]) == 0
    assert program.main([one, other]) == 1
    assert f"{other}: tick 57: column 4 y1\n" in capsys.readouterr().out


def test_the_file_holds_every_configuration_and_is_small() -> None:
    assert [*files.read()["configurations"]] == [*CONFIGURATIONS]
    assert files.FILE.stat().st_size <= files.LARGEST_BYTES
