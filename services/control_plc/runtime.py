"""The control PLC on the bus: client of the plant's rack, server of the optimiser and of operators.

A scan makes one exchange (FC23) with the rack, and only while the link to it is in step (`plant_link.py`); out of step
the rack is read until it is. In lock-step the next scan waits for what it needs: the operator's grant, the optimiser's
plan, and at an updating instant its sequence, as long as an optimiser is there. In real time it waits for the clock
only, which follows that of the rack (`rack_clock.py`).
"""

import asyncio
import contextlib
import logging
import time
from typing import Final

from coldloop import __version__
from coldloop.config import selected
from coldloop.errors import ConfigurationError, LinkError, PeerUnreachableError
from coldloop.limits import InputLimits
from coldloop.logs import dropped
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.model_file import ModelHeader, read_header
from coldloop.pace import Pace
from coldloop.process import TICK_S
from coldloop.registers.audit import EventKind
from coldloop.registers.bank import RegisterBank
from coldloop.registers.common import SessionPace
from coldloop.registers.configuration import publish_configuration
from coldloop.registers.control_plc import CONTROL_MAP, ControlSession, LinkCause, PlantLinkState
from coldloop.registers.plant import PLANT_MAP, Measurement
from coldloop.registers.safety import AlarmKind, LeaseState, LeaseStatus, WatchdogTime
from coldloop.session import TimeMode
from coldloop.telemetry import Telemetry
from control_plc.clients import Clients
from control_plc.plant_link import FROZEN_S, FROZEN_TICKS, PlantLink
from control_plc.program import ControlProgram, OperatingPoint
from control_plc.publication import Publication
from control_plc.rack_clock import PHASE, RackClock
from control_plc.retained_state import Memory, RetainedState
from control_plc.scan_cycle import ScanCycle
from control_plc.settings import SHOWN, ControlSection, ControlSettings

log = logging.getLogger("coldloop.control_plc")

TICKS_PER_SECOND: Final = round(1 / TICK_S)
SEARCH_S: Final = 0.5
"""How long one attempt to reach a lost rack may take."""
LOOK_PAUSE_S: Final = 0.1
"""Between two looks at a rack that is not in step; the first one after a break is made at once."""
ANSWER_TICKS: Final = 8
"""In real time an answer that takes longer is of no use: the rack is looked at anew."""
SHORTEST_PATIENCE_S: Final = 0.1
LONGEST_SLEEP_S: Final = 0.25
"""In real time it is seen so often whether an operator has called meanwhile."""
ADOPT_AFTER_S: Final = 1.0
"""An operator who begins a session writes to one PLC after the other: one that the rack has begun is ours by
`session.autostart` when it has not been asked for here meanwhile."""
KEEP_ALIVE_S: Final = 1.0
"""While paused, the rack is asked something so often."""
EXPIRES_SOON: Final = 1
"""Causes of the alarm CERTIFICATE."""
EXPIRED: Final = 2
UNREADABLE: Final = 3
CERTIFICATES_S: Final = 3600.0
"""Between two looks at the certificates, in real time."""


def make_program(header: ModelHeader, section: ControlSection, limits: InputLimits) -> ControlProgram:
    """Return the program that the configuration asks for, at the operating point of its model file."""
    point = OperatingPoint(header.u0, header.y0, header.short_digest)
    return ControlProgram(limits=limits, point=point, section=section)


