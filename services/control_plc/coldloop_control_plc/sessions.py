"""Session and time base of the control PLC.

It is the one requested by an operator, the one retained over a restart, or with `session.autostart` that of the rack.
The state of the control PLC is retained over a restart in a file.
"""

import base64
import logging
import secrets
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import Field, ValidationError, model_validator

from coldloop.process.declaration import LAST_NUMBER, LAST_TICK, Process
from coldloop.process.settings import ProcessSettings, settings_of
from coldloop.registers import codec, common, control_plc, plant
from coldloop.safety import retained, writers
from coldloop.session import SessionSettings, TimeBase, TimeMode
from coldloop_control_plc.program import ControlProgram

log = logging.getLogger("coldloop.control_plc")

OWNER: Final = "control_plc/6"
"""Who retained states belong to, and the version of what they hold."""
ON_THE_DISK_S: Final = 0.25
"""How long the answer to the request of a session waits for the disk."""
OF_THE_SESSION: Final = ("session", "tick", "pace", "updates", "playing", "cool_down")
"""Keys of the retained state that belong to a session."""

Count = Annotated[int, Field(ge=0, lt=2**32)]


def _row(process: Process) -> struct.Struct:
    return struct.Struct(f">{len(process.inputs)}f")


class RetainedControlState(ProcessSettings):
    """The session, how far it has got, what is being played, what operators have said, the alarms, and who we are."""

    boot: Annotated[int, Field(ge=1, lt=2**16)]
    """Number of the start that wrote it."""
    holder: Annotated[int, Field(ge=1, lt=2**32)]
    """Number by which the rack knows this control PLC."""
    events: Annotated[int, Field(ge=0, lt=2**31)]
    """Number of the last event."""
    session: Count
    tick: Annotated[int, Field(ge=0, le=LAST_TICK)]
    pace: TimeBase
    updates: Annotated[int, Field(ge=0, le=LAST_NUMBER)]
    """Number of the next update."""
    playing: tuple[control_plc.SequenceHeader, str] | None
    """Header and rows (base64 of single precision, high byte first) of the sequence being played."""
    cool_down: control_plc.CoolDownStep
    operator: control_plc.Operator
    watchdog: Annotated[int, Field(ge=0, lt=2**16)]
    """Time-out of the optimiser's watchdog, in ticks."""
    alarms: list[common.Alarm]

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if len(self.alarms) != len(common.alarms_of(self.process)):
            raise ValueError(f"{len(self.alarms)} alarms of {len(common.alarms_of(self.process))}")
        registers = control_plc.control_map(self.process)
        for record in (common.SessionPace.shown(self.session, self.pace), self.operator, *self.alarms):
            codec.check_record(record, registers)
        if self.playing is not None:
            header, rows = self.playing
            codec.check_record(header, registers)
            if len(rows) > 2 * control_plc.SEQUENCE_ROWS * _row(self.process).size:
                raise ValueError("a sequence longer than the longest")
        return self

    @classmethod
    def parsed(cls, content: Mapping[str, object], process: Process) -> Self:
        """Return the state of a control PLC of this process that a file holds.

        Raises:
            RetainedStateError: It holds something else.
        """
        try:
            with settings_of(process):
                return cls.model_validate(content)
        except ValidationError as error:
            raise retained.RetainedStateError(f"the retained state is not used: {error.errors()[0]['msg']}") from None

    @property
    def sequence(self) -> writers.InputSequence | None:
        """The sequence being played, where it is whole."""
        if self.playing is None:
            return None
        header, text = self.playing
        try:
            rows = list(_row(self.process).iter_unpack(base64.b64decode(text)))
        except (ValueError, struct.error):
            return None
        return writers.InputSequence(header, rows) if writers.checksum(header, rows) == header.crc else None


