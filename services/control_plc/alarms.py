"""Alarms with the states of ANSI/ISA-18.2."""

from collections.abc import Sequence

from coldloop.journal import Journal
from coldloop.process import TICK_S
from coldloop.registers.audit import EventKind
from coldloop.registers.safety import ALL_ALARMS, Alarm, AlarmAction, AlarmCommand, AlarmKind, AlarmState

PASSING = (AlarmKind.SCAN_OVERRUN, AlarmKind.ACCESS_REFUSED)
"""Alarms for something that happens at an instant."""
PASSING_TICKS = round(60 / TICK_S)
"""They return when it has not happened again for so long."""


class AlarmPanel:
    """All alarms; `now` is the tick that is noted with what happens."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._happened: dict[AlarmKind, int] = {}
        self.rows = [Alarm()] * len(AlarmKind)
        self.now = 0
        self.changes = 0
        """Rises with every change, so that who shows the alarms knows when to."""

    def raised(self, kind: AlarmKind, cause: int = 0) -> None:
        """Raise an alarm, or raise it again for another cause."""
        row = self.rows[kind]
        if row.active and row.cause == cause:
            return
        state = AlarmState.SHELVED if row.state == AlarmState.SHELVED else AlarmState.UNACKNOWLEDGED
        times = (row.times + 1) & 0xFFFF
        self._change(kind, row._replace(state=state, active=1, cause=cause, times=times, raised=self.now))
        self._journal.note(self.now, EventKind.ALARM_RAISED, kind, cause)

    def returned(self, kind: AlarmKind) -> None:
        """Tell that the condition of an alarm has ended."""
        row = self.rows[kind]
        if not row.active:
            return
        after = {
            AlarmState.UNACKNOWLEDGED: AlarmState.RETURNED,
            AlarmState.ACKNOWLEDGED: AlarmState.NORMAL,
        }  # a shelved alarm stays shelved
        state = after.get(AlarmState(row.state), AlarmState(row.state))
        self._change(kind, row._replace(state=state, active=0, returned=self.now))
        self._journal.note(self.now, EventKind.ALARM_RETURNED, kind, row.cause)

    def holds(self, kind: AlarmKind, *, condition: bool, cause: int = 0) -> None:
        """Raise or return an alarm, as its condition is."""
        if condition:
            self.raised(kind, cause)
        else:
            self.returned(kind)

    def begin_at(self, tick: int) -> None:
        """Go on at a tick that may lie before the present one."""
        self.now = tick
        self._happened = {kind: min(happened, tick) for kind, happened in self._happened.items()}

    def restore(self, rows: Sequence[Alarm]) -> None:
        """Take the alarms of before a restart; what happened at an instant may pass by again."""
        self.rows = list(rows)
        self._happened = {kind: self.now for kind in PASSING if self.rows[kind].active}
        self.changes += 1

    def happened(self, kind: AlarmKind) -> None:
        """Raise an alarm for something that happens at an instant; `pass_by` returns it."""
        self._happened[kind] = self.now
        self.raised(kind)

    def pass_by(self) -> None:
        """Return the alarms of what has not happened again for a while."""
        for kind, tick in list(self._happened.items()):
            if self.now - tick > PASSING_TICKS:
                del self._happened[kind]
                self.returned(kind)

    def command(self, command: AlarmCommand, who: str = "") -> None:  # noqa: ARG002
        """Do what an operator asks for; what makes no sense changes nothing."""
        kinds = list(AlarmKind) if command.alarm == ALL_ALARMS else [k for k in AlarmKind if k == command.alarm]
        for kind in kinds:
            if command.action == AlarmAction.ACKNOWLEDGE:
                self._acknowledge(kind)
            elif command.action == AlarmAction.SHELVE:
                self._shelve(kind)
            elif command.action == AlarmAction.UNSHELVE:
                self._unshelve(kind)

    def _acknowledge(self, kind: AlarmKind) -> None:
        row = self.rows[kind]
        after = {AlarmState.UNACKNOWLEDGED: AlarmState.ACKNOWLEDGED, AlarmState.RETURNED: AlarmState.NORMAL}
        state = after.get(AlarmState(row.state))
        if state is not None:
            self._change(kind, row._replace(state=state))
            self._journal.note(self.now, EventKind.ALARM_ACKNOWLEDGED, kind, row.cause)

    def _shelve(self, kind: AlarmKind) -> None:
        row = self.rows[kind]
        if row.state != AlarmState.SHELVED:
            self._change(kind, row._replace(state=AlarmState.SHELVED))
            self._journal.note(self.now, EventKind.ALARM_SHELVED, kind, row.cause)

    def _unshelve(self, kind: AlarmKind) -> None:
        row = self.rows[kind]
        if row.state == AlarmState.SHELVED:
            state = AlarmState.UNACKNOWLEDGED if row.active else AlarmState.NORMAL
            self._change(kind, row._replace(state=state))
            self._journal.note(self.now, EventKind.ALARM_UNSHELVED, kind, row.cause)

    def _change(self, kind: AlarmKind, row: Alarm) -> None:
        self.rows[kind] = row
        self.changes += 1
