"""Effect of each fault of a run, from the trace, the events, and the same run without faults."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.declaration import Process
from coldloop.registers.audit import Event, EventKind
from coldloop.registers.control_plc import LadderStatus, Mode
from coldloop.registers.plant import PlantSample
from coldloop.registers.safety import Alarm, alarm_key
from coldloop_chaos.faults import AnyFault
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.results.indicators import excess_of
from coldloop_rig.results.recording import CONTROL, LinkStatistics, Recording, Sink


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
    """Resources that the processes use at one tick."""

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
    """Events of the control PLC, in the order of arrival."""
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


PerInput = tuple[float, ...]
PerBand = tuple[float, ...]


class RaisedAlarm(NamedTuple):
    """An alarm, and how long after the beginning of the fault it was raised."""

    name: str
    after_s: float
    after_done_s: float
    """Delay from the tick at which the fault was certainly in effect, s; in lock-step ticks pass between the two."""


class Row(NamedTuple):
    """One fault. Its window lasts from its beginning to that of the next one, or to the end of the run."""

    fault: str
    at_s: float
    lasted_s: float | None
    """Plant time, until what was stopped answered again; None when it did not end within the run."""
    modes: tuple[str, ...]
    """The mode before, and those passed until the next fault."""
    alarms: tuple[RaisedAlarm, ...]
    """Alarms raised in the window."""
    largest_steps: PerInput
    """Largest change of each input from a tick to the next, as a share of its limit."""
    outside_s: PerBand
    """Time in the window that each output with a band was outside, beyond its dead band."""
    undisturbed_s: PerBand
    """Time outside in the same window of the run without faults, s."""
    back_s: float | None
    """Time from the end of the fault to mode MPC, s: 0 if MPC drove then, None if it did not return in the window."""

    @property
    def largest_step(self) -> float:
        """The largest share among the inputs."""
        return max(self.largest_steps)


class Evaluation(NamedTuple):
    """A run."""

    rows: list[Row]
    largest_steps: PerInput
    outside_s: PerBand
    undisturbed_s: PerBand
    missing_ticks: int


def evaluate(trace: ChaosTrace, undisturbed: Recording, rate: PerInput, design: ControlDesign) -> Evaluation:
    """Compute the rows of all faults, and the same for the whole run; `rate` is the largest change of each input."""
    recording, tick_s = trace.recording(), trace.process.tick_s
    outside, outside_undisturbed = _outside(recording, design), _outside(undisturbed, design)
    steps = _steps(recording, rate)
    rows = [_row(trace, number, steps, (outside, outside_undisturbed)) for number in range(len(trace.marks))]
    return Evaluation(
        rows, _largest(steps), _seconds(outside, tick_s), _seconds(outside_undisturbed, tick_s), trace.missing
    )


def _row(
    trace: ChaosTrace, number: int, steps: NDArray[np.float64], outside: tuple[NDArray[np.bool_], NDArray[np.bool_]]
) -> Row:
    mark, following = trace.marks[number], trace.marks[number + 1 : number + 2]
    end, last_event, tick_s = trace.ticks, len(trace.events), trace.process.tick_s
    for later in following:
        end, last_event = later.begin, later.first_event
    before = [Mode(event.subject) for event in trace.modes(0, mark.first_event)[-1:]]
    changes = trace.modes(mark.first_event, last_event)
    return Row(
        fault=mark.fault.label,
        at_s=mark.begin * tick_s,
        lasted_s=None if mark.end is None else (mark.end - mark.begin) * tick_s,
        modes=tuple(mode.name for mode in _different([*before, *(Mode(event.subject) for event in changes)])),
        alarms=tuple(
            RaisedAlarm(
                alarm_key(event.subject, trace.process).upper(),
                max(0, event.tick - mark.begin) * tick_s,
                max(0, event.tick - (mark.begin if mark.done is None else mark.done)) * tick_s,
            )
            for event in trace.events[mark.first_event : last_event]
            if event.kind == EventKind.ALARM_RAISED
        ),
        largest_steps=_largest(steps[mark.begin : end]),
        outside_s=_seconds(outside[0][mark.begin : end], tick_s),
        undisturbed_s=_seconds(outside[1][mark.begin : end], tick_s),
        back_s=_back_s(mark.end, before, changes, tick_s),
    )


def _different(modes: Sequence[Mode]) -> list[Mode]:
    """Return modes without repetitions."""
    return [mode for mode, previous in zip(modes, [None, *modes], strict=False) if mode is not previous]


def _back_s(end: int | None, before: Sequence[Mode], changes: Sequence[Event], tick_s: float) -> float | None:
    """Return the time from the end of a fault until MPC drives; None when it does not."""
    if end is None:
        return None
    at_end = [*before, *(Mode(event.subject) for event in changes if event.tick <= end)]
    if at_end and at_end[-1] is Mode.MPC:
        return 0.0
    back = [event.tick for event in changes if event.tick > end and event.subject == Mode.MPC]
    return (back[0] - end) * tick_s if back else None


def _steps(recording: Recording, rate: PerInput) -> NDArray[np.float64]:
    """Return the change of each input at each tick as a share of its limit, (N, 3); NaN where it is not known."""
    u = recording.u.astype(float)
    steps: NDArray[np.float64] = np.abs(np.diff(u, axis=0, prepend=u[:1])) / np.array(rate)
    return steps


def _largest(steps: NDArray[np.float64]) -> PerInput:
    return tuple(np.max(np.nan_to_num(steps), axis=0, initial=0.0).tolist())


def _outside(recording: Recording, design: ControlDesign) -> NDArray[np.bool_]:
    """Return for each tick whether outputs are outside their bands, (N, bands); False for unknown ticks."""
    outside: NDArray[np.bool_] = excess_of(recording.y, design) > design.process.dead_bands
    return outside


def _seconds(outside: NDArray[np.bool_], tick_s: float) -> PerBand:
    return tuple((outside.sum(axis=0) * tick_s).tolist())
