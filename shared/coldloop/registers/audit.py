"""Records of the journal: what happened, when, and who did it. Every service has one."""

from typing import Annotated, Final, NamedTuple

from coldloop.registers.declaration import Worded, f32, text, u16, u32

EVENT_ROWS: Final = 256
QUERY_ROWS: Final = 3
"""Events in one answer to a query: what one request can read."""
WHO_WORDS: Final = 24
NOBODY: Final = (0,) * WHO_WORDS


class EventKind(Worded):
    """Kind of an event: `subject`, `cause` and `value` depend on it."""

    NONE = 0
    MODE = 1
    """The mode of the ladder changed: subject the new mode, cause why."""
    ALARM_RAISED = 2
    """Subject is the alarm, cause its cause; so for all alarm events. Value is the shortage of CAPACITY, W."""
    ALARM_RETURNED = 3
    ALARM_ACKNOWLEDGED = 4
    ALARM_SHELVED = 5
    """Value is the time, s."""
    ALARM_UNSHELVED = 6
    ALARM_OUT_OF_SERVICE = 7
    ALARM_IN_SERVICE = 8
    BOOT = 9
    """The service started: subject 1 when it resumes a retained state, cause 1 when one was set aside."""
    SESSION = 10
    """A session was started: subject 0 lock-step, 1 real time; value the factor."""
    OPERATOR_MODE = 11
    """Subject is the operator's mode."""
    SETPOINT = 12
    """Subject is the input, value the setpoint."""
    WATCHDOG_TIME = 13
    """Subject is the new time-out in ticks, 0 off; cause the old one."""
    WATCHDOG_EXPIRED = 14
    PLANT_LINK = 15
    """Subject is the new state of the plant link, cause why."""
    LEASE = 16
    """Subject 0 ended, 1 granted, 2 a second writer was refused."""
    SENSOR_FAULT = 17
    """A fault was put into a sensor: subject the output, cause the kind."""
    LOAD = 18
    """The load table was written: subject the last row that the request wrote, its value in W."""
    CERTIFICATE = 19
    """Subject 1 expires soon, 2 expired; value days left."""
    LOST = 20
    """Events or log lines were lost: value how many."""
    CONTROL_LINK = 21
    """Subject is the new state of the optimiser's link to the control PLC; 2 is up."""
    SENSOR = 22
    """Subject is the output, cause 1 bad: it is substituted, 2 suspect: the optimiser does without it, 0 good again."""
    PACE = 23
    """The time base of a session was changed: subject 0 lock-step, 1 real time, 2 paused; value the factor."""
    LIVE_LOAD = 24
    """The load of the session under way was written: subject 0 from now on, 1 steps ahead; value its first one, W."""
    STATION_ALARM = 25
    """An alarm of the compression station: subject its number from 0, cause 1 raised, 0 returned."""
    STATION_MODE = 26
    """The mode of the station's controller changed: subject the new one."""
    SURROUNDINGS = 27
    """Something was changed that a refrigerator is given: subject what, value its new value."""
    MODEL_RANGE = 28
    """The simulation left its property tables: subject what, its number from 0, cause 1 left, 0 returned."""
    COOL_DOWN = 29
    """The cool-down has come further: subject its step."""


class Event(NamedTuple):
    """One line of the journal. The row of event n is n modulo the number of rows; the first is number 1."""

    number: Annotated[int, u32("Number of the event, rising over restarts; 0 is none yet")] = 0
    boot: Annotated[int, u16("Number of the start of the service")] = 0
    tick: Annotated[int, u32("Tick of plant time")] = 0
    utc: Annotated[int, u32("UTC, seconds since 1970", unit="s")] = 0
    milliseconds: Annotated[int, u16("Milliseconds of that time", unit="ms", high=999)] = 0
    kind: Annotated[int, u16("{}", values=EventKind)] = 0
    subject: Annotated[int, u16("The mode, the alarm, ...: depends on the kind")] = 0
    cause: Annotated[int, u16("Why: depends on the kind")] = 0
    value: Annotated[float, f32("A value: depends on the kind")] = 0.0
    who: Annotated[tuple[int, ...], text("Client of the request: address, role, certificate", WHO_WORDS)] = NOBODY


class JournalQuery(NamedTuple):
    """Selects events when written; the answer is in the block behind it."""

    first: Annotated[int, u32("Number of the first event to search")]
    kind: Annotated[int, u16("Only events of this kind; 0 is any")]
    subject: Annotated[int, u16("Only events with this subject; 65535 is any")]


class JournalPage(NamedTuple):
    """State of the journal, and where the next query continues."""

    oldest: Annotated[int, u32("Number of the oldest event kept")] = 0
    newest: Annotated[int, u32("Number of the newest event")] = 0
    found: Annotated[int, u16("Events in the answer")] = 0
    next_first: Annotated[int, u32("First number for the next query; 0 at the end")] = 0


class JournalAnswer(Event):
    """An event that a query has found."""
