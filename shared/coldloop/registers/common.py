"""Records, kinds and codes that several services share: identity, statistics, events, watchdogs, leases, alarms.

The configuration is what decides results, as a JSON text with its digest: an object of values by dotted key, as
`coldloop config` lists them. Addresses, certificates, files and other things that concern one machine alone are not in
it.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final, NamedTuple, Self

from coldloop.process.declaration import Process
from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import from_words, to_words
from coldloop.registers.declaration import Block, Role, Worded, f32, in_ticks, text, u16, u32
from coldloop.session import TimeBase
from coldloop.text import parsed_json

MAGIC: Final = 123.456


class ServiceState(Worded):
    """State of a service, in `Identity.state`."""

    READY = 0
    RUNNING = 1


class TimeBaseKind(Worded):
    """Kind of the time base: how the plant time of a session advances."""

    LOCK_STEP = 0, "lock-step"
    REAL_TIME = 1
    PAUSED = 2
    """In real time, and stopped."""


class PaceCommand(Worded):
    """Command that pauses or resumes plant time."""

    PAUSE = 1
    RESUME = 0


class Identity(NamedTuple):
    """Who answers, which map it speaks, and whether it is alive."""

    magic: Annotated[float, f32("Always 123.456: reads correctly only with the right word order")] = MAGIC
    map_digest: Annotated[int, u32("Digest of this register map")] = 0
    map_version: Annotated[int, u16("Version of this register map")] = 0
    state: Annotated[int, u16("{}", values=ServiceState)] = ServiceState.READY
    model_digest: Annotated[int, u32("First 32 bits of the digest of the prediction model in use")] = 0
    session: Annotated[int, u32("Present session")] = 0
    tick: Annotated[int, in_ticks(u32("Present tick of plant time, counted from the start of the session"))] = 0
    heartbeat: Annotated[int, u16("Rises with every tick or update, and wraps")] = 0


class SessionPace(NamedTuple):
    """Time base of the session under way; changed when written, from the present tick on.

    It is the same record in all three maps; write it to the plant first, then to the control PLC and the optimiser PLC.
    """

    session: Annotated[int, u32("Session of the command; 0 is the present one")] = 0
    realtime: Annotated[int, u16("{}", high=1, values=TimeBaseKind)] = 0
    factor: Annotated[float, f32("Seconds of plant time in one second of real time", low=0.01, high=10_000)] = 1.0
    paused: Annotated[int, u16("{}; in real time only", values=PaceCommand)] = 0

    def of(self, session: int) -> TimeBase:
        """Return the requested time base.

        Raises:
            ValueError: It is not for this session, or there is none.
        """
        if not session:
            raise ValueError("there is no session")
        if self.session not in {0, session}:
            raise ValueError(f"session {session} is under way, not {self.session}")
        if self.paused and not self.realtime:
            raise ValueError("lock-step is not paused: grant no more ticks")
        return TimeBase(bool(self.realtime), self.factor, bool(self.paused))

    @classmethod
    def shown(cls, session: int, pace: TimeBase) -> "SessionPace":
        """Return the record of a time base."""
        return cls(session, int(pace.realtime), pace.factor, int(pace.paused))


def pace_subject(pace: TimeBase) -> TimeBaseKind:
    """Return the subject of the event PACE."""
    return TimeBaseKind.PAUSED if pace.paused else TimeBaseKind(pace.realtime)


class ServerStatistics(NamedTuple):
    """Statistics of the server since it started; all counts wrap."""

    connections: Annotated[int, u16("Open connections")] = 0
    accepted: Annotated[int, u32("Connections accepted")] = 0
    requests: Annotated[int, u32("Requests, including refused ones")] = 0
    illegal_function: Annotated[int, u32("Requests refused: function not served")] = 0
    illegal_address: Annotated[int, u32("Requests refused: no such register, or read-only")] = 0
    illegal_value: Annotated[int, u32("Requests refused: quantity, length or value")] = 0
    server_failure: Annotated[int, u32("Requests that failed in the server")] = 0
    unknown_unit: Annotated[int, u32("Requests for an unknown unit id")] = 0
    malformed_frame: Annotated[int, u32("Connections closed: not Modbus/TCP")] = 0
    idle_timeout: Annotated[int, u32("Connections closed: no request for too long")] = 0
    connection_evicted: Annotated[int, u32("Connections closed: idle, and replaced by a new one")] = 0
    connection_refused: Annotated[int, u32("Connections refused: too many, and none idle")] = 0
    access_refused: Annotated[int, u32("Writes and connections refused: no permission")] = 0
    tls_refused: Annotated[int, u32("Connections refused: no TLS 1.3, or no valid certificate")] = 0
    rate_limited: Annotated[int, u32("Times that a connection was delayed by its rate limit")] = 0
    second_writer: Annotated[int, u32("Writes refused: another client holds the lease of the role")] = 0


IDENTITY_BLOCK: Final = Block("identity", 0, Identity, "Identity and heartbeat of the service")
STATISTICS_BLOCK: Final = Block("statistics", 60, ServerStatistics, "Requests served and refused")


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


LINE_WORDS: Final = 16
LINE_CHARACTERS: Final = 2 * LINE_WORDS
LINES: Final = 512
"""16,384 characters; the optimiser PLC, which has the longest, takes 3,000 by default."""
DIGEST_WORDS: Final = 32


class ConfigurationDigest(NamedTuple):
    """How long the text of the configuration is, and its digest."""

    length: Annotated[int, u16("Characters of the text; it is cut off if this is more than the lines hold")]
    sha256: Annotated[tuple[int, ...], text("SHA-256 of the text, in hexadecimal", DIGEST_WORDS)]


class ConfigurationLine(NamedTuple):
    """A part of the text."""

    text: Annotated[tuple[int, ...], text("Part of a JSON object: values by dotted key", LINE_WORDS)]


LAST_BLOCKS: Final = (
    Block("journal query", 45000, JournalQuery, "Selects events of the journal", Role.OPERATOR),
    Block("journal page", 45010, JournalPage, "State of the journal"),
    Block("journal answer", 45017, JournalAnswer, "The events that were selected", rows=QUERY_ROWS),
    Block("events", 45200, Event, "The last events", rows=EVENT_ROWS),
    Block("configuration", 55000, ConfigurationDigest, "Digest of the running configuration"),
    Block("configuration text", 55040, ConfigurationLine, "The running configuration", rows=LINES),
)
"""The end of every map: the service's journal and its configuration."""