class ControlStateStore:
    """Keeps the state in a file, if one is configured; what cannot be trusted or written is logged once.

    Writing is done by a thread: no scan of a session under way waits for a disk, only the request of another session.
    """

    def __init__(self, file: Path | None, model_digest: int, process: Process) -> None:
        self._process, self._row = process, _row(process)
        self._file = retained.RetainedFile(file, OWNER, model_digest) if file else None
        self._writer = retained.RetainedStateWriter(self._file) if self._file else None
        self._packed: tuple[writers.InputSequence, tuple[control_plc.SequenceHeader, str]] | None = None
        self.refused = False
        """A previous state exists and is not used."""
        self.boot = 1
        self.holder = secrets.randbelow(2**32 - 1) + 1

    def recall(self) -> RetainedControlState | None:
        """Return the previous state, if any; boot and holder continue from it."""
        if self._file is None:
            return None
        try:
            content = self._file.load()
            state = None if content is None else RetainedControlState.parsed(content, self._process)
        except retained.RetainedStateError as error:
            self.refused = True
            log.warning("retained state refused", extra={"reason": str(error), "file": self._file.set_aside()})
            return None
        if state is not None:
            self.boot, self.holder = state.boot % 0xFFFF + 1, state.holder
        return state

    @property
    def failure(self) -> str | None:
        """Why the state cannot be written at present."""
        return self._writer.failed if self._writer else None

    def keep(self, program: ControlProgram, pace: TimeBase, pending: RetainedControlState | None = None) -> None:
        """Keep the state of now; of a `pending` session, which is still to be resumed, what was retained of it."""
        if self._writer is None:
            return
        content = self.content(program, pace)
        if pending is not None:
            content |= {name: getattr(pending, name) for name in OF_THE_SESSION}
        self._writer.keep(content)

    def keep_requested(self, program: ControlProgram, asked: control_plc.ControlSession) -> None:
        """Keep the beginning of a session that is requested and has not begun, and wait until it is on the disk.

        A control PLC that is killed at once looks for the rack in it, as the operator's request was answered.
        """
        if self._writer is None:
            return
        pace = TimeBase(bool(asked.realtime), asked.factor)
        self._writer.keep(self.content(program, pace) | {
            "session": asked.session, "tick": 0, "updates": 0, "playing": None,
            "cool_down": control_plc.CoolDownStep.FINISHED, "operator": program.configured_operator,
        })  # fmt: skip
        self._writer.flush(ON_THE_DISK_S)

    def content(self, program: ControlProgram, pace: TimeBase) -> dict[str, Any]:
        """Return the state of a program, as a file holds it; nothing in it changes later."""
        return {
            "boot": self.boot, "holder": self.holder, "events": program.journal.count, "session": program.session,
            "tick": program.tick, "pace": pace, "updates": program.player.updates,
            "playing": self._playing(program.player.sequence), "cool_down": program.cool_down,
            "operator": program.operator, "watchdog": program.watchdog.time,
            "alarms": tuple(program.alarms.rows),
        }  # fmt: skip

    def _playing(self, sequence: writers.InputSequence | None) -> tuple[control_plc.SequenceHeader, str] | None:
        if sequence is None:
            return None
        if self._packed is None or self._packed[0] is not sequence:
            rows = b"".join(self._row.pack(*row) for row in sequence.rows)
            self._packed = sequence, (sequence.header, base64.b64encode(rows).decode())
        return self._packed[1]

    def close(self) -> None:
        """Let the last state be written."""
        if self._writer is not None:
            self._writer.close()


ADOPT_AFTER_S: Final = 1.0
"""An operator who begins a session writes to one PLC after the other: one that the rack has begun is ours by
`session.autostart` when it has not been asked for here meanwhile."""

SEEN_FOR_S: Final = 10.0
"""A session in which the rack has not been found for so long counts as found for the first time."""


class Sessions:
    """Puts the program into sessions, of the configured time base; `recalled` is the state of before a restart."""

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

    def start(self, asked: control_plc.ControlSession) -> None:
        """Begin the session requested by an operator."""
        self.forget_kept()
        self._program.restart(asked.session)
        self.pace = TimeBase(bool(asked.realtime), asked.factor)
        self._begin()
        log.info("session started", extra={"session": asked.session, "realtime": bool(asked.realtime)})

    def adopt(self, reading: plant.Measurement) -> bool:
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
