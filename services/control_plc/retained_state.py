"""What the control PLC keeps over a restart."""

import logging
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coldloop.registers.control_plc import Operator
from coldloop.registers.safety import Alarm, AlarmKind
from coldloop.retained import RetainedFile, RetainedStateError
from coldloop.session import Pace
from control_plc.program import ControlProgram

log = logging.getLogger("coldloop.control_plc")

OWNER = "control_plc/1"
"""Who retained states belong to, and the version of what they hold."""

Count = Annotated[int, Field(ge=0, lt=2**32)]


class RetainedState(BaseModel):
    """The session, how far it has got, what operators have said, and the alarms."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    session: Count
    tick: Count
    pace: Pace
    updates: Count
    """Number of the next update."""
    operator: Operator
    alarms: Annotated[list[Alarm], Field(min_length=len(AlarmKind), max_length=len(AlarmKind))]

    @classmethod
    def of(cls, program: ControlProgram, pace: Pace) -> Self:
        """Return the state of a program."""
        return cls.model_construct(
            session=program.session, tick=program.tick, pace=pace, updates=program.player.updates,
            operator=program.operator, alarms=program.alarms.rows,
        )  # fmt: skip

    @classmethod
    def parsed(cls, content: dict[str, object]) -> Self:
        """Return the state that a file holds.

        Raises:
            RetainedStateError: It holds something else.
        """
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise RetainedStateError(f"the retained state is not used: {error.errors()[0]['msg']}") from None


class Memory:
    """Keeps the state in a file, if one is configured; what cannot be trusted or written is told once."""

    def __init__(self, file: Path | None, model_digest: int) -> None:
        self._file = RetainedFile(file, OWNER, model_digest) if file else None

    def recall(self) -> RetainedState | None:
        """Return the state of before, if there is one."""
        if self._file is None:
            return None
        try:
            content = self._file.load()
            return None if content is None else RetainedState.parsed(content)
        except RetainedStateError as error:
            log.warning("retained state refused", extra={"reason": str(error)})
            return None

    def keep(self, program: ControlProgram, pace: Pace) -> None:
        """Keep the state of now."""
        if self._file is None:
            return
        try:
            self._file.save(RetainedState.of(program, pace).model_dump())
        except RetainedStateError as error:
            log.error("the state is not retained", extra={"reason": str(error)})  # noqa: TRY400 one line
