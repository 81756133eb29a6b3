"""Alarms with the states of ANSI/ISA-18.2-2016 (clause 5.4, alarm state transition diagram).

    condition ──on-delay, off-delay──> active ──TRANSITIONS──> state ──> registers, journal

A condition is reported as it is (`report`, `raised`, `returned`, `pulse`; those of bands by `watch_bands`). When it has
changed for the delay of its alarm (`follow`), `active` follows, and the state makes a transition. Operators make the
others. All times are plant time, measured by ticks and not by scans: scans can be missed.

"Suppressed by design" of the standard is not there: no alarm depends on another one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Final, Literal, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, FiniteFloat, model_validator

from coldloop.process import declaration, sections
from coldloop.process.settings import ProcessSettings, declared, settings_process, stretched, within
from coldloop.registers import common
from coldloop.registers.common import Alarm, AlarmAction, AlarmCommand, AlarmKind, AlarmPriority, AlarmState, EventKind
from coldloop.service.journal import Journal
from coldloop_control_plc.output_limits import Numbers

PASSING: Final = (AlarmKind.SCAN_OVERRUN, AlarmKind.ACCESS_REFUSED, AlarmKind.SECOND_WRITER)
"""Alarms for something that happens at an instant: their off-delay is how long ago the last time must be."""
LOW, MEDIUM, HIGH, CRITICAL = AlarmPriority


class AlarmRule(NamedTuple):
    """Treatment of one alarm. Delays are seconds of plant time."""

    priority: AlarmPriority
    on_delay_s: float = 0.0
    """How long the condition must hold before the alarm is raised."""
    off_delay_s: float = 0.0
    """How long the condition must have ended before the alarm returns."""


DEFAULT_RULES: Final[Mapping[AlarmKind, AlarmRule]] = MappingProxyType({
    # The process is uncontrolled, or under another master: act at once.
    AlarmKind.PLANT_LOST: AlarmRule(CRITICAL),  # only the rack's watchdog protects the plant
    AlarmKind.PLANT_OTHER_MASTER: AlarmRule(CRITICAL),  # another master decides the outputs
    AlarmKind.OUTPUTS_REJECTED: AlarmRule(CRITICAL),  # what is computed is not applied
    AlarmKind.SCANS_STOPPED: AlarmRule(CRITICAL),  # nothing is computed
    # The process leaves its limits, or is about to unnoticed: act within minutes.
    AlarmKind.FIRST_BAND: AlarmRule(HIGH),  # as all bands; of the cold box the bath may run dry or flood
    AlarmKind.SECOND_BAND: AlarmRule(HIGH),  # of the cold box the turbine leaves its range
    AlarmKind.PLANT_FROZEN: AlarmRule(HIGH),  # measurements are old
    AlarmKind.CAPACITY: AlarmRule(HIGH, 20.0, 30.0),  # no control holds this load
    # Control is degraded, or a protection is lost: act within the shift.
    AlarmKind.MODE: AlarmRule(MEDIUM),  # the ladder has left MPC
    AlarmKind.SEQUENCE_EXHAUSTED: AlarmRule(MEDIUM),  # outputs are held, then the classical loops control
    AlarmKind.OPTIMIZER_LOST: AlarmRule(MEDIUM),  # no new sequence will come by itself
    AlarmKind.SENSOR_BAD: AlarmRule(MEDIUM),  # substituted; the ladder reacts to those that matter
    AlarmKind.SENSOR_SUSPECT: AlarmRule(MEDIUM),  # the optimiser does without it
    AlarmKind.INPUT_WITHOUT_EFFECT: AlarmRule(MEDIUM),  # likewise: the turbine stands
    AlarmKind.MODEL_MISMATCH: AlarmRule(MEDIUM),  # no sequence is accepted until a configuration is changed
    AlarmKind.SECOND_WRITER: AlarmRule(MEDIUM, off_delay_s=60.0),  # refused, but wired or configured wrongly
    AlarmKind.CERTIFICATE: AlarmRule(MEDIUM),  # clients will not connect once it has expired
    AlarmKind.STATE_NOT_RETAINED: AlarmRule(MEDIUM),  # a restart would not continue from here
    # No immediate action: a hint for maintenance.
    AlarmKind.SEQUENCE_REJECTED: AlarmRule(LOW),  # the rest of the last sequence is played meanwhile
    AlarmKind.SEQUENCE_LATE: AlarmRule(LOW),  # likewise
    AlarmKind.SCAN_OVERRUN: AlarmRule(LOW, off_delay_s=60.0),  # outputs came some milliseconds late
    AlarmKind.ACCESS_REFUSED: AlarmRule(LOW, off_delay_s=60.0),  # nothing has happened
    AlarmKind.CLOCK_SKEW: AlarmRule(LOW),  # the scan follows the rack's clock
})  # fmt: skip
"""Priorities by how soon an operator has to act (ANSI/ISA-18.2-2016, clause 8), and delays."""


def _known_name(name: str) -> str:
    process = settings_process()
    known = [common.alarm_key(alarm, process) for alarm in common.alarms_of(process)]
    if name.lower() not in known:
        raise ValueError(f"unknown alarm '{name}'; choose from {', '.join(known)}")
    return name.lower()


Delay = Annotated[FiniteFloat, within(lambda process: (0, 345_600 * process.tick_s))]


class RuleSettings(BaseModel, frozen=True, extra="forbid"):
    """Changes to the default rule of an alarm; what is not given keeps its default."""

    priority: Literal["low", "medium", "high", "critical"] | None = None
    on_delay_s: Delay | None = None
    """How long the condition must hold before the alarm is raised, plant time."""
    off_delay_s: Delay | None = None
    """How long the condition must have ended before the alarm returns, plant time."""

    def changed(self, rule: AlarmRule) -> AlarmRule:
        """Return a rule with what is given here."""
        return AlarmRule(
            rule.priority if self.priority is None else AlarmPriority[self.priority.upper()],
            rule.on_delay_s if self.on_delay_s is None else self.on_delay_s,
            rule.off_delay_s if self.off_delay_s is None else self.off_delay_s,
        )


def _bands_of(process: declaration.Process) -> dict[str, sections.Range]:
    return {one.name: one.alarm or one.edges for one in process.banded if one.edges is not None}


def _with_declared(given: object) -> object:
    """Return bands by output, those of the process where none are given."""
    if not isinstance(given, Mapping):
        return given
    found: dict[str, object] = {**_bands_of(settings_process())}
    names = {name.lower(): name for name in found}  # the environment has no capitals
    for name, band in given.items():
        if str(name).lower() not in names:
            raise ValueError(f"{name}: no output with a band; choose from {', '.join(found)}")
        found[names[str(name).lower()]] = band
    return found


class AlarmSettings(ProcessSettings):
    """Settings of the alarms: when they are raised, how urgent they are, and how long they may be shelved."""

    bands: Annotated[dict[str, tuple[FiniteFloat, FiniteFloat]], BeforeValidator(_with_declared)] = declared(_bands_of)
    """Bands of the outputs that have one, by the output's name; those that are not given are as the process declares
    them."""
    band_delay_s: Delay = stretched(5.0)
    """On-delay of their alarms: how long an output must be outside, plant time."""
    rules: dict[Annotated[str, AfterValidator(_known_name)], RuleSettings] = Field(default_factory=dict)
    """Rules that differ from the default, by name of the alarm, such as `sensor_bad`."""
    shelving_s: Annotated[FiniteFloat, Field(ge=1, le=65_535)] = 900.0
    """How long an alarm is shelved by a command that gives no time, plant time."""
    longest_shelving_s: Annotated[FiniteFloat, Field(ge=1, le=65_535)] = 28_800.0
    """Longest time of one command, plant time. A shift: the next one decides again."""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, given: object) -> object:
        for name in ("level_band", "t5_band"):
            if isinstance(given, Mapping) and name in given:
                raise ValueError(f"{name}: bands have the names of their outputs since 0.4: set bands.L1 or bands.T5")
        return given

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.shelving_s > self.longest_shelving_s:
            raise ValueError("shelving_s is above longest_shelving_s; shorten it, or allow more")
        delayed = [kind.name.lower() for kind in PASSING if self.rule(kind).on_delay_s]
        if delayed:
            raise ValueError(f"{delayed[0]} happens at an instant and would never be raised; leave out its on_delay_s")
        return self

    def rule(self, alarm: int) -> AlarmRule:
        """Return how an alarm is treated."""
        is_band = alarm in common.band_alarms(self.process)
        default = DEFAULT_RULES[AlarmKind.FIRST_BAND if is_band else AlarmKind(alarm)]
        if alarm == AlarmKind.CAPACITY:
            stretch = self.process.stretch
            default = AlarmRule(default.priority, default.on_delay_s * stretch, default.off_delay_s * stretch)
        if is_band:
            default = default._replace(on_delay_s=self.band_delay_s)
        return self.rules.get(common.alarm_key(alarm, self.process), RuleSettings()).changed(default)

    def shelving_ticks(self, asked_s: int) -> int:
        """Return how long an alarm is shelved when so many seconds are asked for; 0 asks for the default."""
        return self.ticks(min(asked_s or self.shelving_s, self.longest_shelving_s))

    def ticks(self, seconds: float) -> int:
        """Return a time in ticks, not shorter than it; what is smaller than the error of a float does not count."""
        return math.ceil(seconds / self.process.tick_s - 1e-9)


SET_ASIDE: Final = {
    EventKind.ALARM_SHELVED: AlarmState.SHELVED,
    EventKind.ALARM_OUT_OF_SERVICE: AlarmState.OUT_OF_SERVICE,
}
"""Transitions of an alarm in service; one that is shelved is shelved for another time."""
TRANSITIONS: Final[Mapping[AlarmState, Mapping[EventKind, AlarmState]]] = {
    AlarmState.NORMAL: {EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED, **SET_ASIDE},
    AlarmState.UNACKNOWLEDGED: {
        EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED,  # for another cause
        EventKind.ALARM_RETURNED: AlarmState.RETURNED,
        EventKind.ALARM_ACKNOWLEDGED: AlarmState.ACKNOWLEDGED,
        **SET_ASIDE,
    },
    AlarmState.ACKNOWLEDGED: {
        EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED,  # for another cause
        EventKind.ALARM_RETURNED: AlarmState.NORMAL,
        **SET_ASIDE,
    },
    AlarmState.RETURNED: {
        EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED,
        EventKind.ALARM_ACKNOWLEDGED: AlarmState.NORMAL,
        **SET_ASIDE,
    },
    AlarmState.SHELVED: {
        EventKind.ALARM_RAISED: AlarmState.SHELVED,  # in the journal, and not shown
        EventKind.ALARM_RETURNED: AlarmState.SHELVED,
        EventKind.ALARM_UNSHELVED: AlarmState.NORMAL,  # and raised again when active
        **SET_ASIDE,
    },
    AlarmState.OUT_OF_SERVICE: {EventKind.ALARM_IN_SERVICE: AlarmState.NORMAL},  # and raised again when active
}
"""The state after an event. What is not here does not happen: it changes nothing, and nothing is noted."""

COMMANDED: Final[Mapping[int, EventKind]] = {
    AlarmAction.ACKNOWLEDGE: EventKind.ALARM_ACKNOWLEDGED,
    AlarmAction.SHELVE: EventKind.ALARM_SHELVED,
    AlarmAction.UNSHELVE: EventKind.ALARM_UNSHELVED,
    AlarmAction.OUT_OF_SERVICE: EventKind.ALARM_OUT_OF_SERVICE,
    AlarmAction.IN_SERVICE: EventKind.ALARM_IN_SERVICE,
}
"""The event that an operator's action asks for."""


