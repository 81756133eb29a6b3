"""What the rack keeps over a restart: the simulation, what it applies, and the count of its journal."""

import logging
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from coldloop.pace import Pace
from coldloop.retained import RetainedFile, RetainedStateError

log = logging.getLogger("coldloop.plant")

OWNER = "plant/3"
"""Who retained states belong to, and the version of what they hold."""

Count = Annotated[int, Field(ge=0, lt=2**32)]


class RetainedState(BaseModel):
    """The state of a rack between two ticks."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    boot: Count
    events: Annotated[int, Field(ge=0, lt=2**31)]
    generation: Annotated[int, Field(ge=1, lt=2**32)]
    holder: Count
    session: Count
    """0: there has been none, and what follows is the rack as it is configured."""
    pace: Pace
    watchdog: Annotated[int, Field(ge=0, lt=2**16)]
    """Its time-out, in ticks."""
    times: tuple[int, ...]
    """Ticks of the load's steps."""
    watts: tuple[float, ...]
    seed: Count
    program: dict[str, Any]
    """What `PlantProgram.resume` takes."""


class Memory:
    """Keeps the state in a file, if one is configured; what cannot be trusted or written is logged."""

    def __init__(self, file: Path | None, model_digest: int) -> None:
        self._file = RetainedFile(file, OWNER, model_digest) if file else None
        self.active = file is not None

    def recall(self) -> RetainedState | None:
        """Return the state of before, if there is one."""
        if self._file is None:
            return None
        try:
            content = self._file.load()
            return None if content is None else RetainedState.model_validate(content)
        except RetainedStateError as error:
            refused(str(error))
        except ValidationError as error:
            refused(error.errors()[0]["msg"])
        return None

    def keep(self, state: RetainedState) -> None:
        """Keep the state of now: it is the memory of a simulation, so every tick counts and no disk is waited for."""
        if self._file is None:
            return
        try:
            self._file.save(state.model_dump(), synced=False)
        except RetainedStateError as error:
            log.error("the state is not retained", extra={"reason": str(error)})  # noqa: TRY400 one line


def refused(reason: str) -> None:
    """Log that a retained state is not used."""
    log.warning("retained state refused", extra={"reason": reason})
