"""Events in words: what each number means, and numbers that nobody knows."""

import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.common import AlarmKind, Event, EventKind
from coldloop.registers.control_plc import Cause, LinkCause, Mode, OperatorMode, PlantLinkState, Verdict
from coldloop.registers.plant import SensorFaultKind
from coldloop.service.journal import Journal, describe, log_event, utc_text


def event(kind: int, subject: int = 0, cause: int = 0, value: float = 0.0, who: str = "") -> Event:
    journal = Journal(now=lambda: 1_700_000_000.007)
    journal.note(8, EventKind.NONE, subject, cause, value=value, who=who)
    return journal.since(0)[0]._replace(kind=kind)


@pytest.mark.parametrize(
    ("noted", "sentence"),
    [
        (event(EventKind.MODE, Mode.CLASSICAL, Cause.HOLD_EXPIRED), "mode: classical (hold expired)"),
        (event(EventKind.MODE, Mode.MPC), "mode: mpc"),
        (event(EventKind.ALARM_RAISED, AlarmKind.MODE, Cause.SENSOR_BAD), "alarm raised: mode (sensor bad)"),
        (event(EventKind.ALARM_RAISED, AlarmKind.SENSOR_BAD, 0), "alarm raised: sensor bad (L1)"),
        (event(EventKind.ALARM_RETURNED, AlarmKind.SEQUENCE_REJECTED, Verdict.PLANT_LOST),
         "alarm returned: sequence rejected (plant lost)"),
        (event(EventKind.ALARM_RAISED, AlarmKind.PLANT_OTHER_MASTER, LinkCause.SECOND_MASTER),
         "alarm raised: plant other master (second master)"),
        (event(EventKind.ALARM_ACKNOWLEDGED, AlarmKind.SECOND_BAND, who="10.0.0.5:1"),
         "alarm acknowledged: t5 band, by 10.0.0.5:1"),
        (event(EventKind.ALARM_SHELVED, AlarmKind.SENSOR_BAD, value=900), "alarm shelved: sensor bad, 900 s"),
        (event(EventKind.BOOT, 1), "boot: with a retained state"),
        (event(EventKind.SESSION, 1, value=10), "session: real time, 10 x real time"),
        (event(EventKind.OPERATOR_MODE, OperatorMode.MANUAL), "operator mode: manual"),
        (event(EventKind.SETPOINT, 1, value=75.5), "setpoint: NCR22_A, 75.5 W"),
        (event(EventKind.WATCHDOG_TIME, 0, 60), "watchdog time: off (was 15 s)"),
        (event(EventKind.WATCHDOG_EXPIRED), "watchdog expired"),
        (event(EventKind.PLANT_LINK, PlantLinkState.FROZEN, LinkCause.STOPPED), "plant link: frozen (stopped)"),
        (event(EventKind.LEASE, 2), "lease: a second writer was refused"),
        (event(EventKind.SENSOR_FAULT, 6, SensorFaultKind.NONE), "sensor fault: T5 (none)"),
        (event(EventKind.LOAD, 3, value=384), "load: row 3, 384 W"),
        (event(EventKind.CERTIFICATE, 1, value=21), "certificate: expires soon, 21 days left"),
        (event(EventKind.LOST, value=12), "lost, 12 events or lines"),
    ],
    ids=lambda noted: noted if isinstance(noted, str) else "",
)  # fmt: skip
def test_an_event_is_one_sentence(noted: Event, sentence: str) -> None:
    assert describe(noted, COLD_BOX).sentence == sentence


def test_a_time_is_iso_8601_with_milliseconds() -> None:
    assert utc_text(event(1)) == "2023-11-14T22:13:20.007Z"
    assert utc_text(Event(utc=2**32 - 1, milliseconds=999)) == "2106-02-07T06:28:15.999Z"


WORDS = st.integers(0, 0xFFFF)


@given(kind=WORDS | st.sampled_from(EventKind), subject=WORDS, cause=WORDS, value=st.floats(width=32))
def test_numbers_that_nobody_knows_stay_numbers(kind: int, subject: int, cause: int, value: float) -> None:
    text = describe(Event(kind=kind, subject=subject, cause=cause, value=value), COLD_BOX)
    assert text.sentence.isprintable()
    if kind not in set(EventKind):
        assert text.kind == str(kind)
        assert text.subject == (str(subject) if subject else "")


def test_the_log_has_the_words_and_what_it_counts_floods_by(caplog: pytest.LogCaptureFixture) -> None:
    log = logging.getLogger("coldloop.test")
    with caplog.at_level(logging.INFO):
        log_event(log, event(EventKind.ALARM_RAISED, AlarmKind.SENSOR_BAD, 6), COLD_BOX)
        log_event(log, event(EventKind.MODE, Mode.HOLD, who="10.0.0.5:1"), COLD_BOX)
        log_event(log, event(EventKind.LEASE, 1), COLD_BOX)
    raised, mode, lease = ({**record.__dict__, "message": record.getMessage()} for record in caplog.records)
    assert raised.items() >= {"message": "alarm raised", "alarm": "sensor bad", "cause": "T5", "tick": 8}.items()
    assert mode.items() >= {"message": "mode", "mode": "hold", "who": "10.0.0.5:1", "number": 1}.items()
    assert lease.items() >= {"message": "lease", "subject": "granted"}.items()
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING", "INFO"]