NOT: Final = 2**62
"""Sentinel for the tick since which a condition differs: it does not differ."""


class AlarmConstants(NamedTuple):
    """Delays of all alarms in ticks, by number; then the alarms of bands, by band."""

    on_delays: Sequence[int]
    off_delays: Sequence[int]
    bands: Sequence[int]
    """Number of the alarm."""
    outputs: Sequence[int]
    low: Numbers
    high: Numbers
    dead: Numbers
    """Deadband: how much wider the band is while its alarm is not active."""


@dataclass(slots=True)
class AlarmConditions:
    """State of the conditions, by number of the alarm."""

    active: list[bool]
    """Whether it is active: its condition held for longer than its on-delay, and has not ended for its off-delay."""
    since: list[int]
    """`NOT`, or since which tick the condition is another than `active` says."""


def follow(c: AlarmConstants, a: AlarmConditions, kind: int, condition: bool, tick: int) -> bool:  # noqa: FBT001 compiled
    """Take the condition of an alarm at a tick; return whether `active` is to follow it now."""
    if condition == a.active[kind]:
        a.since[kind] = NOT
        return False
    if a.since[kind] == NOT:
        a.since[kind] = tick
    return tick - a.since[kind] >= (c.off_delays[kind] if a.active[kind] else c.on_delays[kind])


