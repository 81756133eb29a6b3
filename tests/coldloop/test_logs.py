import io
import json
import logging
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from coldloop.logs import JsonFormatter, set_up_logs


@pytest.fixture
def stream() -> Iterator[io.StringIO]:
    """A stream that the logs go to, and the loggers as they were afterwards."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    pymodbus = logging.getLogger("pymodbus").level
    root.handlers = []  # those of pytest must not be closed
    yield io.StringIO()
    root.handlers, root.level = handlers, level
    logging.getLogger("pymodbus").setLevel(pymodbus)


def fail(message: str) -> None:
    raise ValueError(message)


def lines(stream: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_a_record_is_one_json_object_on_one_line(stream: io.StringIO) -> None:
    set_up_logs("control_plc", "info", stream)
    log = logging.getLogger("coldloop.control_plc")
    log.info("session started", extra={"session": 3, "factor": 60.0})
    log.warning("two\nlines and a %s", "kelvin: µK")
    assert stream.getvalue().count("\n") == 2
    first, second = lines(stream)
    assert datetime.fromisoformat(first.pop("time")).tzinfo is not None
    assert first == {
        "level": "info",
        "service": "control_plc",
        "logger": "coldloop.control_plc",
        "event": "session started",
        "session": 3,
        "factor": 60.0,
    }
    assert (second["level"], second["event"]) == ("warning", "two\nlines and a kelvin: µK")


def test_an_exception_stays_on_the_line_of_its_event(stream: io.StringIO) -> None:
    set_up_logs("plant", "info", stream)
    try:
        fail("first line\nsecond line")
    except ValueError:
        logging.getLogger("coldloop.plant").exception("integration failed")
    (line,) = lines(stream)
    assert line["event"] == "integration failed"
    assert "Traceback" in line["error"]
    assert line["error"].endswith("ValueError: first line\nsecond line")


def test_what_json_does_not_know_is_written_as_text(stream: io.StringIO) -> None:
    set_up_logs("plant", "info", stream)
    logging.getLogger("coldloop").info("loaded", extra={"file": Path("model.json"), "peers": {1}})
    (line,) = lines(stream)
    assert (line["file"], line["peers"]) == ("model.json", "{1}")


def test_what_is_below_the_level_and_what_pymodbus_says_is_left_out(stream: io.StringIO) -> None:
    set_up_logs("plant", "warning", stream)
    logging.getLogger("coldloop").info("too much")
    logging.getLogger("pymodbus").error("said by our own client in better words")
    logging.getLogger("coldloop").error("heard")
    assert [line["event"] for line in lines(stream)] == ["heard"]


def test_the_time_is_that_of_the_record_in_utc() -> None:
    record = logging.makeLogRecord({"name": "coldloop", "levelname": "INFO", "msg": "event", "created": 1.5})
    assert json.loads(JsonFormatter("plant").format(record))["time"] == "1970-01-01T00:00:01.500+00:00"


def test_setting_up_again_replaces_what_was_there(stream: io.StringIO) -> None:
    later = io.StringIO()
    set_up_logs("plant", "info", stream)
    set_up_logs("plant", "info", later)
    logging.getLogger("coldloop").info("once")
    assert stream.getvalue() == ""
    assert len(lines(later)) == 1
    assert sys.stderr is not stream
