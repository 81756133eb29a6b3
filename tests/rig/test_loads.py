"""Loads: the named hours, and what users write into CSV files."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from coldloop.errors import LoadFileError
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.load_profile import LoadProfile
from coldloop_plant.load import HOUR_TICKS, NAMED, find_load

Write = Callable[[str | bytes], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def make(content: str | bytes) -> Path:
        path = tmp_path / "load.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return make


def by_the_tick(load: LoadProfile, hours: int) -> list[float]:
    return [load.value(tick) for tick in range(hours * HOUR_TICKS)]


@pytest.mark.parametrize("name", NAMED)
def test_a_named_load_is_always_the_same_and_lasts_as_long_as_it_says(name: str) -> None:
    load = find_load(name, 385.0, COLD_BOX)
    assert load == find_load(name, 385.0, COLD_BOX)
    hours = len(NAMED[name])
    assert (hours - 1) * HOUR_TICKS < load.times[-1] < hours * HOUR_TICKS
    assert min(load.watts) >= 0
    assert len(set(load.watts)) > 1


@pytest.mark.parametrize("name", NAMED)
def test_a_named_load_moves_about_the_mean_that_it_is_given(name: str) -> None:
    low, high = find_load(name, 385.0, COLD_BOX), find_load(name, 400.0, COLD_BOX)
    assert low.times == high.times
    assert [after - before for before, after in zip(low.watts, high.watts, strict=True)] == [15.0] * len(low.watts)


def test_the_hours_a_to_f_differ() -> None:
    assert len({find_load(name, 385.0, COLD_BOX) for name in "abcdef"}) == 6


@pytest.mark.parametrize(("whole", "parts"), [("2h", "ab"), ("6h", "abcdef")])
def test_a_long_load_is_its_hours_one_after_the_other(whole: str, parts: str) -> None:
    joined = [watts for part in parts for watts in by_the_tick(find_load(part, 385.0, COLD_BOX), 1)]
    assert by_the_tick(find_load(whole, 385.0, COLD_BOX), len(parts)) == joined


def test_a_csv_file_holds_each_step_until_the_next(write: Write) -> None:
    load = find_load(str(write("time_s,load_w\n0,385\n10.25,400.5\n60,385\n")), 0.0, COLD_BOX)
    assert load == LoadProfile((0, 41, 240), (385.0, 400.5, 385.0))


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbftime_s,load_w\r\n0,385\r\n5,400\r\n",
        "load_w,remark,time_s\n385,calm,0\n400,busy,5\n",
        "time_s,load_w\n0,385\n\n5,4e2\n",
        "time_s , load_w\n0, 385\n5, 400\n,\n,\n",
        "sep=;\r\ntime_s;load_w\r\n0;385,0\r\n5,00;400,0\r\n",
        "Load of the day\n\nTime_s\tLoad_W [W]\ns\tW\n0\t385\n5\t400\n",
        '"time_s","load_w\n(W)",Quality\n"2026-03-01T10:00:00Z","385",192\n"2026-03-01T11:00:05+01:00","400",Good\n',
        "time_s;load_w;\u00e9tat\n0;385;\n5;400;\n".encode("utf-16"),
        "time_s,load_w,degr\u00e9\n0,385,\n5,400,\n".encode("latin-1"),
    ],
    ids=[
        "a byte-order mark and CRLF",
        "other columns",
        "an empty line",
        "blanks and rows of commas",
        "semicolons and decimal commas",
        "lines before the header, tabs and units",
        "a header over two lines, ISO times",
        "UTF-16",
        "Latin-1",
    ],
)
def test_a_csv_file_as_spreadsheets_save_it_is_read(content: str | bytes, write: Write) -> None:
    assert find_load(str(write(content)), 0.0, COLD_BOX) == LoadProfile((0, 20), (385.0, 400.0))


@pytest.mark.parametrize(
    ("content", "where", "remedy"),
    [
        ("time_s,load_w\n0,385\n5,nan\n", "line 3", "finite"),
        ("time_s,load_w\n0,inf\n", "line 2", "finite"),
        ("time_s,load_w\n0,much\n", "line 2", "number"),
        ("time_s,load_w\n0\n", "line 2", "number"),
        ("time_s,load_w\n0,1\n10,2\n5,3\n", "line 4", "sort"),
        ("time_s,load_w\n0,1\n0,2\n", "line 3", "sort"),
        ("time_s,load_w\n0,-5\n", "line 2", "outside 0 to"),
        ("time_s,load_w\n0,5\n0.3,5\n", "line 3", "multiple of 0.25"),
        ("time_s,load_w\n5,385\n", "line 2", "begin at 0 s"),
        ("time_s,load\n0,385\n", "load_w", "time_s,load_w"),
        ("", "time_s", "time_s,load_w"),
        ("Dear all,\nplease find attached\n", "time_s", "time_s,load_w"),
        ("time_s,load_w\n", "no line of numbers", "add some"),
        (b"time_s,load_w\n0,\xff\n", "line 2", "is no finite number"),
        ("time_s,load_w,quality\n0,385,192\n5,400,Bad\n", "line 3, quality: 'Bad'", "coldloop import"),
        ('time_s,load_w\n0,385\n"5,5",400\n', "line 3, time_s: '5,5'", "finite"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "byte 0", "UTF-8"),
    ],
)
def test_a_bad_csv_file_is_told_in_one_line_with_place_and_remedy(
    content: str | bytes, where: str, remedy: str, write: Write
) -> None:
    path = write(content)
    assert_told(path, str(path), where, remedy)


def assert_told(load: Path, *parts: str) -> None:
    with pytest.raises(LoadFileError) as caught:
        find_load(str(load), 385.0, COLD_BOX)
    message = str(caught.value)
    assert "\n" not in message
    for expected in parts:
        assert expected in message


@pytest.mark.parametrize(
    ("content", "place"),
    [
        pytest.param("time_s,load_w\n0,385\n1e308,400\n", "line 3", id="a time beyond all ticks"),
        pytest.param("time_s,load_w\n0,385\n2e9,400\n", "line 3", id="a time beyond 32 bits of ticks"),
        pytest.param("time_s,load_w\n0,1e39\n", "line 2", id="a load beyond single precision"),
        pytest.param("time_s,load_w\n0,20000\n", "line 2", id="a load that the plant's registers refuse"),
        pytest.param('time_s,load_w\n0,"' + "3" * 200_000 + '"\n', "line 2", id="a field without end"),
    ],
)  # fmt: skip
def test_a_load_that_the_plant_cannot_hold_is_told_when_it_is_read(content: str, place: str, write: Write) -> None:
    path = write(content)
    assert_told(path, str(path), place)


def test_a_folder_is_not_a_load(tmp_path: Path) -> None:
    assert_told(tmp_path, str(tmp_path), "not a regular file", "name a readable CSV file")


def test_a_load_that_is_neither_a_name_nor_a_file_is_told_with_the_names(tmp_path: Path) -> None:
    assert_told(tmp_path / "absent.csv", "absent.csv", "neither a file", "a, b, c, d, e, f, 2h, 6h")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_told(write: Write) -> None:
    path = write("time_s,load_w\n0,385\n")
    path.chmod(0)
    assert_told(path, str(path), "ermission", "readable")


def test_another_draw_is_of_the_same_family_at_other_instants(mean_load: float) -> None:
    first, again, second = (find_load(name, mean_load, COLD_BOX) for name in ("c", "c@1", "c@2"))
    assert first == again
    assert second.times != first.times
    assert set(second.watts) == set(first.watts)


@pytest.mark.parametrize("name", ["c@", "c@0", "c@-1", "c@two"])
def test_a_draw_is_a_number_from_1_on(name: str, mean_load: float) -> None:
    with pytest.raises(LoadFileError, match="write c@2"):
        find_load(name, mean_load, COLD_BOX)
