"""The control PLC's link to the rack as a state machine with the states of `registers.control_plc.PlantLinkState`.

One rule decides: *no output is written unless what the rack applies was read twice since the last break: sealed,
finite, of this session, the same both times, and at ticks as far apart as the readings.* Only SYNCHRONISED writes, and
only a reading that `read_back` accepts leads there; every doubt leads out of it. A single wrong answer, about outputs,
session or time, thus moves nothing, even where it is the first after a break. The rack holds its side of the rule: it
takes no outputs that name another generation than the one that was read back. Pure: no sockets, no clock.
"""

import math
from collections.abc import Mapping
from typing import Final

from coldloop.registers import common, plant
from coldloop.registers.control_plc import LinkCause, PlantLinkState, PlantLinkStatus
from coldloop.service.journal import Journal
from coldloop_control_plc.alarms import AlarmPanel

FROZEN_TICKS: Final = 4
"""In real time the rack is frozen when it shows the same tick for so many ticks of our clock, ..."""
FROZEN_S: Final = 0.5
"""... and for so long: a rack that is short of processor time is late, not frozen."""

ALARMS: Final = {
    PlantLinkState.SEARCHING: common.AlarmKind.PLANT_LOST,
    PlantLinkState.JOINING: common.AlarmKind.PLANT_LOST,
    PlantLinkState.REJECTED: common.AlarmKind.OUTPUTS_REJECTED,
    PlantLinkState.OTHER_MASTER: common.AlarmKind.PLANT_OTHER_MASTER,
    PlantLinkState.FROZEN: common.AlarmKind.PLANT_FROZEN,
}
SECOND_MASTER: Final = 2
"""Cause of the alarm SECOND_WRITER."""
HARMLESS: Final = (LinkCause.STARTED, LinkCause.MISSED_SCANS, LinkCause.TIME_JUMP, LinkCause.TIME_BASE)
"""Causes that raise no alarm: what will be read back is expected to be what we applied."""
FAILED_REQUESTS: Final = {
    LinkCause.SECOND_MASTER: PlantLinkState.OTHER_MASTER,
    LinkCause.REFUSED: PlantLinkState.REJECTED,
    LinkCause.DAMAGED: PlantLinkState.JOINING,
    LinkCause.IMPLAUSIBLE: PlantLinkState.JOINING,
}
"""States that a failed request leads to; after others the rack does not answer."""
OUTPUTS_REJECTED: Final = (PlantLinkState.REJECTED, LinkCause.REFUSED)
REFUSED_OUTPUTS: Final[Mapping[int, tuple[PlantLinkState, LinkCause]]] = {
    plant.OutputVerdict.WRONG_SESSION: (PlantLinkState.OTHER_MASTER, LinkCause.WRONG_SESSION),
    plant.OutputVerdict.STALE: (PlantLinkState.REJECTED, LinkCause.STALE),
    plant.OutputVerdict.CHANGED: (PlantLinkState.JOINING, LinkCause.CHANGED),
    plant.OutputVerdict.LIMITED: (PlantLinkState.JOINING, LinkCause.LIMITED),
}