class ControlPlc:
    """Connects the program to the registers and to the rack."""

    def __init__(self, settings: ControlSettings) -> None:
        header = read_header(settings.model.file)
        section = settings.control_plc
        self._settings = settings
        self._memory = Memory(section.retain.file, header.short_digest)
        recalled = self._memory.recall()
        self._program = program = make_program(header, section, settings.limits)
        program.journal.continue_from(self._memory.boot, recalled.events if recalled else 0)
        if recalled is not None:
            program.recall(recalled.operator, recalled.alarms, recalled.watchdog, recalled.tick)
        self._kept: RetainedState | None = recalled if recalled is not None and recalled.session else None
        """The session to be gone on with, until the rack has been found in it, or in another one."""
        self._link = PlantLink(program.alarms, program.journal, self._memory.holder)
        self._cycle = ScanCycle(program, self._link, self._adopt)
        self._plant = RegisterClient.at(PLANT_MAP, section.plant)
        configured = Pace(settings.session.mode is TimeMode.REALTIME, settings.session.factor)
        self._pace = self._kept.pace if self._kept else configured
        self._clock = RackClock(self._pace.factor, time.monotonic())
        if self._kept is not None:
            self._clock.synchronise(self._kept.tick + PHASE, time.monotonic())
        self.bank = RegisterBank(CONTROL_MAP, section.word_order)
        publish_configuration(self.bank, selected(settings, SHOWN))
        self.publication = Publication(program, self._link, self.bank, header.short_digest, self._keep)
        self.clients = Clients(program, settings.limits, self.bank, self.publication, lambda: self._pace)
        self._reached = False
        self._looks = 0
        self._lost_lines = 0
        self._awaiting_since: float | None = None
        self._other = (0, 0.0)
        """Another session that the rack was found in while ours ran, and since when (s)."""
        self.bank.put(program.operator)
        self.bank.put(WatchdogTime(program.watchdog.time))
        program.journal.note(program.alarms.now, EventKind.BOOT, int(recalled is not None))
        self._publish()

    def close(self) -> None:
        """Let go of the rack, and keep what is to be kept."""
        self._plant.close()
        self._keep()
        self._memory.close()

    # -- scan cycle ----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Scan until cancelled; a rack that is not there is waited for."""
        while True:
            if self.clients.asked is not None:
                self._start(self.clients.asked)
            elif self.clients.asked_pace is not None:
                self._change_pace(self.clients.asked_pace)
            elif not self._has_session:
                await self._stand_by()
            elif self._pace.paused:
                await self._while_paused()
            elif not self._link.in_step:
                await self._look()
            elif await (self._until_clock() if self._pace.realtime else self._until_granted()):
                await self._scan()

    @property
    def _has_session(self) -> bool:
        """There is a session, or the rack may have one that is to be gone on with."""
        return self.publication.running or self._settings.session.autostart or self._kept is not None

    async def _stand_by(self) -> None:
        """Wait for a session; until the rack has answered once, look for it."""
        if self._reached:
            self.clients.changed.clear()
            await self.clients.changed.wait()
            return
        try:
            await self._plant.connect(SEARCH_S)
        except LinkError as error:
            self._cycle.failed(error)
            self._say_lost(error)
            await self._pause()
        else:
            self._reached = True
            self._link.end()
        self._publish()

    async def _until_clock(self) -> bool:
        """Wait for the scan's time; tell whether it may begin: after a whole tick slept through, the rack is looked at.

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
            program.alarms.happened(AlarmKind.SCAN_OVERRUN)
        if lateness > self._clock.tick_s and program.tick:  # at tick 0 the rack's clock waits for us
            self._link.overslept()
        return self._link.in_step

    @property
    def _is_called(self) -> bool:
        """An operator has asked for another session, or another time base."""
        return self.clients.asked is not None or self.clients.asked_pace is not None

    async def _while_paused(self) -> None:
        """Wait until an operator writes something; the connection to the rack is kept open meanwhile."""
        self.clients.changed.clear()
        try:
            async with asyncio.timeout(KEEP_ALIVE_S):
                await self.clients.changed.wait()
        except TimeoutError:
            try:
                await self._plant.read(Measurement)
            except LinkError as error:
                self._say_lost(error)

    async def _until_granted(self) -> bool:
        """Wait until the next scan in lock-step has what it needs; tell whether it may begin."""
        program = self._program
        if self._is_called:
            return False
        granted = program.tick < self.clients.granted
        awaited = granted and (program.awaiting_plan or program.awaiting_sequence)
        if granted and not awaited:
            self._awaiting_since = None
            return True
        self.clients.changed.clear()
        if awaited:
            await self._until_answered()
        else:
            self._awaiting_since = None
            await self.clients.changed.wait()
        return False

    async def _until_answered(self) -> None:
        """Wait until somebody writes something; an optimiser that is waited for too long is lost."""
        now = time.monotonic()
        since = self._awaiting_since = self._awaiting_since or now
        try:
            async with asyncio.timeout(since + self._settings.control_plc.ladder.optimizer_patience_s - now):
                await self.clients.changed.wait()
        except TimeoutError:
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
                raise PeerUnreachableError(f"{self._plant.peer} has closed the connection")
            answer = await self._plant.exchange(outputs, Measurement, patience_s=self._patience_s)
        except LinkError as error:
            self._cycle.failed(error)
            self._say_lost(error)
            self._publish()
            return
        answered_at = time.monotonic()
        at = (asked_at + answered_at) / 2
        update = self._cycle.answered(answer, self._in_ticks(at))
        if not self._link.in_step:
            self._publish()
            return
        self._looks = 0
        if self._pace.realtime and answer.tick:
            self._clock.observe(answer.tick + answer.age, at, (answered_at - asked_at) / 2)
        if update is not None:
            self.clients.tell(update)
        self._after_scan(latched=update is not None)

    def _after_scan(self, *, latched: bool) -> None:
        """Show what is new, and keep what is to be kept."""
        program, publication = self._program, self.publication
        on_the_second = program.tick % TICKS_PER_SECOND == 0
        if program.track():
            self.bank.put(program.operator)
        if on_the_second:
            self._watch_ourselves()
        program.alarms.pass_by()
        if program.process is not None:
            self.bank.put(program.process)
        if latched or on_the_second:
            publication.status()
        if publication.is_behind or on_the_second:
            publication.safety()
        publication.identity()
        self._keep()

    def _keep(self) -> None:
        """Keep the state of now; of a session that is still to be gone on with, that of before the restart."""
        self._memory.keep(self._program, self._pace, self._kept)

    def _watch_ourselves(self) -> None:
        """Raise the alarms about clock and memory, and note log lines that were lost."""
        if self._pace.realtime:
            skew = self.publication.skew = self._clock.skew()
            self.publication.offset_ms = self._clock.offset * self._clock.tick_s * 1000
            limit = self._settings.control_plc.skew_alarm_ppm
            known = skew.error_ppm < limit / 4
            self._program.alarms.holds(AlarmKind.CLOCK_SKEW, condition=known and abs(skew.ppm) > limit)
        program, lost = self._program, dropped()
        program.alarms.holds(AlarmKind.STATE_NOT_RETAINED, condition=self._memory.failure is not None)
        if lost > self._lost_lines:
            program.journal.note(program.tick, EventKind.LOST, value=lost - self._lost_lines)
            self._lost_lines = lost

    @property
    def _patience_s(self) -> float:
        """How long an answer of the rack may take."""
        longest = self._settings.control_plc.plant.timeout_s
        if not self._pace.realtime:
            return longest
        return min(longest, max(SHORTEST_PATIENCE_S, ANSWER_TICKS * self._clock.tick_s))

    def _in_ticks(self, at: float) -> float | None:
        """Return a moment of real time in ticks; None in lock-step."""
        return at / self._clock.tick_s if self._pace.realtime else None

    async def watch_certificates(self) -> None:
        """Raise the alarm while a certificate has expired, or will soon; look again every hour, until cancelled."""
        section = self._settings.control_plc
        files = [tls for tls in (section.server.tls, section.plant.tls) if tls is not None]
        if not files:
            return
        from coldloop.modbus.tls import certificate_days_left  # noqa: PLC0415 not needed without TLS

        def days_of_those_to_renew() -> list[float]:
            return [days for tls in files if (days := certificate_days_left(tls)) < tls.warn_days]

        while True:
            try:
                days = await asyncio.to_thread(days_of_those_to_renew)  # no scan waits for a disk
            except ConfigurationError as error:  # somebody is renewing them, perhaps; what was read at the start serves
                log.warning("certificates unreadable", extra={"reason": str(error)})
                condition, cause = True, UNREADABLE
            else:
                condition, cause = bool(days), EXPIRED if min(days, default=0.0) < 0.0 else EXPIRES_SOON
            self._program.alarms.holds(AlarmKind.CERTIFICATE, condition=condition, cause=cause)
            self.publication.safety()
            await asyncio.sleep(CERTIFICATES_S)

    # -- out of step ---------------------------------------------------------------------------------------------------

    async def _look(self) -> None:
        """Read what the rack applies; in step with it, go on from there."""
        if self._looks:
            await self._pause()
            if self._is_called:
                return
        self._looks += 1
        try:
            await self._read_back()
        except LinkError as error:
            self._cycle.failed(error)
            self._say_lost(error)
        if not self._link.in_step and self._pace.realtime:
            now = self._clock.tick_at(time.monotonic())
            self._program.alarms.now = max(self._program.tick, now)
            self._program.alarms.pass_by()
        self._publish()

    async def _read_back(self) -> None:
        """Read what the rack applies; in real time an attempt is as short as a scan is urgent.

        Raises:
            LinkError: The rack does not answer, or not in time.
        """
        try:
            async with asyncio.timeout(SEARCH_S if self._pace.realtime else None):
                if self._link.state is PlantLinkState.SEARCHING:
                    await self._plant.connect(SEARCH_S)
                held = self._link.cause is LinkCause.SECOND_MASTER and await self._is_held_by_another()
                asked_at = time.monotonic()
                reading = await self._plant.read(Measurement)
        except TimeoutError:
            raise PeerUnreachableError(f"{self._plant.peer} has not answered within {SEARCH_S:g} s") from None
        self._reached = True
        if not held:
            self._join(reading, (asked_at + time.monotonic()) / 2)

    async def _is_held_by_another(self) -> bool:
        """Tell whether the control PLC that we were refused for still holds the lease of the rack."""
        lease = await self._plant.read(LeaseStatus)
        ours = lease.holder == self._link.holder
        return lease.state == LeaseState.HELD or (lease.state == LeaseState.LINGERING and not ours)

    def _join(self, reading: Measurement, at: float) -> None:
        """Go on from a reading, where that may be done; `at` is when the rack was read, s."""
        self._cycle.answered(reading, self._in_ticks(at))
        if self._link.in_step:
            # at tick 0 the rack's clock waits for the first outputs
            self._clock.synchronise(reading.tick + (reading.age or (0.0 if reading.tick else PHASE)), at)
        elif not self.publication.running and not self._settings.session.autostart:
            self._forget_kept()  # the rack has left the session that was retained
            self._link.end()

    async def _pause(self) -> None:
        """Wait before the next look, unless somebody writes something."""
        self.clients.changed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(min(LOOK_PAUSE_S, max(0.005, self._clock.tick_s))):
                await self.clients.changed.wait()

    def _say_lost(self, error: LinkError) -> None:
        log.warning("plant not in step", extra={"reason": str(error), "tick": self._program.tick})

    # -- sessions ------------------------------------------------------------------------------------------------------

    def _adopt(self, reading: Measurement) -> bool:
        """Go over to the session of the rack, where that is ours to do: after a restart, or by `session.autostart`."""
        kept, program = self._kept, self._program
        if kept is not None and kept.session == reading.session != 0:
            self._kept = None
            program.resume(
                reading.session, reading.tick, reading.u,
                updates=kept.updates, operator=program.operator, playing=kept.sequence,
            )  # fmt: skip
            self._go_on(reading)
            return True
        self._forget_kept()
        if not self._settings.session.autostart or not self._is_ours_to_adopt(reading.session):
            return False
        if reading.tick == 0:
            program.restart(reading.session)
        else:
            program.resume(
                reading.session, reading.tick, reading.u, updates=program.player.updates, operator=program.operator
            )
        self._go_on(reading)
        return True

    def _go_on(self, reading: Measurement) -> None:
        log.warning("session resumed", extra={"session": reading.session, "tick": reading.tick})
        self._begin()

    def _forget_kept(self) -> None:
        """Do without the session that was retained; what an operator has said since the start stays."""
        kept, self._kept = self._kept, None
        if kept is None:
            return
        configured = self._settings.session
        self._pace = Pace(configured.mode is TimeMode.REALTIME, configured.factor)
        if self._program.operator == kept.operator:
            self._program.nobody_drives()
            self.bank.put(self._program.operator)

    def _is_ours_to_adopt(self, session: int) -> bool:
        """Tell whether a session of the rack has not been asked for by an operator, as far as one can tell by now."""
        if not session or not self.publication.running:
            return session > 0
        now = time.monotonic()
        if self._other[0] != session:
            self._other = session, now
        return now - self._other[1] >= ADOPT_AFTER_S

    def _start(self, asked: ControlSession) -> None:
        """Begin the session that an operator has asked for; nothing is written before the rack has been read."""
        self.clients.asked = None
        self._forget_kept()
        self._program.restart(asked.session)
        self._pace = Pace(bool(asked.realtime), asked.factor)
        self._begin()
        self._link.begin()
        self._publish()
        log.info("session started", extra={"session": asked.session, "realtime": bool(asked.realtime)})

    def _change_pace(self, pace: Pace) -> None:
        """Go on by another time base; before the next scan the rack is looked at."""
        self.clients.asked_pace = None
        self._pace = pace
        self._set_clock()
        self._looks = 0
        self._link.repaced()
        self._show_pace()
        self._publish()
        self._memory.keep(self._program, pace)
        log.info("pace changed", extra={"realtime": pace.realtime, "factor": pace.factor, "paused": pace.paused})

    def _set_clock(self) -> None:
        self._clock = RackClock(self._pace.factor, time.monotonic())
        self._link.frozen_ticks = max(FROZEN_TICKS, FROZEN_S / self._clock.tick_s)

    def _show_pace(self) -> None:
        pace, session = self._pace, self._program.session
        self.bank.put(ControlSession(session, int(pace.realtime), pace.factor))
        self.bank.put(SessionPace.shown(session, pace))

    def _begin(self) -> None:
        self._looks = 0
        self._other = (0, 0.0)
        self._set_clock()
        self.publication.begin()
        self.clients.begin()
        self._show_pace()

    def _publish(self) -> None:
        self.publication.status()
        self.publication.safety()
        self.publication.identity()


async def serve(settings: ControlSettings) -> None:
    """Serve and scan until cancelled."""
    plc = ControlPlc(settings)
    identity = DeviceIdentity(product="Coldloop control PLC", revision=__version__)
    server = ModbusServer(
        plc.bank, settings=settings.control_plc.server, on_write=plc.clients.on_write, identity=identity,
        on_departure=plc.clients.on_departure, on_refusal=plc.clients.on_refusal, on_close=plc.clients.on_close,
    )  # fmt: skip
    await server.start()
    log.info("serving", extra={"host": settings.control_plc.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(plc.run(), name="scan cycle")
            tasks.create_task(plc.watch_certificates(), name="certificates")
            telemetry = Telemetry(settings.telemetry, "control_plc", plc.publication.snapshot)
            tasks.create_task(telemetry.run(), name="telemetry")
    finally:
        plc.close()
        await server.close()
