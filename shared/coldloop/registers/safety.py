"""Records that the fail-safe side of both PLCs and the rack shares: watchdog, alarms, events."""

from enum import IntEnum
from typing import Annotated, Final, NamedTuple

from coldloop.registers.declaration import u16, u32

EVENT_ROWS: Final = 256


class WatchdogState(IntEnum):
    """What a watchdog is doing."""

    OFF = 0
    RUNNING = 1
    EXPIRED = 2


class WatchdogStatus(NamedTuple):
    """A watchdog, in the manner of the WAGO 750's block of watchdog registers."""

    time: Annotated[int, u16("Time-out in use; 0 is off", unit="0.25 s")] = 0
    state: Annotated[int, u16("0 off, 1 running, 2 expired")] = WatchdogState.OFF
    remaining: Annotated[int, u16("Time until it expires", unit="0.25 s")] = 0
    lowest: Annotated[int, u16("Shortest remaining time since it was set", unit="0.25 s")] = 0
    trips: Annotated[int, u16("Times that it has expired")] = 0


class WatchdogTime(NamedTuple):
    """Sets a watchdog when written."""

    time: Annotated[int, u16("Time-out; 0 switches the watchdog off, a new value starts it anew", unit="0.25 s")]


class AlarmKind(IntEnum):
    """The alarms of the control PLC; the number is the row in their block."""

    MODE = 0
    LEVEL_BAND = 1
    T5_BAND = 2
    SEQUENCE_REJECTED = 3
    SEQUENCE_LATE = 4
    SEQUENCE_EXHAUSTED = 5
    OPTIMIZER_LOST = 6
    PLANT_LOST = 7
    SENSOR_BAD = 8
    MODEL_MISMATCH = 9
    SCAN_OVERRUN = 10
    ACCESS_REFUSED = 11


class AlarmState(IntEnum):
    """States of ANSI/ISA-18.2."""

    NORMAL = 0
    UNACKNOWLEDGED = 1
    ACKNOWLEDGED = 2
    RETURNED = 3
    SHELVED = 4


class AlarmAction(IntEnum):
    """What an operator does with an alarm."""

    ACKNOWLEDGE = 1
    SHELVE = 2
    UNSHELVE = 3


class Alarm(NamedTuple):
    """One alarm."""

    state: Annotated[int, u16("0 normal, 1 unacknowledged, 2 acknowledged, 3 returned unacknowledged, 4 shelved")] = 0
    active: Annotated[int, u16("1 while the condition holds, whatever the state", high=1)] = 0
    cause: Annotated[
        int, u16("Cause: of a mode its ladder cause, of a sensor its output, of a sequence its verdict")
    ] = 0
    times: Annotated[int, u16("Times that it was raised")] = 0
    raised: Annotated[int, u32("Tick at which it was last raised")] = 0
    returned: Annotated[int, u32("Tick at which the condition last ended")] = 0


class AlarmCommand(NamedTuple):
    """What an operator wants done with an alarm; done when written."""

    alarm: Annotated[int, u16("Number of the alarm; 65535 is all")]
    action: Annotated[int, u16("1 acknowledge, 2 shelve, 3 unshelve", high=3)]


ALL_ALARMS: Final = 0xFFFF


class EventKind(IntEnum):
    """What an event tells of."""

    NONE = 0
    MODE = 1
    """The mode changed: `subject` is the new mode, `cause` why."""
    ALARM_RAISED = 2
    """`subject` is the alarm, `cause` its cause."""
    ALARM_RETURNED = 3
    ALARM_ACKNOWLEDGED = 4
    ALARM_SHELVED = 5
    ALARM_UNSHELVED = 6


class Event(NamedTuple):
    """One line of the sequence of events. The row of event n is n modulo the number of rows; the first is number 1."""

    number: Annotated[int, u32("Number of the event; 0 is none yet")] = 0
    tick: Annotated[int, u32("Tick of the event")] = 0
    kind: Annotated[int, u16("1 mode, 2 alarm raised, 3 returned, 4 acknowledged, 5 shelved, 6 unshelved")] = 0
    subject: Annotated[int, u16("The mode, or the alarm")] = 0
    cause: Annotated[int, u16("Why")] = 0
