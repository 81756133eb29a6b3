"""Register map of the control PLC: the optimiser's side of the link, and what operators see."""

from functools import cache
from typing import Annotated, Final, NamedTuple

from coldloop.process.declaration import LAST_NUMBER, LAST_TICK, Process
from coldloop.registers import common
from coldloop.registers import declaration as reg
from coldloop.registers.declaration import Block, Numbers, RegisterMap, Role, Worded
from coldloop.registers.plant import MAX_STATE

SEQUENCE_ROWS: Final = 240


class Mode(Worded):
    """Who decides the outputs: the rungs of the fail-safe ladder (MPC, REST, HOLD, CLASSICAL), or an operator."""

    HOLD = 0
    """The last value, for a set time."""
    MPC = 1, "MPC"
    """A sequence, within the updating period that it was sent for."""
    CLASSICAL = 2, "classical loops"
    """Two PI loops; CV155 is fixed."""
    REST = 3, "rest of a sequence"
    """The rest of a sequence: the next one is late."""
    MANUAL = 4
    """Setpoints that an operator writes."""


class Cause(Worded):
    """Cause of the mode."""

    NONE = 0
    SESSION_STARTED = 1
    SEQUENCE_BEGAN = 2
    SEQUENCE_LATE = 3
    SEQUENCE_EXHAUSTED = 4
    HOLD_EXPIRED = 5
    OPERATOR = 6
    SENSOR_BAD = 7
    RESTARTED = 8
    COOL_DOWN = 9
    """The plant began warm, and the optimiser's model does not hold."""


class CoolDownStep(Worded):
    """How far the cool-down of a cold box has come."""

    FINISHED = 0
    """Or it has not begun warm: the optimiser is invited."""
    TURBINE = 1
    """The turbine cools, as far as its governor allows; CV155 is open as far as it may be."""
    BATH = 2
    """CV156 holds T5; the flow through CV155 cools the bath."""
    FILLING = 3
    """There is liquid; CV155 is as at the operating point."""
    SETTLING = 4
    """The bath is filled; both loops are closed until L1 and T5 have stayed in their bands."""


class OperatorMode(Worded):
    """Operating mode that an operator requests."""

    AUTO = 0
    """MPC, and the ladder when MPC is unavailable."""
    CLASSICAL = 1, "classical loops"
    MANUAL = 2


class Verdict(Worded):
    """Judgement of a sequence by the control PLC."""

    NONE = 0
    ACCEPTED = 1
    LATE = 2
    WRONG_UPDATE = 3
    WRONG_TICK = 4
    WRONG_LENGTH = 5
    WRONG_MODEL = 6
    BAD_CRC = 7, "bad CRC"
    OUT_OF_RANGE = 8
    RATE_EXCEEDED = 9
    REPEATED = 10
    NOT_INVITED = 11
    """No sequence is played now: an operator drives, or a sensor that MPC needs is bad."""
    PLANT_LOST = 12
    """The rack has not been synchronised for a while."""
    NO_ANSWER = 13
    """It has no rows: the optimiser has no answer to the update."""


class PlantLinkState(Worded):
    """State of the control PLC's link to the rack."""

    IDLE = 0
    """No session."""
    SEARCHING = 1
    """The rack does not answer."""
    JOINING = 2
    """It answers; its outputs are being read back, nothing is written."""
    SYNCHRONISED = 3
    """Outputs are written in every scan, and accepted."""
    REJECTED = 4
    """It answers, and rejects the outputs."""
    OTHER_MASTER = 5
    """It is in another session, or has another master."""
    FROZEN = 6
    """It answers, and its clock does not move."""


