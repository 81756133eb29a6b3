"""The alarms that depend on the process and on the ladder, watched once a scan."""

from collections.abc import Collection, Sequence
from typing import Final

from coldloop.process.sections import Range
from coldloop.registers.audit import EventKind
from coldloop.registers.control_plc import Cause, Mode
from coldloop.registers.safety import AlarmKind, CapacityCause, band_alarms
from coldloop.service.journal import Journal
from coldloop_control_plc.alarm_settings import AlarmSettings
from coldloop_control_plc.alarms import AlarmPanel
from coldloop_control_plc.ladder import Ladder

SENSORS: Final = {AlarmKind.SENSOR_BAD: 1, AlarmKind.SENSOR_SUSPECT: 2}
"""Alarms of sensors, and the cause of their events."""
OPTIMIZER_DRIVES: Final = (Mode.MPC, Mode.REST)
"""Modes in which the optimiser's sequences are played."""


def present_limits(settings: AlarmSettings, panel: AlarmPanel) -> list[Range]:
    """Return the limits of each output with a band: its band while its alarm is raised, wider by the dead band else."""
    process = settings.process
    every = zip(settings.bands.values(), process.dead_bands, band_alarms(process), strict=True)
    return [
        (low, high) if panel.rows[alarm].active else (low - dead_band, high + dead_band)
        for (low, high), dead_band, alarm in every
    ]


class ProcessAlarms:
    """Raises and returns alarms.

    Args:
        panel: Whose alarms they are.
        journal: Where sensors that became bad or good are noted.
        settings: With the bands.
    """

    def __init__(self, panel: AlarmPanel, journal: Journal, settings: AlarmSettings) -> None:
        self._panel = panel
        self._journal = journal
        self._settings = settings
        self._controlled, self._alarms = settings.process.controlled, band_alarms(settings.process)
        self._raised: list[int] = []
        self._limits: list[Range] = []
        self._before: dict[AlarmKind, frozenset[int]] = dict.fromkeys(SENSORS, frozenset())
        self._suspects = 0

    def watch(
        self,
        tick: int,
        y: Sequence[float],
        ladder: Ladder,
        *,
        cooling: bool,
        late: bool,
        optimizer: bool,
        shortage: float,
        bad: Collection[int],
        suspects: int,
    ) -> None:
        """Look at everything after a scan.

        Args:
            tick: Of the scan.
            y: Outputs, bad ones substituted.
            ladder: Mode and its cause.
            cooling: The plant is being cooled down: it is not to be in its bands yet.
            late: The rest of a sequence is being played.
            optimizer: Its heartbeat is present.
            shortage: What the load is above what can be held, in W; negative: below what is needed.
            bad: Outputs that are substituted.
            suspects: Outputs that the optimiser does without: bit i is output i; then inputs that have no effect.
        """
        report = self._panel.report
        raised = [self._panel.rows[alarm].active for alarm in self._alarms]
        if raised != self._raised:
            self._raised, self._limits = raised, present_limits(self._settings, self._panel)
        for alarm, output, (low, high) in zip(self._alarms, self._controlled, self._limits, strict=True):
            report(alarm, condition=not (cooling or low <= y[output] <= high))
        mode, cause = ladder.mode, ladder.cause
        fallen = mode is not Mode.MPC and cause not in (Cause.SESSION_STARTED, Cause.OPERATOR, Cause.COOL_DOWN)
        report(AlarmKind.MODE, condition=fallen, cause=cause)
        exhausted = mode is not Mode.MPC and cause in (Cause.SEQUENCE_EXHAUSTED, Cause.HOLD_EXPIRED)
        report(AlarmKind.SEQUENCE_EXHAUSTED, condition=exhausted)
        report(AlarmKind.SEQUENCE_LATE, condition=late)
        report(AlarmKind.OPTIMIZER_LOST, condition=not optimizer)
        short = CapacityCause.of(shortage if mode is Mode.MPC else 0.0)
        report(AlarmKind.CAPACITY, condition=bool(short), cause=short, value=abs(shortage))
        self._watch_sensors(tick, AlarmKind.SENSOR_BAD, frozenset(bad))
        self._suspects = suspects if mode in OPTIMIZER_DRIVES else 0
        named = [place for place in range(self._suspects.bit_length()) if self._suspects >> place & 1]
        self._watch_sensors(tick, AlarmKind.SENSOR_SUSPECT, frozenset(place for place in named if place < len(y)))
        idle = [place - len(y) for place in named if place >= len(y)]
        report(AlarmKind.INPUT_WITHOUT_EFFECT, condition=bool(idle), cause=idle[0] if idle else 0)

    def _watch_sensors(self, tick: int, kind: AlarmKind, found: frozenset[int]) -> None:
        """Note each sensor that became bad, suspect or good, and raise the alarm; its cause is the newest one."""
        before, self._before[kind] = self._before[kind], found
        for output in sorted(found ^ before):
            self._journal.note(tick, EventKind.SENSOR, output, SENSORS[kind] if output in found else 0)
        for output in sorted(found - before):
            self._panel.raised(kind, output)
        if not found:
            self._panel.returned(kind)

    def has_noted(self, suspects: int) -> bool:
        """Return whether these suspects are those of the last scan, in a mode of the optimiser."""
        return suspects == self._suspects
