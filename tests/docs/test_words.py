"""Words and numbers of the pages that are those of the programs."""

import re
import struct
from pathlib import Path

from coldloop.modbus.requests import MAX_READ_WORDS
from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.common import MAGIC, AlarmKind
from coldloop.registers.control_plc import Verdict
from coldloop.service.journal import alarm_word
from coldloop_control_plc.alarms import PASSING, AlarmSettings
from tests.harness.records import CONTROL_MAP

DOCS = Path(__file__).parents[2] / "docs"


def test_alarms_are_called_what_they_are_called_with_their_priorities() -> None:
    page = (DOCS / "fail-safe.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d) \w+ \|.*\| ([^|]+) \|$", page, re.MULTILINE)
    told = {(int(priority), name) for priority, names in rows for name in re.findall(r"`([^`]+)`", names)}
    settings = AlarmSettings()
    assert told == {(int(settings.rule(kind).priority), alarm_word(kind, COLD_BOX)) for kind in AlarmKind}
    passing = re.search(r"happens at an instant \(([^)]+)\)", page)
    assert passing is not None
    assert set(re.findall(r"`([^`]+)`", passing[1])) == {kind.word for kind in PASSING}


def test_the_verdicts_of_the_link_page_are_those_of_the_registers() -> None:
    page = (DOCS / "link.md").read_text(encoding="utf-8").partition("| verdict |")[2].partition("\n\n")[0]
    rows = [(int(number), name.lower()) for number, name in re.findall(r"^\| (\d+) ([^|]+?) \|", page, re.MULTILINE)]
    assert rows == [(verdict.value, verdict.word) for verdict in Verdict if verdict]


def test_the_alarms_of_the_scada_page_are_read_as_the_block_lies() -> None:
    alarms = next(block for block in CONTROL_MAP.blocks if block.name == "alarms")
    first, words = alarms.address, MAX_READ_WORDS // alarms.row_words * alarms.row_words
    spans = f"{first} to {first + words - 1}, {first + words} to {first + 2 * words - 1}"
    page = (DOCS / "scada.md").read_text(encoding="utf-8")
    assert f"| alarms, a row of {alarms.row_words} words each, " in page
    assert f"{words // alarms.row_words} rows a request: {spans}, and so on | {words}, the last less" in page


def test_what_a_wrong_word_order_shows_is_what_it_shows() -> None:
    page = (DOCS / "scada.md").read_text(encoding="utf-8")
    high, low = struct.unpack(">HH", struct.pack(">f", MAGIC))
    (swapped,) = struct.unpack(">f", struct.pack(">HH", low, high))
    assert f"| {swapped:g}, from all three servers | the word order |" in page
    ends = (struct.unpack(">f", struct.pack(">HH", low, second))[0] for second in (0, 0xFFFF))
    least, largest = (f"{end:.5g}" for end in ends)
    assert f"between {least} and {largest}" in page


def test_requests_for_trends_are_written_as_they_can_be_sent() -> None:
    page = (DOCS / "operator-page.md").read_text(encoding="utf-8")
    assert not re.findall(r"GET /\S*=(?:&|`)", page), "an empty value is no number"