class LinkCause(Worded):
    """Why the link to the rack is in its state."""

    NONE = 0
    NO_ANSWER = 1
    DAMAGED = 2
    """An answer whose seal is broken or absent."""
    IMPLAUSIBLE = 3
    """A value out of its range, or not a number."""
    WRONG_SESSION = 4
    STALE = 5
    CHANGED = 6
    """Its outputs were changed by another master, or by its watchdog."""
    SECOND_MASTER = 7
    """Another control PLC holds the lease of the rack."""
    REFUSED = 8
    """It refused a request with an exception."""
    MISSED_SCANS = 9
    """This program missed one or more ticks."""
    TIME_JUMP = 10
    """The tick of the rack jumped, or went back."""
    STOPPED = 11
    """The tick of the rack does not move."""
    STARTED = 12
    TIME_BASE = 13
    """The time base of the session was changed."""
    LIMITED = 14
    """The rack limited the change of its outputs to the rate of one tick."""


class ProcessNow(NamedTuple):
    """The process at the last scan."""

    tick: Annotated[int, reg.u32("Tick of the scan")]
    load: Annotated[float, reg.of_load("{noun} {name}", finite=False)]
    u: Annotated[Numbers, reg.of_inputs("Input being applied")]
    y: Annotated[Numbers, reg.of_outputs("Measured output")]


class Status(NamedTuple):
    """State of the sequence player and of the scan cycle."""

    mode: Annotated[int, reg.u16("{}", values=Mode)]
    update: Annotated[int, reg.u32("Last update latched")]
    next_update_tick: Annotated[
        int, reg.u32("Tick of the next updating instant; the latest possible one until it is planned")
    ]
    playing: Annotated[int, reg.u32("Number of the sequence being played; 0 is none")]
    remaining: Annotated[int, reg.u16("Ticks of that sequence still to be played")]
    accepted: Annotated[int, reg.u32("Sequences accepted")]
    rejected: Annotated[int, reg.u32("Sequences rejected")]
    deadline_misses: Annotated[int, reg.u32("Updating instants at which no sequence had arrived")]
    overruns: Annotated[int, reg.u32("Scans that began more than the tolerance late")]
    lateness_max: Annotated[float, reg.f32("Largest lateness of a scan in real time", unit="ms")]
    lateness_p99: Annotated[float, reg.f32("99th percentile of the lateness of a scan in real time", unit="ms")]


class LadderStatus(NamedTuple):
    """Step of the fail-safe ladder, and the state of its inputs."""

    mode: Annotated[int, reg.u16("{}", values=Mode)]
    cause: Annotated[int, reg.u16("{}", values=Cause)]
    since: Annotated[int, reg.u32("Tick at which this mode began")]
    optimizer: Annotated[int, reg.u16("1 while the optimiser is alive", high=1)]
    bad_sensors: Annotated[int, reg.u32("Outputs whose measurement is substituted: bit i is output i")]
    events: Annotated[int, reg.u32("Number of the last event")]


class Update(NamedTuple):
    """Record for the optimiser, latched at an updating instant."""

    session: Annotated[int, reg.u32("Session")]
    update: Annotated[int, reg.u32("Number of the update; 0 is the one at tick 0", high=LAST_NUMBER)]
    tick: Annotated[int, reg.u32("Tick of the updating instant t_i", high=LAST_TICK)]
    playing: Annotated[
        int, reg.u32("Number of the sequence being played from this instant on; 0 is none", high=LAST_NUMBER)
    ]
    load: Annotated[float, reg.of_load("{noun} {name}", in_span=True)]
    u_before: Annotated[Numbers, reg.of_inputs("Input applied until this instant", in_span=True)]
    u: Annotated[Numbers, reg.of_inputs("Input applied from this instant on", in_span=True)]
    y: Annotated[
        Numbers,
        reg.of_outputs(
            "Output measured at this instant; not a number where the measurement is bad",
            low=-MAX_STATE,
            high=MAX_STATE,
            finite=False,
        ),
    ]
    x: Annotated[Numbers, reg.of_states("Simulated state, not measured", low=-MAX_STATE, high=MAX_STATE)]
    crc: Annotated[int, reg.u32("CRC-32 of the registers before; 0 is none")] = 0


