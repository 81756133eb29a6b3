"""What is kept of a run under chaos to judge it: the physical trace with its gaps, events, alarms, and its faults."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from coldloop.process.declaration import Process
from coldloop.registers.audit import Event, EventKind
from coldloop.registers.control_plc import LadderStatus
from coldloop.registers.plant import PlantSample
from coldloop.registers.safety import Alarm
from coldloop_rig.chaos.faults import AnyFault
from coldloop_rig.results.driving import CONTROL
from coldloop_rig.results.recording import LinkStatistics, Recording, Sink


@dataclass
class Mark:
    """A fault as it really was."""

    fault: AnyFault
    begin: int
    """Last tick that was seen before it began."""
    end: int | None = None
    """Tick at which it ended, and what it had stopped answered again."""
    first_event: int = 0
    """Index in `ChaosTrace.events` of the first one after its beginning. Ticks alone are ambiguous: a control PLC that
    was restarted resumes one tick back."""
    done: int | None = None
    """First tick that was seen when it had been brought about: a process had ended by then."""


class Resources(NamedTuple):
    """What the processes use at one tick."""

    tick: int
    seconds: float
    """Real time from the start of the session."""
    rss_mb: dict[str, float]
    """Resident memory of those that run, by service."""


@dataclass
class ChaosTrace(Sink):
    """Collects during a run; ticks that were not recorded stay NaN."""

    ticks: int
    process: Process
    events: list[Event] = field(default_factory=list)
    """Of the control PLC, as they came."""
    alarms: list[Alarm] = field(default_factory=list)
    ladder: LadderStatus | None = None
    marks: list[Mark] = field(default_factory=list)
    resources: list[Resources] = field(default_factory=list)
    log_lines: dict[str, int] = field(default_factory=dict)
    lost_contacts: int = 0
    """Requests of the rig's own that were not answered."""
    seconds: float = 0.0
    """Real time of the run."""

    def __post_init__(self) -> None:
        sizes = (1, len(self.process.inputs), len(self.process.outputs), len(self.process.states))
        self._rows = [np.full((self.ticks, size), np.nan, dtype=np.float32) for size in sizes]

    def sample(self, sample: PlantSample) -> None:
        """Take a tick; a tick that is done again replaces what was there."""
        for rows, values in zip(self._rows, ((sample.load,), sample.u, sample.y, sample.x), strict=True):
            rows[sample.tick] = np.array(values)

    def event(self, service: str, event: Event) -> None:
        """Take an event of a journal."""
        if service == CONTROL:
            self.events.append(event)

    def modes(self, first: int = 0, last: int | None = None) -> list[Event]:
        """Return the changes of mode among the events from one index to before another."""
        return [event for event in self.events[first:last] if event.kind == EventKind.MODE]

    @property
    def missing(self) -> int:
        """Ticks of which there is no sample."""
        return int(np.isnan(self._rows[0]).sum())

    def recording(self) -> Recording:
        """Return the physical trace in the form of an ordinary run's."""
        load, u, y, x = self._rows
        return Recording(load[:, 0], u, y, x, [], LinkStatistics())
