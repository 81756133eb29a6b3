"""Publication of the control PLC's state: registers, log and telemetry, made from the program's state."""

import logging
import math
from collections.abc import Callable, Mapping

from coldloop.registers.bank import RegisterBank
from coldloop.registers.common import Identity, ServiceState
from coldloop.registers.control_plc import LadderStatus, PlantLinkStatus, ProcessNow, Status
from coldloop.registers.safety import AlarmState
from coldloop.safety.writers import WriterLease
from coldloop.service.journal import JournalPublication, alarm_word, log_event
from coldloop.session.clock import LatenessRecord
from coldloop_control_plc.plant_link import PlantLink
from coldloop_control_plc.program import ControlProgram
from coldloop_control_plc.rack_clock import Skew
from coldloop_control_plc.sessions import Sessions

log = logging.getLogger("coldloop.control_plc")


class ControlPublication:
    """Shows the program's state in the registers: what changes in each scan when it is read, the rest with its events.

    `keep` is called with new events, so that no number of an event is given out twice, and what an operator has said
    is retained also while no scans are made.
    """

    def __init__(
        self,
        program: ControlProgram,
        sessions: Sessions,
        link: PlantLink,
        bank: RegisterBank,
        model_digest: int,
        keep: Callable[[], None] = lambda: None,
    ) -> None:
        self._program = program
        self._sessions = sessions
        self._link = link
        self._bank = bank
        self._model_digest = model_digest
        self._keep = keep
        self.journal = JournalPublication(program.journal, bank)
        self._told_alarms = -1
        self.overruns = 0
        """Scans that began too late."""
        self.lateness = LatenessRecord()
        """Lateness of all scans of this session in real time."""
        self.skew = Skew(0.0, math.inf)
        """How much faster the rack's clock is than ours, and its phase error."""
        self.offset_ms = 0.0
        self.lease: WriterLease | None = None
        """Lease of the optimiser."""
        bank.keep_fresh(Identity, self._identity)
        bank.keep_fresh(ProcessNow, lambda: program.process)
        bank.keep_fresh(Status, self._status)

    def begin(self) -> None:
        """Reset the counters: a session begins."""
        self.overruns = 0
        self.lateness = LatenessRecord()
        self.skew, self.offset_ms = Skew(0.0, math.inf), 0.0

    def _identity(self) -> Identity:
        program = self._program
        return Identity(
            map_digest=self._bank.map.digest,
            map_version=self._bank.map.version,
            state=ServiceState.RUNNING if self._sessions.running else ServiceState.READY,
            model_digest=self._model_digest,
            session=program.session,
            tick=program.tick,
            heartbeat=program.tick & 0xFFFF,
        )

    def _status(self) -> Status:
        program, lateness = self._program, self.lateness
        player = program.player
        return Status(
            mode=program.mode,
            update=player.update.update if player.update else 0,
            next_update_tick=player.next_update_tick,
            playing=player.playing,
            remaining=program.remaining,
            accepted=player.accepted & 0xFFFFFFFF,
            rejected=player.rejected & 0xFFFFFFFF,
            deadline_misses=player.deadline_misses & 0xFFFFFFFF,
            overruns=self.overruns & 0xFFFFFFFF,
            lateness_max=lateness.maximum_s * 1000,
            lateness_p99=lateness.percentile_s(0.99) * 1000,
        )

    def _ladder(self) -> LadderStatus:
        program = self._program
        return LadderStatus(
            mode=program.mode,
            cause=program.ladder.cause,
            since=program.ladder.since,
            optimizer=int(program.optimizer_present),
            bad_sensors=program.bad_sensors,
            events=program.journal.count,
        )

    @property
    def is_behind(self) -> bool:
        """There are events that have not been shown."""
        return self.journal.is_behind

    def safety(self) -> None:
        """Show ladder, watchdog, links, alarms and events, which agree with each other, and log the events."""
        program = self._program
        if self.lease is not None:
            self.lease.note_end()
        events = self.journal.show()
        for event in events:
            log_event(log, event, self._bank.map.process)
        if events:
            self._keep()
        if program.alarms.changes != self._told_alarms:
            self._told_alarms = program.alarms.changes
            for row, alarm in enumerate(program.alarms.rows):
                self._bank.put(alarm, row)
        for shown in (self._ladder(), program.watchdog.registers(program.tick), self._plant_link()):
            self._bank.put(shown)
        if self.lease is not None:
            self._bank.put(self.lease.registers())

    def _plant_link(self) -> PlantLinkStatus:
        link = self._link
        return PlantLinkStatus(
            state=link.state,
            cause=link.cause,
            since=link.since,
            breaks=link.breaks & 0xFFFFFFFF,
            holder=link.holder,
            generation=link.generation,
            plant_session=link.session,
            plant_tick=link.tick,
            offset=self.offset_ms,
            skew=self.skew.ppm,
            skew_error=self.skew.error_ppm,
        )

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        status, process = self._bank.get(Status), self._bank.get(ProcessNow)
        alarms = {
            alarm_word(kind, self._bank.map.process).replace(" ", "_"): AlarmState(alarm.state).name.lower()
            for kind, alarm in enumerate(self._program.alarms.rows)
            if alarm.state != AlarmState.NORMAL
        }
        return {
            "session": self._program.session,
            "tick": process.tick,
            **status._asdict(),
            "mode": self._program.mode.name.lower(),
            "cause": self._program.ladder.cause.name.lower(),
            "alarms": alarms,
            "load_w": process.load,
            "inputs": dict(zip(self._bank.map.process.input_names, process.u, strict=True)),
            "outputs": dict(zip(self._bank.map.process.output_names, process.y, strict=True)),
        }
