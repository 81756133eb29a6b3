"""Records that the fail-safe side of both PLCs and the rack shares: watchdog, lease, alarms."""

from typing import Annotated, Final, NamedTuple, Self

from coldloop.process.declaration import Process
from coldloop.registers.common import NOBODY, WHO_WORDS
from coldloop.registers.declaration import Worded, in_ticks, text, u16, u32


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