class AwaitUpdate(NamedTuple):
    """Written together with a read of the latch, makes the answer wait for the update named."""

    session: Annotated[int, reg.u32("Session of the update before the awaited one")]
    update: Annotated[int, reg.u32("Number of the awaited update")]
    crc: Annotated[int, reg.u32("CRC-32 of the registers before; 0 is none, a wrong one is refused")] = 0


class Plan(NamedTuple):
    """The updating period that the optimiser has decided for an update."""

    update: Annotated[int, reg.u32("Update that is planned")]
    next_update_tick: Annotated[int, reg.u32("Tick of the next updating instant t_{i+1}")]
    load_step: Annotated[
        float, reg.of_load("An update is latched at once when the load has moved by more than this; 0 is never", low=0)
    ] = 0.0
    shortage: Annotated[
        float, reg.of_load("Estimated load above what can be held; negative: below what is needed; 0 is neither")
    ] = 0.0
    suspects: Annotated[
        int,
        reg.u32(
            "Outputs whose reading is not used, as prediction and other readings contradict it: bit i is output i; "
            "after these bits, inputs that are left where they are, as they have no effect"
        ),
    ] = 0
    crc: Annotated[int, reg.u32("CRC-32 of the registers before; none, or a wrong one, is refused")] = 0


class Acknowledgement(NamedTuple):
    """Answer to the last sequence committed."""

    number: Annotated[int, reg.u32("Number of the sequence")]
    verdict: Annotated[int, reg.u16("{}", values=Verdict)]
    crc: Annotated[int, reg.u32("CRC-32 of the registers before")] = 0


class Heartbeat(NamedTuple):
    """Sign of life of the optimiser, besides its other requests."""

    beat: Annotated[int, reg.u16("Any number; the write itself triggers the watchdog")]
    model_digest: Annotated[int, reg.u32("First 32 bits of the digest of the optimiser's prediction model")]
    holder: Annotated[int, reg.u32("Number chosen by the optimiser; 0 is a simple client")] = 0
    crc: Annotated[int, reg.u32("CRC-32 of the registers before; 0 is none, a wrong one is refused")] = 0


class LatchedUpdate(NamedTuple):
    """Number and tick of the newest update, read by an optimiser while it computes."""

    session: Annotated[int, reg.u32("Session")] = 0
    update: Annotated[int, reg.u32("Number of the newest update", high=LAST_NUMBER)] = 0
    tick: Annotated[int, reg.u32("Tick of its updating instant", high=LAST_TICK)] = 0
    crc: Annotated[int, reg.u32("CRC-32 of the registers before")] = 0


class Operator(NamedTuple):
    """Request of an operator: mode and setpoints. Setpoints count in manual mode; they are clamped and rate-limited."""

    mode: Annotated[int, reg.u16("{}", values=OperatorMode)]
    u: Annotated[Numbers, reg.each_input("Setpoint: {}")]


class SequenceHeader(NamedTuple):
    """Describes the sequence in the spare buffer; writing it commits the sequence.

    It is right before the buffer: header and rows of a short sequence fit into one request.
    """

    number: Annotated[int, reg.u32("Number of the sequence, rising", high=LAST_NUMBER)]
    update: Annotated[int, reg.u32("Update that the sequence answers")]
    first_tick: Annotated[int, reg.u32("First tick at which it is valid, t_{i+1}")]
    length: Annotated[int, reg.u16("Rows in use", high=SEQUENCE_ROWS)]
    tau_u: Annotated[int, reg.in_ticks(reg.u16("Updating period t_{i+1} - t_i that it was computed in"))]
    model_digest: Annotated[int, reg.u32("First 32 bits of the digest of the prediction model")]
    crc: Annotated[int, reg.u32("CRC-32 of the header before this field and of the rows in use, as big-endian words")]


class SequenceRow(NamedTuple):
    """Inputs of one tick."""

    u: Annotated[Numbers, reg.each_input("{}", in_span=False)]


