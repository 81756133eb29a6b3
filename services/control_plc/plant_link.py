"""The control PLC's link to the rack as a state machine.

    IDLE        no session
    SEARCHING   the rack does not answer
    JOINING     it answers; what it applies is being read back
    IN_STEP     outputs are written in every scan, and taken
    NOT_TAKEN   it answers, and does not take the outputs
    FOREIGN     it is in another session, or somebody else drives it
    FROZEN      it answers, and its clock does not move

One rule decides: *no output is written unless what the rack applies was read back since the last break: sealed, finite,
of this session, at a known tick, and either what we had made it apply or read twice.* Only IN_STEP writes, and only a
reading that `read_back` accepts leads there; every doubt leads out of it. A single answer that lies about the outputs
thus moves nothing, even where it is the first after a break. The rack holds its side of the rule: it takes no outputs
that name another generation than the one that was read back. Pure: no sockets, no clock.
"""

import math
from collections.abc import Mapping
from typing import Final

from coldloop.registers.audit import EventKind
from coldloop.registers.control_plc import LinkCause, PlantLinkState
from coldloop.registers.plant import Actuators, Measurement, OutputVerdict
from coldloop.registers.safety import AlarmKind
from coldloop.service.journal import Journal
from control_plc.alarms import AlarmPanel

FROZEN_TICKS: Final = 4
"""In real time the rack is frozen when it shows the same tick for so many ticks of our clock, ..."""
FROZEN_S: Final = 0.5
"""... and for so long: a rack that is short of processor time is late, not frozen."""

ALARMS: Final = {
    PlantLinkState.SEARCHING: AlarmKind.PLANT_LOST,
    PlantLinkState.JOINING: AlarmKind.PLANT_LOST,
    PlantLinkState.NOT_TAKEN: AlarmKind.OUTPUTS_NOT_TAKEN,
    PlantLinkState.FOREIGN: AlarmKind.PLANT_FOREIGN,
    PlantLinkState.FROZEN: AlarmKind.PLANT_FROZEN,
}
SECOND_MASTER: Final = 2
"""Cause of the alarm SECOND_WRITER."""
HARMLESS: Final = (LinkCause.STARTED, LinkCause.OVERSLEPT, LinkCause.LEAPT, LinkCause.PACE)
"""Causes that raise no alarm: what will be read back is expected to be what we applied."""
NOT_TAKEN: Final = (PlantLinkState.NOT_TAKEN, LinkCause.REFUSED)
REFUSED_OUTPUTS: Final[Mapping[int, tuple[PlantLinkState, LinkCause]]] = {
    OutputVerdict.WRONG_SESSION: (PlantLinkState.FOREIGN, LinkCause.WRONG_SESSION),
    OutputVerdict.UNTIMELY: (PlantLinkState.NOT_TAKEN, LinkCause.UNTIMELY),
    OutputVerdict.CHANGED: (PlantLinkState.JOINING, LinkCause.CHANGED),
    OutputVerdict.LIMITED: (PlantLinkState.JOINING, LinkCause.LIMITED),
}


