"""The corner below address 100 that is the same in every map."""

from typing import Annotated, Final, NamedTuple

from coldloop.registers.declaration import Block, Worded, f32, in_ticks, u16, u32
from coldloop.session import TimeBase

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