class PlantLinkStatus(NamedTuple):
    """The link to the rack: whether outputs are written, and how far the clocks agree."""

    state: Annotated[int, reg.u16("{}", values=PlantLinkState)] = PlantLinkState.IDLE
    cause: Annotated[int, reg.u16("{}", values=LinkCause)] = LinkCause.NONE
    since: Annotated[int, reg.u32("Tick at which this state began")] = 0
    breaks: Annotated[int, reg.u32("Times that the link has lost synchronisation")] = 0
    holder: Annotated[int, reg.u32("Number chosen by this control PLC")] = 0
    generation: Annotated[int, reg.u32("Generation of the rack's outputs that was read back")] = 0
    plant_session: Annotated[int, reg.u32("Session of the rack when it last answered")] = 0
    plant_tick: Annotated[int, reg.u32("Tick of the rack when it last answered")] = 0
    offset: Annotated[float, reg.f32("Phase error of the rack's clock against ours", unit="ms")] = 0.0
    skew: Annotated[float, reg.f32("Skew of the rack's clock; positive: faster than ours", unit="ppm")] = 0.0
    skew_error: Annotated[float, reg.f32("Standard error of that", unit="ppm", finite=False)] = 0.0


class ControlSession(NamedTuple):
    """Starts a session when written."""

    session: Annotated[int, reg.u32("Number of the session; the control PLC restarts from tick 0", low=1)]
    realtime: Annotated[int, reg.u16("{}", high=1, values=common.TimeBaseKind)]
    factor: Annotated[float, reg.f32("Seconds of plant time in one second of real time", low=0.01, high=10_000)]


class Grant(NamedTuple):
    """How far the control PLC may go in lock-step."""

    until_tick: Annotated[int, reg.in_ticks(reg.u32("The control PLC scans every tick before this one"))]


@cache
def control_map(process: Process) -> RegisterMap:
    """Return the map of the control PLC of a process."""
    blocks = (
        common.IDENTITY_BLOCK, Block("status", 30, Status, "Sequence player and scan cycle"),
        Block("ladder", 50, LadderStatus, "The fail-safe ladder"), common.STATISTICS_BLOCK,
        Block("process", 100, ProcessNow, "The process at the last scan"),
        Block("update", 200, Update, "Latched at the last updating instant", sealed=True),
        Block("plant link", 330, PlantLinkStatus, "Link to the rack, and the clocks of both"),
        Block("optimiser lease", 360, common.LeaseStatus, "Who may write as the optimiser"),
        Block("await update", 400, AwaitUpdate, "Makes a read of the latch wait", Role.OPTIMIZER, sealed=True),
        Block("plan", 408, Plan, "Decided updating period", Role.OPTIMIZER, sealed=True),
        Block("acknowledgement", 420, Acknowledgement, "Answer to the last sequence", sealed=True),
        Block("heartbeat", 430, Heartbeat, "Heartbeat of the optimiser", Role.OPTIMIZER, sealed=True),
        Block("watchdog", 440, common.WatchdogStatus, "Watches the optimiser"),
        Block("watchdog time", 446, common.WatchdogTime, "Sets that watchdog", Role.OPERATOR),
        Block("session", 450, ControlSession, "Start of a session", Role.OPERATOR),
        Block("grant", 460, Grant, "Ticks granted in lock-step", Role.OPERATOR),
        Block("latched update", 462, LatchedUpdate, "The newest update", sealed=True),
        Block("operator", 470, Operator, "Operating mode and manual setpoints", Role.OPERATOR),
        Block("alarm command", 480, common.AlarmCommand, "Command for an alarm", Role.OPERATOR),
        Block("sequence header", 488, SequenceHeader, "Commits the sequence in the buffer", Role.OPTIMIZER),
        Block("sequence", 500, SequenceRow, "Spare buffer for a sequence", Role.OPTIMIZER, SEQUENCE_ROWS),
        Block("pace", 1950, common.SessionPace, "Time base of the present session", Role.OPERATOR),
        Block("alarms", 2000, common.Alarm, "One row for each alarm", rows=len(common.alarms_of(process))),
        *common.LAST_BLOCKS,
    )  # fmt: skip
    return RegisterMap(service="control_plc", version=4, blocks=reg.placed(process, blocks))
