"""The alarms that depend on the process and on the ladder, watched once a scan."""

from collections.abc import Collection, Sequence

from coldloop.process.signals import L1, T5
from coldloop.registers.audit import EventKind
from coldloop.registers.control_plc import Cause, Mode
from coldloop.registers.safety import AlarmKind, CapacityCause
from coldloop.service.journal import Journal
from control_plc.alarm_settings import AlarmSettings
from control_plc.alarms import AlarmPanel
from control_plc.ladder import Ladder


class ProcessAlarms:
    """Raises and returns alarms.

    Args:
        panel: Whose alarms they are.
        journal: Where sensors that became bad or good are noted.
        bands: Has the bands of L1 and T5.
    """

    def __init__(self, panel: AlarmPanel, journal: Journal, bands: AlarmSettings) -> None:
        self._panel = panel
        self._journal = journal
        self._bands = bands
        self._bad_before: frozenset[int] = frozenset()

    def watch(
        self,
        tick: int,
        y: Sequence[float],
        ladder: Ladder,
        *,
        late: bool,
        optimizer: bool,
        shortage: float,
        bad: Collection[int],
    ) -> None:
        """Look at everything after a scan.

        Args:
            tick: Of the scan.
            y: Outputs, bad ones substituted.
            ladder: Mode and its cause.
            late: The rest of a sequence is being played.
            optimizer: Its heartbeat is present.
            shortage: What the load is above what can be held, in W; negative: below what is needed.
            bad: Outputs that are substituted.
        """
        report = self._panel.report
        for kind, value, (low, high) in (
            (AlarmKind.LEVEL_BAND, y[L1], self._bands.level_band),
            (AlarmKind.T5_BAND, y[T5], self._bands.t5_band),
        ):
            report(kind, condition=not low <= value <= high)
        mode, cause = ladder.mode, ladder.cause
        fallen = mode is not Mode.MPC and cause not in (Cause.SESSION_STARTED, Cause.OPERATOR)
        report(AlarmKind.MODE, condition=fallen, cause=cause)
        exhausted = mode is not Mode.MPC and cause in (Cause.SEQUENCE_EXHAUSTED, Cause.HOLD_EXPIRED)
        report(AlarmKind.SEQUENCE_EXHAUSTED, condition=exhausted)
        report(AlarmKind.SEQUENCE_LATE, condition=late)
        report(AlarmKind.OPTIMIZER_LOST, condition=not optimizer)
        short = CapacityCause.of(shortage if mode is Mode.MPC else 0.0)
        report(AlarmKind.CAPACITY, condition=bool(short), cause=short, value=abs(shortage))
        self._watch_sensors(tick, frozenset(bad))

    def _watch_sensors(self, tick: int, bad: frozenset[int]) -> None:
        """Note each sensor that became bad or good, and raise the alarm; its cause is the newest one's output."""
        for output in sorted(bad ^ self._bad_before):
            self._journal.note(tick, EventKind.SENSOR, output, int(output in bad))
        for output in sorted(bad - self._bad_before):
            self._panel.raised(AlarmKind.SENSOR_BAD, output)
        if not bad:
            self._panel.returned(AlarmKind.SENSOR_BAD)
        self._bad_before = bad
