"""Session and time base of the control PLC.

It is the one requested by an operator, the one retained over a restart, or with `session.autostart` that of the rack.
"""

import logging
import time
from typing import Final

from coldloop.registers.control_plc import ControlSession
from coldloop.registers.plant import Measurement
from coldloop.session import SessionSettings, TimeBase, TimeMode
from coldloop_control_plc.program import ControlProgram
from coldloop_control_plc.retained_state import RetainedControlState

log = logging.getLogger("coldloop.control_plc")

ADOPT_AFTER_S: Final = 1.0
"""An operator who begins a session writes to one PLC after the other: one that the rack has begun is ours by
`session.autostart` when it has not been asked for here meanwhile."""

SEEN_FOR_S: Final = 10.0
"""A session in which the rack has not been found for so long counts as found for the first time."""


class Sessions:
    """Puts the program into sessions.

    Args:
        program: What is to run in them.
        configured: Time base, and whether sessions of the rack are adopted.
        recalled: State of before a restart.
    """

    def __init__(
        self, program: ControlProgram, configured: SessionSettings, recalled: RetainedControlState | None
    ) -> None:
        self._program = program
        self._configured = configured
        self.kept = recalled if recalled is not None and recalled.session else None
        """The session to be resumed, until the rack has been found in it, or in another one."""
        self.pace = self.kept.pace if self.kept else self._configured_pace
        """Time base of the present session."""
        self.running = False
        """A session is under way."""
        self._other = (0, 0.0, 0.0)
        """Another session that the rack was found in while ours ran, since when, and when it was seen there last (s)"""

    @property
    def _configured_pace(self) -> TimeBase:
        return TimeBase(self._configured.mode is TimeMode.REALTIME, self._configured.factor)

    @property
    def expected(self) -> bool:
        """There is a session, or one to be resumed if the rack is in it."""
        return self.running or self._configured.autostart or self.kept is not None

    def start(self, asked: ControlSession) -> None:
        """Begin the session requested by an operator."""
        self.forget_kept()
        self._program.restart(asked.session)
        self.pace = TimeBase(bool(asked.realtime), asked.factor)
        self._begin()
        log.info("session started", extra={"session": asked.session, "realtime": bool(asked.realtime)})

    def adopt(self, reading: Measurement) -> bool:
        """Go over to the session of the rack, where that is ours to do; return whether it was."""
        program, kept = self._program, self.kept
        if kept is not None and kept.session == reading.session != 0:
            self.kept = None
            program.resume(
                reading.session, reading.tick, reading.u,
                updates=kept.updates, operator=program.operator, playing=kept.sequence, cool_down=kept.cool_down,
            )  # fmt: skip
        else:
            self.forget_kept()
            if not self._configured.autostart or not self._is_ours_to_adopt(reading.session):
                return False
            if reading.tick == 0:
                program.restart(reading.session)
            else:
                updates = program.player.updates
                program.resume(reading.session, reading.tick, reading.u, updates=updates, operator=program.operator)
        self._begin()
        log.warning("session resumed", extra={"session": reading.session, "tick": reading.tick})
        return True

    def rack_answered(self) -> bool:
        """Note that the rack is in no session of ours; return whether to keep looking for one."""
        if not self.running and not self._configured.autostart:
            self.forget_kept()  # the rack has left the session that was retained
        return self.expected

    def forget_kept(self) -> None:
        """Do without the session that was retained; what an operator has said since the start stays."""
        kept, self.kept = self.kept, None
        if kept is None:
            return
        self.pace = self._configured_pace
        if self._program.operator == kept.operator:
            self._program.reset_operating_mode()

    def _is_ours_to_adopt(self, session: int) -> bool:
        """Return whether a session of the rack was not requested by an operator, as far as is known now."""
        if not session or not self.running:
            return session > 0
        now = time.monotonic()
        seen_in, since, last = self._other
        if seen_in != session or now - last > SEEN_FOR_S:
            since = now
        self._other = session, since, now
        return now - since >= ADOPT_AFTER_S

    def _begin(self) -> None:
        self._other = (0, 0.0, 0.0)
        self.running = True
