"""Alarms with the states of ANSI/ISA-18.2-2016 (clause 5.4, alarm state transition diagram).

    condition ──on-delay, off-delay──> active ──TRANSITIONS──> state ──> registers, journal

A condition is reported as it is (`report`, `raised`, `returned`, `pulse`). When it has changed for the delay of its
alarm, `active` follows, and the state makes a transition. Operators make the others. All times are plant time, measured
by ticks and not by scans: scans can be missed.

"Suppressed by design" of the standard is not there: no alarm depends on another one.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from coldloop.registers.audit import EventKind
from coldloop.registers.safety import ALL_ALARMS, Alarm, AlarmAction, AlarmCommand, AlarmState, alarms_of, band_alarms
from coldloop.service.journal import Journal
from coldloop_control_plc.alarm_settings import OF_THE_PROCESS, PASSING, AlarmSettings, RuleSettings

TRANSITIONS: Final[Mapping[AlarmState, Mapping[EventKind, AlarmState]]] = {
    AlarmState.NORMAL: {
        EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED,
        EventKind.ALARM_SHELVED: AlarmState.SHELVED,
        EventKind.ALARM_OUT_OF_SERVICE: AlarmState.OUT_OF_SERVICE,
    },
    AlarmState.UNACKNOWLEDGED: {
        EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED,  # for another cause
        EventKind.ALARM_RETURNED: AlarmState.RETURNED,
        EventKind.ALARM_ACKNOWLEDGED: AlarmState.ACKNOWLEDGED,
        EventKind.ALARM_SHELVED: AlarmState.SHELVED,
        EventKind.ALARM_OUT_OF_SERVICE: AlarmState.OUT_OF_SERVICE,
    },
    AlarmState.ACKNOWLEDGED: {
        EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED,  # for another cause
        EventKind.ALARM_RETURNED: AlarmState.NORMAL,
        EventKind.ALARM_SHELVED: AlarmState.SHELVED,
        EventKind.ALARM_OUT_OF_SERVICE: AlarmState.OUT_OF_SERVICE,
    },
    AlarmState.RETURNED: {
        EventKind.ALARM_RAISED: AlarmState.UNACKNOWLEDGED,
        EventKind.ALARM_ACKNOWLEDGED: AlarmState.NORMAL,
        EventKind.ALARM_SHELVED: AlarmState.SHELVED,
        EventKind.ALARM_OUT_OF_SERVICE: AlarmState.OUT_OF_SERVICE,
    },
    AlarmState.SHELVED: {
        EventKind.ALARM_RAISED: AlarmState.SHELVED,  # in the journal, and not shown
        EventKind.ALARM_RETURNED: AlarmState.SHELVED,
        EventKind.ALARM_SHELVED: AlarmState.SHELVED,  # for another time
        EventKind.ALARM_UNSHELVED: AlarmState.NORMAL,  # and raised again when active
        EventKind.ALARM_OUT_OF_SERVICE: AlarmState.OUT_OF_SERVICE,
    },
    AlarmState.OUT_OF_SERVICE: {
        EventKind.ALARM_IN_SERVICE: AlarmState.NORMAL,  # and raised again when active
    },
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


class _Pending(NamedTuple):
    """A change of a condition that `active` does not show yet: it waits for its delay."""

    since: int
    """Tick."""
    cause: int
    value: float


class AlarmPanel:
    """All alarms.

    Args:
        journal: Where each transition is noted.
        settings: Priorities, delays, shelving; without them nothing is delayed.
    """

    def __init__(self, journal: Journal, settings: AlarmSettings | None = None) -> None:
        without_delay = {"capacity": RuleSettings(on_delay_s=0.0)}
        settings = settings or AlarmSettings(band_delay_s=0.0, rules=without_delay)
        self._journal = journal
        self._settings = settings
        self._of_the_process = {*OF_THE_PROCESS, *band_alarms(settings.process)}
        self._rules = [settings.rule(alarm) for alarm in alarms_of(settings.process)]
        self._pending: dict[int, _Pending] = {}
        self._causes: dict[int, set[int]] = {}
        """Causes for which an active alarm has been raised since its last acknowledgement."""
        self._now = 0
        self.rows = [Alarm(priority=rule.priority) for rule in self._rules]
        """What the registers show, by number of the alarm."""
        self.changes = 0
        """Rises with every change, so that who shows the alarms knows when to."""

    # -- time ----------------------------------------------------------------------------------------------------------

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
        self._pending = {kind: each._replace(since=each.since - back) for kind, each in self._pending.items()}
        for kind in self._shelved():
            self._store(kind, shelved_until=max(tick + 1, self.rows[kind].shelved_until - back))

    def begin_at(self, tick: int) -> None:
        """Set the tick, which may lie before the present one."""
        self.now = tick

    def pass_by(self) -> None:
        """Apply expired delays and shelving times; call it once per scan."""
        for kind in list(self._pending):
            self._settle(kind)
        for kind in self._shelved():
            if self.now >= self.rows[kind].shelved_until:
                self._step(kind, EventKind.ALARM_UNSHELVED)

    # -- conditions ----------------------------------------------------------------------------------------------------

    def report(self, kind: int, *, condition: bool, cause: int = 0, value: float = 0.0) -> None:
        """Report the condition of an alarm and its cause; a new cause raises the alarm again, whatever the value."""
        row = self.rows[kind]
        if condition != bool(row.active):
            earlier = self._pending.get(kind)
            self._pending[kind] = _Pending(self.now if earlier is None else earlier.since, cause, value)
            self._settle(kind)
            return
        self._pending.pop(kind, None)
        if condition and cause != row.cause:
            if cause in self._causes[kind]:  # alternating causes are not new
                self._store(kind, cause=cause)
            else:
                self._raise(kind, cause, value)

    def pending(self, *kinds: int) -> list[int | None]:
        """Return since when the condition of each alarm has differed from its shown state; None where it does not."""
        changes = map(self._pending.get, kinds)
        return [None if change is None else change.since for change in changes]

    def set_pending(self, kind: int, since: int | None) -> None:
        """Set since when the condition of an alarm has differed from its shown state."""
        self._pending.pop(kind, None)
        if since is not None:
            self._pending[kind] = _Pending(since, 0, 0.0)

    @property
    def are_quiet(self) -> bool:
        """No alarm but those of the process is active, or about to be."""
        others = (row for kind, row in enumerate(self.rows) if kind not in self._of_the_process)
        return not any(row.active for row in others) and all(kind in self._of_the_process for kind in self._pending)

    def reported(self, kind: int) -> int:
        """Return the cause last reported of an alarm, whatever its delay; 0 where its condition does not hold."""
        pending, row = self._pending.get(kind), self.rows[kind]
        if pending is None:
            return row.cause if row.active else 0
        return 0 if row.active else pending.cause

    def due(self, kind: int) -> float:
        """Return the tick at which an alarm follows its condition; infinite where it already does."""
        (since,) = self.pending(kind)
        return math.inf if since is None else since + self.delay(kind)

    def delay(self, kind: int) -> int:
        """Return the delay (ticks) after which an alarm follows its condition."""
        rule = self._rules[kind]
        return self._settings.ticks(rule.off_delay_s if self.rows[kind].active else rule.on_delay_s)

    def raised(self, kind: int, cause: int = 0) -> None:
        """Report that the condition of an alarm holds, and its cause."""
        self.report(kind, condition=True, cause=cause)

    def returned(self, kind: int) -> None:
        """Report that the condition of an alarm has ended."""
        self.report(kind, condition=False)

    def pulse(self, kind: int, cause: int = 0) -> None:
        """Report an instantaneous condition: the alarm returns an off-delay after the last one.

        An alarm with an on-delay is not raised by it.
        """
        self.raised(kind, cause)
        self.returned(kind)

    def _settle(self, kind: int) -> None:
        """Let a change of a condition take effect if its delay is over."""
        pending = self._pending[kind]
        if self.now - pending.since < self.delay(kind):
            return
        del self._pending[kind]
        if self.rows[kind].active:
            self._return(kind)
        else:
            self._raise(kind, pending.cause, pending.value)

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

    def _return(self, kind: int) -> None:
        if self.rows[kind].state == AlarmState.OUT_OF_SERVICE:
            self._store(kind, active=0, returned=self.now)
        else:
            self._step(kind, EventKind.ALARM_RETURNED, active=0, returned=self.now)

    # -- operators, restarts -------------------------------------------------------------------------------------------

    def command(self, command: AlarmCommand, who: str = "") -> None:
        """Carry out an operator's command; an impossible one changes nothing."""
        event = COMMANDED.get(command.action)
        if event is None:
            return
        for kind in range(len(self.rows)):
            if command.alarm not in (kind, ALL_ALARMS):
                continue
            if event is EventKind.ALARM_SHELVED:
                self._shelve(kind, command.time, who)
            else:
                self._step(kind, event, who=who)

    def _shelve(self, kind: int, asked_s: int, who: str) -> None:
        ticks = self._settings.shelving_ticks(asked_s)
        until = min(self.now + ticks, 0xFFFFFFFF)
        if until != self.rows[kind].shelved_until:
            self._step(
                kind, EventKind.ALARM_SHELVED, who=who, value=ticks * self._settings.process.tick_s, shelved_until=until
            )

    def restore(self, rows: Sequence[Alarm]) -> None:
        """Take the alarms of before a restart; priorities are those of the configuration."""
        self.rows = [row._replace(priority=rule.priority) for row, rule in zip(rows, self._rules, strict=True)]
        self._causes = {kind: {row.cause} for kind, row in enumerate(rows) if row.active}
        # An instantaneous alarm has no end.
        self._pending = {kind: _Pending(self.now, 0, 0.0) for kind in PASSING if self.rows[kind].active}
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
        self.rows[kind] = self.rows[kind]._replace(**fields)
        self.changes += 1

    def _shelved(self) -> list[int]:
        return [i for i, row in enumerate(self.rows) if row.state == AlarmState.SHELVED]