class PlantLink:
    """State, cause and counters of the link.

    Args:
        alarms: Where the alarms of the link are raised and returned; it also knows the present tick.
        journal: Where changes of state are noted.
        holder: Number that this control PLC has given itself, not 0.
    """

    def __init__(self, alarms: AlarmPanel, journal: Journal, holder: int) -> None:
        self._alarms = alarms
        self._journal = journal
        self.holder = holder
        self.state, self.cause, self.since = PlantLinkState.IDLE, LinkCause.NONE, 0
        self.breaks = 0
        """Times that outputs were no longer taken."""
        self._noted = PlantLinkState.IDLE
        """State that the journal knows of: in step when outputs have been taken, and not when they may be written."""
        self.frozen_ticks = float(FROZEN_TICKS)
        """How long the rack's tick may stand, in ticks of our clock."""
        self.generation = 0
        """Generation of the rack's outputs that was read back; 0 is none."""
        self._ours: tuple[tuple[float, ...], ...] = ()
        """Outputs that the rack applies in that generation: those taken last, and those sent since."""
        self._read: tuple[float, ...] = ()
        """Session, generation and outputs of the last reading that asks to be confirmed."""
        self.session = 0
        """That of the rack when it last answered; so the tick."""
        self.tick = 0
        self._moved_at: float | None = None
        self._refused = 0

    @property
    def in_step(self) -> bool:
        """Whether outputs may be written."""
        return self.state is PlantLinkState.IN_STEP

    @property
    def is_alarmed(self) -> bool:
        """An alarm of the link is active: it says why no outputs are written."""
        return any(self._alarms.rows[alarm].active for alarm in ALARMS.values())

    # -- events --------------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Begin a session: read back first. What the rack applied in the one before does not matter."""
        self.generation, self._read = 0, ()
        self._enter(PlantLinkState.JOINING, LinkCause.STARTED)

    def starting(self) -> None:
        """Note that the rack does not answer yet: both are being powered up."""
        self._enter(PlantLinkState.SEARCHING, LinkCause.STARTED)

    def end(self) -> None:
        """There is no session: nothing is written."""
        self._enter(PlantLinkState.IDLE, LinkCause.NONE)

    def unanswered(self, cause: LinkCause) -> None:
        """Note that a request came to nothing: what it has done to the rack is not known."""
        if cause is LinkCause.SECOND_MASTER:
            self._enter(PlantLinkState.FOREIGN, cause)
        elif cause is LinkCause.REFUSED:
            self._enter(PlantLinkState.NOT_TAKEN, cause)
        elif cause in (LinkCause.DAMAGED, LinkCause.IMPLAUSIBLE):
            self._enter(PlantLinkState.JOINING, cause)
        else:
            self._enter(PlantLinkState.SEARCHING, cause)

    def overslept(self) -> None:
        """Note that this program stood still: what the rack has done meanwhile is not known."""
        if self.in_step:
            self._enter(PlantLinkState.JOINING, LinkCause.OVERSLEPT)

    def repaced(self) -> None:
        """Note that the time base was changed: where the rack is, and how fast it moves, is found out anew."""
        self._moved_at = None
        if self.in_step:
            self._enter(PlantLinkState.JOINING, LinkCause.PACE)

    def read_back(self, reading: Measurement, session: int, now: float | None) -> bool:
        """Judge a reading that was asked for without writing; tell whether outputs may be written from it on.

        Args:
            reading: What the rack answered, its seal intact.
            session: Ours.
            now: Real time, in ticks from any beginning; None in lock-step.
        """
        changed = reading.generation != self.generation
        stopped = self._clock_stopped(reading, now)
        self._refused = reading.refused
        if reading.session != session or not session:
            self._enter(PlantLinkState.FOREIGN, LinkCause.WRONG_SESSION)
        elif not all(map(math.isfinite, reading.u)):
            self._enter(PlantLinkState.JOINING, LinkCause.IMPLAUSIBLE)
        elif stopped:
            self._enter(PlantLinkState.FROZEN, LinkCause.STOPPED)
        elif self._is_certain(reading, changed=changed):
            if changed and self.generation:  # somebody else, or its watchdog, has moved the outputs
                self._alarms.raised(AlarmKind.PLANT_LOST, LinkCause.CHANGED)
            self.generation, self._ours, self._read = reading.generation, (tuple(reading.u),), ()
            return True
        return False

    def addressed(self, outputs: Actuators) -> Actuators:
        """Return outputs as they are sent: from us, to the generation that was read back. The rack may apply them."""
        self._ours = (*self._ours[-1:], outputs[1:4])
        return outputs._replace(holder=self.holder, generation=self.generation)

    def joined(self) -> None:
        """The program goes on from what was read back: outputs may be written."""
        self._enter(PlantLinkState.IN_STEP, self.cause)

    def exchanged(self, sent: Actuators, answer: Measurement, now: float | None) -> bool:
        """Judge the answer to outputs; tell whether they are what the rack applies, at their tick.

        In real time the rack's tick may differ by one: it changes between two scans, and a scan may be late.
        """
        stopped = self._clock_stopped(answer, now)
        self._watch_others(answer)
        if answer.verdict != OutputVerdict.TAKEN:
            self._enter(*REFUSED_OUTPUTS.get(answer.verdict, NOT_TAKEN))
        elif answer.session != sent.session:
            self._enter(PlantLinkState.FOREIGN, LinkCause.WRONG_SESSION)
        elif answer.u != sent[1:4] or answer.holder != self.holder or answer.generation != self.generation:
            self._enter(PlantLinkState.JOINING, LinkCause.CHANGED)
        elif stopped:
            self._enter(PlantLinkState.FROZEN, LinkCause.STOPPED)
        elif abs(answer.tick - sent.tick) > (now is not None):
            self._enter(PlantLinkState.JOINING, LinkCause.LEAPT)
        else:
            return True
        return False

    def settled(self) -> None:
        """Note a scan that was taken: what was wrong with the rack is over."""
        if self._noted is not PlantLinkState.IN_STEP:
            self._note(PlantLinkState.IN_STEP)
        for alarm in ALARMS.values():
            self._alarms.returned(alarm)

    # -- inside --------------------------------------------------------------------------------------------------------

    def _is_certain(self, reading: Measurement, *, changed: bool) -> bool:
        """Tell whether the outputs of a reading are ours, or those that the reading before showed too."""
        outputs, before = tuple(reading.u), self._read
        self._read = (reading.session, reading.generation, *outputs)
        return self._read == before or (not changed and outputs in self._ours)

    def _watch_others(self, answer: Measurement) -> None:
        """Raise the alarm when the rack has refused somebody else's outputs."""
        if answer.refused != self._refused:
            self._refused = answer.refused
            self._alarms.happened(AlarmKind.SECOND_WRITER, SECOND_MASTER)

    def _clock_stopped(self, reading: Measurement, now: float | None) -> bool:
        """Note where the rack is; tell whether its clock has stopped. At tick 0 it waits for the first outputs."""
        moved = (reading.session, reading.tick) != (self.session, self.tick)
        self.session, self.tick = reading.session, reading.tick
        if now is None or moved or reading.tick == 0 or self._moved_at is None:
            self._moved_at = now
            return False
        return now - self._moved_at >= self.frozen_ticks

    def _enter(self, state: PlantLinkState, cause: LinkCause) -> None:
        if (state, cause) == (self.state, self.cause):
            return
        left, before = self.state, self.cause
        self.state, self.cause = state, cause
        if state is left:
            self._alarm(state, cause if before in HARMLESS else before)
            return
        self.since = self._alarms.now
        if state not in (PlantLinkState.IN_STEP, self._noted):
            self.breaks += self._noted is PlantLinkState.IN_STEP
            self._note(state)
        self._alarm(state, cause)

    def _note(self, state: PlantLinkState) -> None:
        self._noted = state
        self._journal.note(self._alarms.now, EventKind.PLANT_LINK, state, self.cause)

    def _alarm(self, state: PlantLinkState, cause: LinkCause) -> None:
        """Raise the alarm of a state; those of the states before return when a scan is taken, or another is raised."""
        alarm = ALARMS.get(state)
        if alarm is None or cause in HARMLESS:
            return
        self._alarms.raised(alarm, cause)
        for other in set(ALARMS.values()) - {alarm}:
            self._alarms.returned(other)
