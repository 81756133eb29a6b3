import io
import json
import logging
import subprocess
import sys
import threading
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from coldloop.service.start import CAPACITY, JsonFormatter, QueueingHandler, dropped, end_logs, set_up_logs
from tests.harness.processes import END_S, Processes


@pytest.fixture
def stream() -> Iterator[io.StringIO]:
    """A stream that the logs go to, and the loggers as they were afterwards."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    pymodbus = logging.getLogger("pymodbus").level
    root.handlers = []  # those of pytest must not be closed
    yield io.StringIO()
    for handler in root.handlers:
        handler.close()
    root.handlers, root.level = handlers, level
    logging.getLogger("pymodbus").setLevel(pymodbus)


def fail(message: str) -> None:
    raise ValueError(message)


def await_lines() -> None:
    """Wait until all lines are written, for longer than the end of a program does."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, QueueingHandler):  # pytest has its own
            assert handler.is_written(END_S)


def lines(stream: io.StringIO) -> list[dict[str, Any]]:
    await_lines()
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_a_record_is_one_json_object_on_one_line(stream: io.StringIO) -> None:
    set_up_logs("control_plc", "info", stream)
    log = logging.getLogger("coldloop.control_plc")
    log.info("session started", extra={"session": 3, "factor": 60.0})
    log.warning("two\nlines and a %s", "kelvin: µK")
    first, second = lines(stream)
    assert stream.getvalue().count("\n") == 2
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


class Unspeakable:
    def __str__(self) -> str:
        raise ValueError("no words")


def test_a_record_that_cannot_be_formatted_is_told_and_does_not_fail_who_logs_it(stream: io.StringIO) -> None:
    set_up_logs("plant", "info", stream)
    logging.getLogger("coldloop.plant").warning("applied", extra={"outputs": Unspeakable()})
    (line,) = lines(stream)
    assert (line["logger"], line["event"]) == ("coldloop.plant", "a record cannot be formatted")
    assert (line["text"], line["reason"]) == ("applied", "ValueError('no words')")


def test_setting_up_again_replaces_what_was_there(stream: io.StringIO) -> None:
    later = io.StringIO()
    set_up_logs("plant", "info", stream)
    set_up_logs("plant", "info", later)
    logging.getLogger("coldloop").info("once")
    assert len(lines(later)) == 1
    assert stream.getvalue() == ""
    assert sys.stderr is not stream


class Stalled(io.StringIO):
    """A stream on which the first write waits until somebody reads."""

    def __init__(self) -> None:
        super().__init__()
        self.reached, self.read = threading.Event(), threading.Event()

    def write(self, text: str) -> int:
        self.reached.set()
        self.read.wait(END_S)
        return super().write(text)


@pytest.fixture
def stalled(stream: io.StringIO) -> Iterator[Stalled]:  # noqa: ARG001 - which restores the loggers
    """A stream that nobody reads, with the logs of a service sent to it and the first line on its way."""
    one = Stalled()
    set_up_logs("plant", "info", one)
    logging.getLogger("coldloop").info("first")
    assert one.reached.wait(END_S)
    yield one
    one.read.set()


def log_many(count: int) -> None:
    for number in range(count):
        logging.getLogger(f"coldloop.{number}").info("event %d", number)


def test_while_nobody_reads_the_newest_lines_are_dropped_and_the_next_line_tells_how_many(stalled: Stalled) -> None:
    log_many(CAPACITY + 25)
    assert dropped() == 25
    stalled.read.set()
    before = lines(stalled)
    logging.getLogger("coldloop").info("read again")
    logging.getLogger("coldloop").info("and again")
    assert [line["event"] for line in before] == ["first", *(f"event {number}" for number in range(CAPACITY))]
    assert [line.get("dropped") for line in lines(stalled)[-2:]] == [25, None]
    assert dropped() == 25


def test_drops_that_no_line_has_told_are_told_by_the_last_one(stalled: Stalled) -> None:
    log_many(CAPACITY + 3)
    stalled.read.set()
    await_lines()
    end_logs()
    await_lines()
    last = json.loads(stalled.getvalue().splitlines()[-1])
    assert (last["event"], last["dropped"]) == ("lines dropped", 3)


def test_the_last_line_is_written_after_all_others(stream: io.StringIO) -> None:
    set_up_logs("plant", "info", stream)
    log_many(50)
    end_logs("plant: cannot listen")
    await_lines()
    assert stream.getvalue().count("\n") == 51
    assert stream.getvalue().endswith("\nplant: cannot listen\n")


PROGRAM = """
import logging
from coldloop.service.start import dropped, end_logs, set_up_logs
set_up_logs("plant", "info")
for number in range(3000):
    logging.getLogger(f"coldloop.{number}").info("x" * 100)
assert dropped() > 0
end_logs("the end")
"""


def test_a_program_whose_lines_nobody_reads_goes_on_and_ends(processes: Processes) -> None:
    program = processes.python("-c", PROGRAM, stderr=subprocess.PIPE).popen
    assert program.wait(END_S) == 0
    assert program.stderr is not None
    assert '"event": "xxx' in program.stderr.readline()


def test_a_program_whose_reader_has_gone_goes_on_and_ends(processes: Processes) -> None:
    program = processes.python("-c", PROGRAM, stderr=subprocess.PIPE).popen
    assert program.stderr is not None
    program.stderr.close()
    assert program.wait(END_S) == 0


def test_a_finaliser_may_log_while_a_line_is_put(stream: io.StringIO) -> None:
    set_up_logs("plant", "info", stream)
    (handler,) = (one for one in logging.getLogger().handlers if isinstance(one, QueueingHandler))

    def interrupted() -> None:
        with handler._changed:  # noqa: SLF001 as if garbage were collected in the midst of it
            assert handler.put("{}")

    thread = threading.Thread(target=interrupted, daemon=True)
    thread.start()
    thread.join(END_S)
    assert not thread.is_alive(), "the log waits for itself"