def publish_configuration(bank: RegisterBank, values: Mapping[str, Any]) -> None:
    """Show values by dotted key in the registers of a service."""
    document = json.dumps(values, sort_keys=True, separators=(",", ":"))
    bank.put(ConfigurationDigest(min(len(document), 0xFFFF), to_words(_digest(document), DIGEST_WORDS)))
    for row in range(lines_of(len(document))):
        line = document[row * LINE_CHARACTERS : (row + 1) * LINE_CHARACTERS]
        bank.put(ConfigurationLine(to_words(line, LINE_WORDS)), row)


def lines_of(length: int) -> int:
    """Return the number of lines that a text takes."""
    return min(LINES, -(-length // LINE_CHARACTERS))


def configuration_of(digest: ConfigurationDigest, lines: Sequence[ConfigurationLine]) -> dict[str, Any]:
    """Return the values by dotted key.

    Raises:
        ValueError: The text is not the one of the digest: it was cut off, or has arrived damaged; or it is no object of
            values.
    """
    document = "".join(from_words(line.text) for line in lines)
    if _digest(document) != from_words(digest.sha256):
        raise ValueError("the text is not the one of its digest")
    try:
        return {**parsed_json(document)}
    except TypeError:
        raise ValueError("the text is not an object") from None


def _digest(document: str) -> str:
    return hashlib.sha256(document.encode()).hexdigest()


class WatchdogState(Worded):
    """State of a watchdog."""

    OFF = 0
    RUNNING = 1
    EXPIRED = 2


class WatchdogStatus(NamedTuple):
    """A watchdog, in the manner of the WAGO 750's block of watchdog registers."""

    time: Annotated[int, in_ticks(u16("Time-out in use; 0 is off"))] = 0
    state: Annotated[int, u16("{}", values=WatchdogState)] = WatchdogState.OFF
    remaining: Annotated[int, in_ticks(u16("Time until it expires"))] = 0
    lowest: Annotated[int, in_ticks(u16("Shortest remaining time since it was set"))] = 0
    trips: Annotated[int, u16("Times that it has expired")] = 0


class WatchdogTime(NamedTuple):
    """Sets a watchdog when written."""

    time: Annotated[int, in_ticks(u16("Time-out; 0 switches the watchdog off, a new value restarts it"))]


class LeaseState(Worded):
    """State of the lease of a role."""

    FREE = 0
    HELD = 1
    LINGERING = 2
    """Its connection has closed: for a moment only the same holder may take it."""


class LeaseEvent(Worded):
    """Subject of an event of the kind `EventKind.LEASE`."""

    ENDED = 0
    GRANTED = 1
    REFUSED = 2, "a second writer was refused"


class LeaseStatus(NamedTuple):
    """The lease of a role: only one connection at a time writes in it."""

    state: Annotated[int, u16("{}: its connection has closed", values=LeaseState)] = LeaseState.FREE
    holder: Annotated[int, u32("Number chosen by the holder; 0 is a simple client")] = 0
    refused: Annotated[int, u32("Writes of others that were refused with exception 06")] = 0
    who: Annotated[tuple[int, ...], text("Address, role and certificate of the holder", WHO_WORDS)] = NOBODY


class AlarmKind(Worded):
    """The alarms of the control PLC; the number is the row in their block. Further bands have rows behind these."""

    MODE = 0
    FIRST_BAND = 1
    """The first output that has a band is outside it: of the cold box L1."""
    SECOND_BAND = 2
    """So is the second one: of the cold box T5."""
    SEQUENCE_REJECTED = 3
    SEQUENCE_LATE = 4
    SEQUENCE_EXHAUSTED = 5
    OPTIMIZER_LOST = 6
    PLANT_LOST = 7
    SENSOR_BAD = 8
    MODEL_MISMATCH = 9
    SCAN_OVERRUN = 10
    ACCESS_REFUSED = 11
    PLANT_OTHER_MASTER = 12
    """The rack has another master, or is in another session."""
    PLANT_FROZEN = 13
    """The rack answers, and its clock does not move."""
    OUTPUTS_REJECTED = 14
    CLOCK_SKEW = 15
    """The rack's clock and ours differ by too much."""
    SECOND_WRITER = 16
    """A second writer was refused: cause 1 an optimiser here, 2 a control PLC at the rack."""
    CERTIFICATE = 17
    """Our certificate has expired, or will soon."""
    STATE_NOT_RETAINED = 18
    SCANS_STOPPED = 19
    """In real time no scan is made, and the link to the rack has no reason for it."""
    CAPACITY = 20
    """The load is one that no inputs within their limits hold: the bands will be left."""
    SENSOR_SUSPECT = 21
    """A reading contradicts the prediction and the other readings."""
    INPUT_WITHOUT_EFFECT = 22
    """The optimiser leaves an input where it is: that of a turbine which stands moves nothing."""


def band_alarms(process: Process) -> tuple[int, ...]:
    """Return the alarm of each output with a band, by its number."""
    further = range(len(AlarmKind), len(AlarmKind) + len(process.bands))
    return (AlarmKind.FIRST_BAND, AlarmKind.SECOND_BAND, *further)[: len(process.bands)]


def alarms_of(process: Process) -> range:
    """Return the numbers of all alarms of a process."""
    return range(len(AlarmKind) + max(0, len(process.bands) - 2))


def alarm_key(alarm: int, process: Process) -> str:
    """Return what the configuration calls an alarm."""
    bands = band_alarms(process)
    return (
        f"{process.banded[bands.index(alarm)].name.lower()}_band" if alarm in bands else AlarmKind(alarm).name.lower()
    )


class CapacityCause(Worded):
    """Why a load is not held."""

    NONE = 0
    TOO_MUCH = 1, "too much load: reduce it, or the bath will run dry"
    TOO_LITTLE = 2, "too little load: raise it, or the turbine gets too cold and the bath floods"

    @classmethod
    def of(cls, shortage: float) -> Self:
        """Return the cause of a shortage (W): positive where the load is too large, negative where it is too small."""
        return cls(cls.TOO_MUCH if shortage > 0.0 else cls.TOO_LITTLE if shortage < 0.0 else cls.NONE)


class AlarmState(Worded):
    """States of ANSI/ISA-18.2."""

    NORMAL = 0
    UNACKNOWLEDGED = 1
    ACKNOWLEDGED = 2
    RETURNED = 3, "returned unacknowledged"
    SHELVED = 4
    OUT_OF_SERVICE = 5


class AlarmPriority(Worded):
    """How soon an operator has to act."""

    LOW = 1
    MEDIUM = 2
    HIGH = 3
    CRITICAL = 4


class AlarmAction(Worded):
    """Action of an operator on an alarm."""

    ACKNOWLEDGE = 1
    SHELVE = 2
    UNSHELVE = 3
    OUT_OF_SERVICE = 4
    IN_SERVICE = 5, "in service again"


class Alarm(NamedTuple):
    """One alarm."""

    state: Annotated[int, u16("{}", values=AlarmState)] = 0
    active: Annotated[int, u16("1 while the condition holds, whatever the state", high=1)] = 0
    cause: Annotated[
        int, u16("Cause: of a mode its ladder cause, of a sensor its output, of a sequence its verdict")
    ] = 0
    times: Annotated[int, u16("Times that it was raised")] = 0
    raised: Annotated[int, u32("Tick at which it was last raised")] = 0
    returned: Annotated[int, u32("Tick at which the condition last ended")] = 0
    priority: Annotated[int, u16("{}", values=AlarmPriority)] = AlarmPriority.LOW
    shelved_until: Annotated[int, u32("Tick at which shelving ends; 0 is not shelved")] = 0


class AlarmCommand(NamedTuple):
    """Command of an operator for an alarm; done when written."""

    alarm: Annotated[int, u16("Number of the alarm; 65535 is all")]
    action: Annotated[int, u16("{}", values=AlarmAction)]
    time: Annotated[int, u16("How long to shelve it; 0 is the time of the configuration", unit="s")] = 0


ALL_ALARMS: Final = 0xFFFF
