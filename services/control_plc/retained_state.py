"""What the control PLC keeps over a restart."""

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coldloop.registers.control_plc import Operator
from coldloop.registers.safety import Alarm, AlarmKind
from coldloop.retained import RetainedStateError
from coldloop.session import Pace
from control_plc.program import ControlProgram

OWNER = "control_plc/1"

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
