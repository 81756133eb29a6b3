"""The control PLC on the bus: client of the plant's rack, server of the optimiser and of operators.

A scan makes one exchange (FC23) with the rack, and only while the link is synchronised (`plant_link.py`); otherwise
the rack is read until it is. In lock-step the next scan waits for what it needs: the operator's grant, the optimiser's
plan, and at an updating instant its sequence, while an optimiser is connected. In real time it waits for the clock
only, which follows that of the rack (`rack.py`).
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Sequence
from typing import Final

from coldloop import __version__, config, errors
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.modbus.settings import TlsSettings
from coldloop.process import declaration, model_file
from coldloop.registers import bank, common, control_plc, maps_of, plant
from coldloop.service import monitoring, start
from coldloop.session import TimeBase
from coldloop_control_plc import clients, plant_link, rack, sessions
from coldloop_control_plc.program import make_program
from coldloop_control_plc.settings import SHOWN, ControlSettings

log = logging.getLogger("coldloop.control_plc")

LONGEST_SLEEP_S: Final = 0.25
"""In real time it is seen so often whether an operator has called meanwhile."""
REPACED_S: Final = 0.5
"""Between two changes of the time base in real time: each reads the rack before outputs are written again."""
LOOK_S: Final = 0.25
"""Real time between two looks at the scans."""
EXPIRES_SOON: Final = 1
"""Causes of the alarm CERTIFICATE."""
EXPIRED: Final = 2
UNREADABLE: Final = 3
CERTIFICATES_S: Final = 3600.0
"""Between two looks at the certificates, in real time."""


class ControlPlc:
    """Connects the program to the registers and to the rack."""

    def __init__(self, settings: ControlSettings) -> None:
        header = model_file.read_header(settings.model.file)
        process, maps = settings.process, maps_of(settings.process)
        section = settings.control_plc
        self._settings = settings
        self._store = sessions.ControlStateStore(section.retain.file, header.short_digest, process)
        recalled = self._store.recall()
        self._program = program = make_program(header, section, settings.limits)
        program.journal.continue_from(self._store.boot, recalled.events if recalled else 0)
        if recalled is not None:
            program.recall(recalled.operator, recalled.alarms, recalled.watchdog, recalled.tick)
        self.sessions = sessions.Sessions(program, settings.session, recalled)
        self._link = plant_link.PlantLink(program.alarms, program.journal, self._store.holder)
        self._cycle = rack.ScanCycle(program, self._link, self._adopt)
        self._plant = RegisterClient.at(maps.plant, section.plant)
        self._clock = rack.RackClock(self.sessions.pace.factor, time.monotonic(), process.tick_s)
        if self.sessions.kept is not None:
            self._clock.synchronise(self.sessions.kept.tick + rack.PHASE, time.monotonic())
        self._finder = rack.RackFinder(self._plant, self._link, self._cycle, self._clock, power_up_s=section.power_up_s)
        self.bank = bank.RegisterBank(maps.control_plc, section.word_order)
        common.publish_configuration(self.bank, config.selected(settings, SHOWN))
        self.publication = clients.ControlPublication(program, self.sessions, self._link, self.bank, self._keep)
        self.clients = clients.Clients(program, settings.limits, self.publication, self.sessions)
        self._looks = 0
        """Looks without a scan between them."""
        self._ticks_per_second = max(1, round(1 / process.tick_s))
        self._lost_lines = 0
        self._awaiting_since: float | None = None
        self._repaced = -REPACED_S
        """Time of the last change of the time base, s."""
        self.bank.put(program.operator)
        self.bank.put(common.WatchdogTime(program.watchdog.time))
        program.journal.note(
            program.alarms.now, common.EventKind.BOOT, int(recalled is not None), int(self._store.refused)
        )
        if self.sessions.kept is not None:
            self._link.starting()  # other clients must not take this for a PLC without a session
        if self._store.refused:
            program.alarms.raised(common.AlarmKind.STATE_NOT_RETAINED, 1)  # cause: there was one that is not used
        self.publication.safety()

    def close(self) -> None:
        """Disconnect from the rack, and save the retained state."""
        self._plant.close()
        self._keep()
        self._store.close()

    async def run(self) -> None:
        """Scan until cancelled; a rack that is not there is waited for."""
        while True:
            if self.clients.asked is not None:
                self._start(self.clients.asked)
            elif self.clients.pending_time_base is not None and self._may_change_pace:
                self._change_pace(self.clients.pending_time_base)
            elif not self.sessions.expected:
                await self._stand_by()
            elif self.sessions.pace.paused and self.sessions.kept is None:
                await self._while_paused()
            elif not self._link.synchronised:
                await self._look()
            elif await (self._until_clock() if self.sessions.pace.realtime else self._until_granted()):
                await self._scan()

    async def _stand_by(self) -> None:
        """Wait for a session; until the rack has answered once, look for it."""
        if self._finder.reached:
            self.clients.changed.clear()
            await self.clients.changed.wait()
            return
        if await self._finder.reach():
            self._link.end()
        else:
            await self._finder.pause(self.clients.changed)
        self.publication.safety()

    async def _until_clock(self) -> bool:
        """Wait for the scan's time; return whether it may begin: after a missed tick, the rack is read first.

        It always yields, however late it is.
        """
        program, due = self._program, self._clock.due(self._program.tick)
        while (left := due - time.monotonic()) > LONGEST_SLEEP_S:
            await asyncio.sleep(LONGEST_SLEEP_S)
            if self._is_called:
                return False
        await asyncio.sleep(max(0.0, left))
        if self._is_called:
            return False
        lateness = max(0.0, time.monotonic() - due)
        self.publication.lateness.add(lateness)
        if lateness * 1000 > self._settings.control_plc.scan_tolerance_ms:
            self.publication.overruns += 1
            program.alarms.pulse(common.AlarmKind.SCAN_OVERRUN)
        if lateness > self._clock.tick_s and program.tick:  # at tick 0 the rack's clock waits for us
            self._link.missed_scans()
        return self._link.synchronised

    @property
    def _is_called(self) -> bool:
        """An operator has requested another session, or another time base."""
        changes = self.clients.pending_time_base is not None and self._may_change_pace
        return self.clients.asked is not None or changes

    @property
    def _may_change_pace(self) -> bool:
        """Whether outputs were written since the last change, so that many in a row do not starve the rack's watchdog.

        In lock-step, and while paused, the watchdog does not run.
        """
        pace = self.sessions.pace
        return not pace.realtime or pace.paused or time.monotonic() >= self._repaced + REPACED_S

    async def _while_paused(self) -> None:
        """Wait until an operator writes something; the connection to the rack is kept open meanwhile."""
        self.clients.changed.clear()
        try:
            async with asyncio.timeout(1.0):  # s, then the rack is asked something
                await self.clients.changed.wait()
        except TimeoutError:
            with contextlib.suppress(errors.LinkError):  # the rack is read when time resumes
                await self._plant.read(plant.Measurement)

    async def _until_granted(self) -> bool:
        """Wait until the next scan in lock-step has what it needs; return whether it may begin."""
        program = self._program
        if self._is_called:
            return False
        granted = program.tick < self.clients.granted
        if granted and (program.awaiting_plan or program.awaiting_sequence):
            self.clients.changed.clear()
            await self._until_answered()
            return False
        self._awaiting_since = None
        if not granted:
            self.clients.changed.clear()
            await self.clients.changed.wait()
        return granted

    async def _until_answered(self) -> None:
        """Wait for a client's write; an optimiser that keeps us waiting too long is lost."""
        now = time.monotonic()
        since = self._awaiting_since = self._awaiting_since or now
        try:
            async with asyncio.timeout(since + self._settings.control_plc.ladder.optimizer_patience_s - now):
                await self.clients.changed.wait()
        except TimeoutError:
            if not self.clients.changed.is_set():  # else it is this process that was late, and the answer is there
                self._program.optimizer_lost()
                self._awaiting_since = None

    async def _scan(self) -> None:
        program = self._program
        if self.clients.optimizer_waits:
            program.optimizer_seen()
        outputs = self._cycle.begin()
        if outputs is None:
            return
        asked_at = time.monotonic()
        try:
            if not self._plant.connected:  # a new connection is a break: the rack is read before it is written to
                raise errors.PeerUnreachableError(f"{self._plant.peer} has closed the connection")
            answer = await self._plant.exchange(outputs, plant.Measurement, patience_s=self._patience_s)
        except errors.LinkError as error:
            self._finder.failed(error)
            self.publication.safety()
            return
        answered_at = time.monotonic()
        at = (asked_at + answered_at) / 2
        update = self._cycle.answered(answer, at / self._clock.tick_s if self.sessions.pace.realtime else None)
        if not self._link.synchronised:
            self.publication.safety()
            return
        self._finder.read_soon()
        self._looks = 0
        if self.sessions.pace.realtime and answer.tick:
            self._clock.observe(answer.tick + answer.age, at, (answered_at - asked_at) / 2)
        if update is not None:
            self.clients.tell(update)
        self._after_scan()

    def _after_scan(self) -> None:
        """Publish what has changed, and save the retained state."""
        program, publication = self._program, self.publication
        on_the_second = program.tick % self._ticks_per_second == 0
        if program.track():
            self.bank.put(program.operator)
        if on_the_second:
            self._watch_ourselves()
        program.alarms.pass_by()
        if publication.journal.is_behind or on_the_second:
            publication.safety()
        self._keep()

    def _keep(self) -> None:
        """Save the present state; of a session still to be resumed, or to begin, what is known of it."""
        if self.clients.asked is not None:
            self._store.keep_requested(self._program, self.clients.asked)
        else:
            self._store.keep(self._program, self.sessions.pace, self.sessions.kept)

    def _watch_ourselves(self) -> None:
        """Raise the alarms about clock and memory, and note log lines that were lost."""
        if self.sessions.pace.realtime:
            skew = self.publication.skew = self._clock.skew.estimate()
            self.publication.offset_ms = self._clock.offset * self._clock.tick_s * 1000
            limit = self._settings.control_plc.skew_alarm_ppm
            known = skew.error_ppm < limit / 4
            self._program.alarms.report(common.AlarmKind.CLOCK_SKEW, condition=known and abs(skew.ppm) > limit)
        program, lost = self._program, start.dropped()
        program.alarms.report(common.AlarmKind.STATE_NOT_RETAINED, condition=self._store.failure is not None)
        if lost > self._lost_lines:
            program.journal.note(program.tick, common.EventKind.LOST, value=lost - self._lost_lines)
            self._lost_lines = lost

    async def watch_scans(self) -> None:
        """Raise an alarm while no scans are made, until cancelled: by an independent clock."""
        while True:
            await asyncio.sleep(LOOK_S)
            pace, alarms = self.sessions.pace, self._program.alarms
            scans = self.sessions.running and pace.realtime and not pace.paused
            self._looks = self._looks + 1 if scans else 1
            # 8 looks, or where the factor is low 8 scans; a process that had no processor time has not looked either
            missing = self._looks > max(8, 8 * self._clock.tick_s / LOOK_S)
            stopped = missing and not self._link.is_alarmed
            if stopped is not bool(alarms.rows[common.AlarmKind.SCANS_STOPPED].active):
                alarms.report(common.AlarmKind.SCANS_STOPPED, condition=stopped)
                self.publication.safety()

    async def watch_certificates(self) -> None:
        """Raise an alarm while a certificate of ours has expired, or will soon: look every hour, until cancelled."""
        section, alarms, noted = self._settings.control_plc, self._program.alarms, 0
        certificates = [tls for tls in (section.server.tls, section.plant.tls) if tls is not None]
        while certificates:
            try:
                days = await asyncio.to_thread(_days_of_those_to_renew, certificates)  # no scan waits for a disk
            except errors.ConfigurationError as error:  # they may be being renewed: keep what was read at the start
                log.warning("certificates unreadable", extra={"reason": str(error)})
                alarms.raised(common.AlarmKind.CERTIFICATE, UNREADABLE)
            else:
                least = min(days, default=0.0)
                cause = (EXPIRED if least < 0.0 else EXPIRES_SOON) if days else 0
                alarms.report(common.AlarmKind.CERTIFICATE, condition=bool(days), cause=cause)
                if cause and cause != noted:
                    self._program.journal.note(alarms.now, common.EventKind.CERTIFICATE, cause, value=least)
                noted = cause
            self.publication.safety()
            await asyncio.sleep(CERTIFICATES_S)

    @property
    def _patience_s(self) -> float:
        """How long an answer of the rack may take."""
        longest = self._settings.control_plc.plant.timeout_s
        if not self.sessions.pace.realtime:
            return longest
        return min(longest, max(0.1, 8 * self._clock.tick_s))  # a later answer is stale: the rack is read again

    async def _look(self) -> None:
        """Read what the rack applies; once synchronised, resume from there."""
        realtime = self.sessions.pace.realtime
        answered = await self._finder.look(self.clients.changed, self._patience_s if realtime else None)
        if not self._link.synchronised:
            if answered and self._link.is_confirmed and not self.sessions.rack_answered():
                self.bank.put(self._program.operator)
                self._link.end()
            if realtime:
                now = self._clock.tick_at(time.monotonic())
                self._program.alarms.now = min(max(self._program.tick, now), declaration.LAST_TICK)
                self._program.alarms.pass_by()
        self.publication.safety()

    def _adopt(self, reading: plant.Measurement) -> bool:
        """Go over to the session of the rack, where that is ours to do."""
        adopted = self.sessions.adopt(reading)
        self.bank.put(self._program.operator)
        if adopted:
            self._begin()
        return adopted

    def _start(self, asked: control_plc.ControlSession) -> None:
        """Begin the session requested by an operator; nothing is written before the rack has been read."""
        self.clients.asked = None
        self.sessions.start(asked)
        self._begin()
        self._link.begin()
        self.publication.safety()

    def _change_pace(self, pace: TimeBase) -> None:
        """Switch to another time base; the rack is read before the next scan."""
        self.clients.pending_time_base = None
        self.sessions.pace, self._repaced = pace, time.monotonic()
        self._set_clock()
        self._link.repaced()
        self._show_pace()
        self.publication.safety()
        self._keep()
        log.info("pace changed", extra={"realtime": pace.realtime, "factor": pace.factor, "paused": pace.paused})

    def _begin(self) -> None:
        """Begin the session that the program has been put into."""
        self._set_clock()
        self._looks = 0
        self.publication.begin()
        self.clients.begin()
        self._show_pace()

    def _set_clock(self) -> None:
        self._clock.begin(self.sessions.pace.factor, time.monotonic())
        self._finder.read_soon()
        self._cycle.begin_time()
        self._link.frozen_ticks = max(plant_link.FROZEN_TICKS, plant_link.FROZEN_S / self._clock.tick_s)

    def _show_pace(self) -> None:
        pace, session = self.sessions.pace, self._program.session
        self.bank.put(control_plc.ControlSession(session, int(pace.realtime), pace.factor))
        self.bank.put(common.SessionPace.shown(session, pace))


