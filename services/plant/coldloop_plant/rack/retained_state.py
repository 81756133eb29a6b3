"""State that the rack keeps over a restart: simulation, applied outputs and count of its journal."""

import logging
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from coldloop.process.declaration import LAST_TICK, Process
from coldloop.registers.codec import DomainError, check_record
from coldloop.registers.common import SessionPace
from coldloop.registers.plant import LoadStep, plant_map
from coldloop.safety.retained import RetainedFile, RetainedStateError
from coldloop.session.settings import TimeBase

log = logging.getLogger("coldloop.plant")

OWNER = "plant/4"
"""Who retained states belong to, and the version of what they hold."""

Count = Annotated[int, Field(ge=0, lt=2**32)]


class RetainedPlantState(BaseModel):
    """The state of a rack between two ticks."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    boot: Count
    events: Annotated[int, Field(ge=0, lt=2**31)]
    generation: Annotated[int, Field(ge=1, lt=2**32)]
    holder: Count
    session: Count
    """0: none yet; the other fields are as configured."""
    pace: TimeBase
    watchdog: Annotated[int, Field(ge=0, lt=2**16)]
    """Its time-out, in ticks."""
    times: tuple[Annotated[int, Field(ge=0, le=LAST_TICK)], ...]
    """Ticks of the load's steps."""
    watts: tuple[float, ...]
    seed: Count
    program: dict[str, Any]
    """Argument of `PlantProgram.resume`."""

    @model_validator(mode="after")
    def _possible(self) -> Self:
        tick = self.program.get("tick", 0)
        if not isinstance(tick, int) or not 0 <= tick <= LAST_TICK:
            raise ValueError(f"no session has a tick {tick!r}")
        return self


class PlantStateStore:
    """Keeps the state in a file, if one is configured; what cannot be trusted or written is logged."""

    def __init__(self, file: Path | None, model_digest: int, process: Process) -> None:
        self._file = RetainedFile(file, OWNER, model_digest) if file else None
        self._process = process
        self.active = file is not None
        self.refused = False
        """A previous state exists and is not used."""

    def recall(self) -> RetainedPlantState | None:
        """Return the previous state, if any."""
        if self._file is None:
            return None
        try:
            content = self._file.load()
            return None if content is None else self._possible(RetainedPlantState.model_validate(content))
        except RetainedStateError as error:
            self.refuse(str(error))
        except ValidationError as error:
            self.refuse(error.errors()[0]["msg"])
        except DomainError as error:
            self.refuse(str(error))
        return None

    def _possible(self, state: RetainedPlantState) -> RetainedPlantState:
        """Return a state if registers can have its pace and its load.

        Raises:
            DomainError: They cannot.
        """
        for record in (SessionPace.shown(state.session, state.pace), *map(LoadStep, state.times, state.watts)):
            check_record(record, plant_map(self._process))
        return state

    def refuse(self, reason: str) -> None:
        """Discard the previous state: set its file aside and log the reason."""
        self.refused = True
        if self._file is not None:
            log.warning("retained state refused", extra={"reason": reason, "file": self._file.set_aside()})

    def keep(self, state: RetainedPlantState) -> None:
        """Keep the state of now: it is the memory of a simulation, so every tick counts and no disk is waited for."""
        if self._file is None:
            return
        try:
            self._file.save(state.model_dump(), synced=False)
        except RetainedStateError as error:
            log.error("the state is not retained", extra={"reason": str(error)})  # noqa: TRY400 one line