def watch_bands(c: AlarmConstants, a: AlarmConditions, tick: int, y: Numbers, cooling: bool) -> bool:  # noqa: FBT001
    """Take the outputs of a tick; return whether the alarm of a band is to follow its condition.

    While the plant is being cooled down it is not to be in its bands yet.
    """
    due = False
    for band in range(len(c.bands)):
        kind, value = c.bands[band], y[c.outputs[band]]
        dead = 0.0 if a.active[kind] else c.dead[band]
        outside = not (cooling or c.low[band] - dead <= value <= c.high[band] + dead)
        due = follow(c, a, kind, outside, tick) or due
    return due


class AlarmPanel(AlarmConditions):
    """All alarms; each transition is noted in the journal. Without settings nothing is delayed."""

    def __init__(self, journal: Journal, settings: AlarmSettings | None = None) -> None:
        without_delay = {"capacity": RuleSettings(on_delay_s=0.0)}
        settings = settings or AlarmSettings(band_delay_s=0.0, rules=without_delay)
        process = settings.process
        self._journal = journal
        self._settings = settings
        self._rules = [settings.rule(alarm) for alarm in common.alarms_of(process)]
        super().__init__(active=[False for _ in self._rules], since=[NOT for _ in self._rules])
        low, high = zip(*settings.bands.values(), strict=True) if settings.bands else ((), ())
        self.constants = AlarmConstants(
            [settings.ticks(rule.on_delay_s) for rule in self._rules],
            [settings.ticks(rule.off_delay_s) for rule in self._rules],
            [int(each) for each in common.band_alarms(process)], process.controlled, low, high, process.dead_bands,
        )  # fmt: skip
        self.reports: dict[int, tuple[int, float]] = {}
        """Last reported cause and value of alarms that are about to follow their condition, without those of bands."""
        self._causes: dict[int, set[int]] = {}
        """Causes for which an active alarm has been raised since its last acknowledgement."""
        self._may_be_shelved = True
        self._now = 0
        self.rows = [Alarm(priority=rule.priority) for rule in self._rules]
        """Alarms as the registers show them, by number of the alarm."""
        self.changes = 0
        """Rises with every change, so that who shows the alarms knows when to."""

    @property
    def now(self) -> int:
        """Tick of plant time, noted with what happens.

        When it is set forward, all that time has passed. When it is set back, all timers move back with it: delays keep
        what has elapsed of them, and shelved alarms what is left.
        """
        return self._now

    @now.setter
    def now(self, tick: int) -> None:
        back = self._now - tick
        self._now = tick
        if back <= 0:
            return
        self.since[:] = [since if since == NOT else since - back for since in self.since]
        for kind in self._shelved():
            self._store(kind, shelved_until=max(tick + 1, self.rows[kind].shelved_until - back))

    def pass_by(self) -> None:
        """Apply expired delays and shelving times; call it once per scan."""
        for kind, since in enumerate(self.since):
            if since != NOT:
                self.settle(kind)
        for kind in self._shelved():
            if self.now >= self.rows[kind].shelved_until:
                self._step(kind, EventKind.ALARM_UNSHELVED)

    def report(self, kind: int, *, condition: bool, cause: int = 0, value: float = 0.0) -> None:
        """Report the condition of an alarm and its cause; a new cause raises the alarm again, whatever the value."""
        row = self.rows[kind]
        if follow(self.constants, self, kind, condition, self._now) or self.since[kind] != NOT:
            self.reports[kind] = cause, value
            self.settle(kind)
            return
        self.reports.pop(kind, None)
        if condition and cause != row.cause:
            if cause in self._causes[kind]:  # alternating causes are not new
                self._store(kind, cause=cause)
            else:
                self._raise(kind, cause, value)

    @property
    def next_report(self) -> float:
        """The tick at which an alarm, but those of bands, follows the condition that was reported; else infinity."""
        return min((self.since[kind] + self._delay(kind) for kind in self.reports), default=math.inf)

    def _delay(self, kind: int) -> int:
        return (self.constants.off_delays if self.active[kind] else self.constants.on_delays)[kind]

    def raised(self, kind: int, cause: int = 0) -> None:
        """Report that the condition of an alarm holds, and its cause."""
        self.report(kind, condition=True, cause=cause)

    def returned(self, kind: int) -> None:
        """Report that the condition of an alarm has ended."""
        if self.active[kind] or self.since[kind] != NOT:
            self.report(kind, condition=False)

    def pulse(self, kind: int, cause: int = 0) -> None:
        """Report an instantaneous condition: the alarm returns an off-delay after the last one.

        An alarm with an on-delay is not raised by it.
        """
        self.raised(kind, cause)
        self.returned(kind)

    def settle(self, kind: int) -> None:
        """Let a change of a condition take effect if its delay is over."""
        if self._now - self.since[kind] < self._delay(kind):
            return
        self.since[kind] = NOT
        cause, value = self.reports.pop(kind, (0, 0.0))
        if not self.active[kind]:
            self._raise(kind, cause, value)
        elif self.rows[kind].state == AlarmState.OUT_OF_SERVICE:
            self._store(kind, active=0, returned=self.now)
        else:
            self._step(kind, EventKind.ALARM_RETURNED, active=0, returned=self.now)

    def _raise(self, kind: int, cause: int, value: float = 0.0) -> None:
        row = self.rows[kind]
        if not row.active:
            self._causes[kind] = set()
        self._causes[kind].add(cause)
        if row.state == AlarmState.OUT_OF_SERVICE:  # it is worked on: followed, and not noted
            self._store(kind, active=1, cause=cause)
        else:
            times = (row.times + 1) & 0xFFFF
            self._step(kind, EventKind.ALARM_RAISED, value=value, active=1, cause=cause, times=times, raised=self.now)

    # -- operators, restarts -------------------------------------------------------------------------------------------

    def command(self, command: AlarmCommand, who: str = "") -> None:
        """Carry out an operator's command; an impossible one changes nothing."""
        event = COMMANDED.get(command.action)
        if event is None:
            return
        ticks = self._settings.shelving_ticks(command.time)
        until, time_s = min(self.now + ticks, 0xFFFFFFFF), ticks * self._settings.process.tick_s
        for kind in range(len(self.rows)):
            if command.alarm not in (kind, common.ALL_ALARMS):
                continue
            if event is not EventKind.ALARM_SHELVED:
                self._step(kind, event, who=who)
            elif until != self.rows[kind].shelved_until:
                self._step(kind, event, who=who, value=time_s, shelved_until=until)

    def restore(self, rows: Sequence[Alarm]) -> None:
        """Take the alarms of before a restart; priorities are those of the configuration."""
        self.rows = [row._replace(priority=rule.priority) for row, rule in zip(rows, self._rules, strict=True)]
        self._causes = {kind: {row.cause} for kind, row in enumerate(rows) if row.active}
        # An instantaneous alarm has no end.
        self.active[:] = [bool(row.active) for row in rows]
        self._may_be_shelved = True
        self.reports = {kind: (0, 0.0) for kind in PASSING if self.active[kind]}
        self.since[:] = [self.now if kind in self.reports else NOT for kind in range(len(self.rows))]
        self.changes += 1

    # -- the state machine ---------------------------------------------------------------------------------------------

    def _step(self, kind: int, event: EventKind, *, who: str = "", value: float = 0.0, **fields: int) -> None:
        """Make the transition of an event, if there is one, and note it."""
        before = AlarmState(self.rows[kind].state)
        after = TRANSITIONS[before].get(event)
        if after is None:
            return
        if after is not AlarmState.SHELVED:
            fields["shelved_until"] = 0
        self._store(kind, state=after, **fields)
        row = self.rows[kind]
        if event is EventKind.ALARM_ACKNOWLEDGED:
            self._causes[kind] = {row.cause}
        self._journal.note(self.now, event, kind, row.cause, value=value, who=who)
        suppressed = before in (AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE)
        if suppressed and after is AlarmState.NORMAL and row.active:
            self._raise(kind, row.cause)

    def _store(self, kind: int, **fields: int) -> None:
        row = self.rows[kind] = self.rows[kind]._replace(**fields)
        self.active[kind] = bool(row.active)
        self._may_be_shelved = self._may_be_shelved or row.state == AlarmState.SHELVED
        self.changes += 1

    def _shelved(self) -> list[int]:
        if not self._may_be_shelved:
            return []
        found = [i for i, row in enumerate(self.rows) if row.state == AlarmState.SHELVED]
        self._may_be_shelved = bool(found)
        return found