class PlantLink:
    """State, cause and counters of the link, with its alarms; changes of state are noted in the journal.

    The panel of alarms also knows the present tick; `holder` is the number of this control PLC, not 0.
    """

    def __init__(self, alarms: AlarmPanel, journal: Journal, holder: int) -> None:
        self._alarms = alarms
        self._journal = journal
        self.holder = holder
        self.state, self.cause, self.since = PlantLinkState.IDLE, LinkCause.NONE, 0
        self.breaks = 0
        """Times that outputs were no longer taken."""
        self._noted = PlantLinkState.IDLE
        """State in the journal: synchronised once outputs have been accepted, not when they may be written."""
        self.frozen_ticks = float(FROZEN_TICKS)
        """How long the rack's tick may stand, in ticks of our clock."""
        self.generation = 0
        """Generation of the rack's outputs that was read back; 0 is none."""
        self._read: tuple[plant.Measurement, float | None] | None = None
        """The last reading, and when it was made: the next one is to confirm it."""
        self.is_confirmed = False
        """The last reading said what the one before had said."""
        self._known_place: float | None = None
        """Position of the rack, in ticks of the session, when it was last synchronised."""
        self._old_since: float | None = None
        """Since when readings are of a time before that."""
        self.session = 0
        """Session of the rack when it last answered; so the tick."""
        self.tick = 0
        self._moved_at: float | None = None
        self.refused = 0
        """How often the rack has refused outputs, as far as is known."""
        self._has_refused_more = False
        """The last answer said so."""

    @property
    def synchronised(self) -> bool:
        """Whether outputs may be written."""
        return self.state is PlantLinkState.SYNCHRONISED

    @property
    def is_alarmed(self) -> bool:
        """An alarm of the link is active: it says why no outputs are written."""
        return any(self._alarms.rows[alarm].active for alarm in ALARMS.values())

    def registers(self) -> PlantLinkStatus:
        """Return what its registers show, without the clocks."""
        breaks = self.breaks & 0xFFFFFFFF
        return PlantLinkStatus(
            self.state, self.cause, self.since, breaks, self.holder, self.generation, self.session, self.tick
        )

    def begin(self) -> None:
        """Begin a session: read back first. What the rack applied in the one before does not matter."""
        self.generation, self._known_place = 0, None
        self._forget_times()
        self._enter(PlantLinkState.JOINING, LinkCause.STARTED)

    def starting(self) -> None:
        """Note that the rack does not answer yet: both are being powered up."""
        self._enter(PlantLinkState.SEARCHING, LinkCause.STARTED)

    def end(self) -> None:
        """There is no session: nothing is written, and nothing is wrong with the rack."""
        self._enter(PlantLinkState.IDLE, LinkCause.NONE)
        self._return_alarms()

    def unanswered(self, cause: LinkCause) -> None:
        """Note that a request failed: its effect on the rack is unknown."""
        self._enter(FAILED_REQUESTS.get(cause, PlantLinkState.SEARCHING), cause)

    def missed_scans(self) -> None:
        """Note that this program missed scans: the rack's state is unknown."""
        if self.synchronised:
            self._enter(PlantLinkState.JOINING, LinkCause.MISSED_SCANS)

    def repaced(self) -> None:
        """Note that the time base was changed: tick and speed of the rack are determined again."""
        self._forget_times()
        if self.synchronised:
            self._enter(PlantLinkState.JOINING, LinkCause.TIME_BASE)

    def compare(self, reading: plant.Measurement, session: int, now: float | None) -> None:
        """Note whether a reading without a write, its seal intact, confirms the one before.

        In another session than ours the rack may have another time base, and its ticks say nothing. `now` is real time,
        in ticks from any beginning; None in lock-step.
        """
        before, self._read = self._read, (reading, now)
        if before is None:
            self.is_confirmed = False
            return
        earlier, at = before
        same = all(getattr(reading, name) == getattr(earlier, name) for name in ("session", "generation", "u"))
        if now is None or at is None:
            in_time = reading.tick == earlier.tick
        else:
            moved = reading.tick + reading.age - earlier.tick - earlier.age
            waits = reading.tick == earlier.tick == 0  # for the first outputs
            in_time = waits or 0 < moved <= now - at + self.frozen_ticks  # a repeated old answer does not advance
        in_time = in_time and not self._is_old(reading, now)
        self.is_confirmed = same and (in_time or reading.session != session)

    def read_back(self, reading: plant.Measurement, session: int, now: float | None) -> bool:
        """Judge a reading that was compared; return whether outputs may be written from it on."""
        stopped = self._clock_stopped(reading, now)
        self.refused = reading.refused
        if not all(map(math.isfinite, reading.u)):
            self._enter(PlantLinkState.JOINING, LinkCause.IMPLAUSIBLE)
        elif stopped:
            self._enter(PlantLinkState.FROZEN, LinkCause.STOPPED)
        elif not self.is_confirmed:
            return False
        elif reading.session != session or not session:
            self._enter(PlantLinkState.OTHER_MASTER, LinkCause.WRONG_SESSION)
        else:
            if self.generation not in (0, reading.generation):  # another master, or its watchdog, has moved the outputs
                self._alarms.raised(common.AlarmKind.PLANT_LOST, LinkCause.CHANGED)
            self.generation, self._read = reading.generation, None
            self._known_place = reading.tick + reading.age
            return True
        return False

    def addressed(self, outputs: plant.Actuators) -> plant.Actuators:
        """Return outputs as they are sent: from us, to the generation that was read back."""
        return outputs._replace(holder=self.holder, generation=self.generation)

    def joined(self) -> None:
        """The program has resumed from what was read back: outputs may be written."""
        self._enter(PlantLinkState.SYNCHRONISED, self.cause)

    def exchanged(self, sent: plant.Actuators, answer: plant.Measurement, now: float | None) -> bool:
        """Judge the answer to outputs; return whether they are what the rack applies, at their tick.

        In real time the rack's tick may differ by one: it changes between two scans, and a scan may be late.
        """
        stopped = self._clock_stopped(answer, now)
        before, self._has_refused_more = self._has_refused_more, answer.refused != self.refused
        if before and self._has_refused_more:  # two answers show that the rack has refused another master's outputs
            self.refused, self._has_refused_more = answer.refused, False
            self._alarms.pulse(common.AlarmKind.SECOND_WRITER, SECOND_MASTER)
        if answer.verdict != plant.OutputVerdict.ACCEPTED:
            self._enter(*REFUSED_OUTPUTS.get(answer.verdict, OUTPUTS_REJECTED))
        elif answer.session != sent.session:
            self._enter(PlantLinkState.OTHER_MASTER, LinkCause.WRONG_SESSION)
        elif answer.u != sent.u or answer.holder != self.holder or answer.generation != self.generation:
            self._enter(PlantLinkState.JOINING, LinkCause.CHANGED)
        elif stopped:
            self._enter(PlantLinkState.FROZEN, LinkCause.STOPPED)
        elif abs(answer.tick - sent.tick) > (now is not None):
            self._enter(PlantLinkState.JOINING, LinkCause.TIME_JUMP)
        else:
            self._known_place = answer.tick + answer.age
            return True
        return False

    def settled(self) -> None:
        """Note an accepted scan: the fault of the rack is over."""
        if self._noted is not PlantLinkState.SYNCHRONISED:
            self._note(PlantLinkState.SYNCHRONISED)
        self._return_alarms()

    def _forget_times(self) -> None:
        """Forget what was noted in ticks of a time base that may be another now."""
        self._moved_at = self._old_since = self._read = None

    def _is_old(self, reading: plant.Measurement, now: float | None) -> bool:
        """Return whether a reading is of a time before what is known, as from a gateway that is behind.

        A rack that was started again may be back in time: it is believed when it has been seen there for long enough.
        """
        if now is None or self._known_place is None or reading.tick + reading.age > self._known_place:
            self._old_since = None
            return False
        if self._old_since is None:
            self._old_since = now
        return reading.tick > 0 and now - self._old_since < self.frozen_ticks

    def _clock_stopped(self, reading: plant.Measurement, now: float | None) -> bool:
        """Note where the rack is; return whether its clock has stopped. At tick 0 it waits for the first outputs."""
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
        if state not in (PlantLinkState.SYNCHRONISED, self._noted):
            self.breaks += self._noted is PlantLinkState.SYNCHRONISED
            self._note(state)
        self._alarm(state, cause)

    def _return_alarms(self) -> None:
        for alarm in ALARMS.values():
            self._alarms.returned(alarm)

    def _note(self, state: PlantLinkState) -> None:
        self._noted = state
        self._journal.note(self._alarms.now, common.EventKind.PLANT_LINK, state, self.cause)

    def _alarm(self, state: PlantLinkState, cause: LinkCause) -> None:
        """Raise the alarm of a state; those of the states before return when a scan is taken, or another is raised."""
        alarm = ALARMS.get(state)
        if alarm is None or cause in HARMLESS:
            return
        self._alarms.raised(alarm, cause)
        for other in set(ALARMS.values()) - {alarm}:
            self._alarms.returned(other)