def _days_of_those_to_renew(certificates: Sequence[TlsSettings]) -> list[float]:
    from coldloop.modbus.tls import first_expiry  # noqa: PLC0415 not needed without TLS

    return [days for tls in certificates if (days := first_expiry(tls).days_left()) < tls.warn_days]


async def serve(settings: ControlSettings) -> None:
    """Serve and scan until cancelled."""
    plc = ControlPlc(settings)
    identity = DeviceIdentity(product="Coldloop control PLC", revision=__version__)
    server = ModbusServer(
        plc.bank, settings=settings.control_plc.server, on_write=plc.clients.on_write, identity=identity,
        on_departure=plc.clients.on_departure, on_refusal=plc.clients.on_refusal, on_close=plc.clients.on_close,
    )  # fmt: skip
    await server.start()
    log.info(start.SERVING, extra={"host": settings.control_plc.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(monitoring.MetricsServer(settings.control_plc.metrics, plc.bank).run(), name="metrics")
            tasks.create_task(plc.run(), name="scan cycle")
            tasks.create_task(plc.watch_scans(), name="scan watch")
            tasks.create_task(plc.watch_certificates(), name="certificates")
            telemetry = monitoring.Telemetry(settings.telemetry, "control_plc", plc.publication.snapshot)
            tasks.create_task(telemetry.run(), name="telemetry")
    finally:
        plc.close()
        await server.close()
