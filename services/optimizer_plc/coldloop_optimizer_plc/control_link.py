"""The state of the optimiser's link to the control PLC. Pure: no sockets, no clock.

SEARCHING ──answers──> INTRODUCING ──ours, our model──> WAITING <───────────────────────┐
    ^                                                     │ update                      │ verdict
    │ no answer, or none that makes sense                 v          answer computed    │
    └───────────── any state                          COMPUTING ──────────────────> DELIVERING
                                                          └── newer update: WAITING
any state ──the lease is held by another──> OTHER_MASTER ──lease granted──> WAITING
any state ──another model there──> WRONG_MODEL ──our model──> WAITING
"""

import math
from collections.abc import Callable
from typing import Final

from coldloop.errors import BUSY, ColdloopError, DamagedAnswerError, ModelFileError, RequestRefusedError
from coldloop.registers.common import EventKind
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import ControlLinkState, ControlLinkStatus
from coldloop.service.journal import Journal

REPEAT_S: Final = 10.0
"""The same reason is logged at most once in this real time."""
MOST_REASONS: Final = 32
"""Different reasons that are remembered for that."""

_S = ControlLinkState
_NEXT: Final = {
    _S.SEARCHING: {_S.INTRODUCING},
    _S.INTRODUCING: {_S.WAITING},
    _S.WAITING: {_S.COMPUTING},
    _S.COMPUTING: {_S.WAITING, _S.DELIVERING},
    _S.DELIVERING: {_S.WAITING},
    _S.OTHER_MASTER: {_S.WAITING},
    _S.WRONG_MODEL: {_S.WAITING},
}
"""States that may follow, besides the three that a failure leads to."""
_UP: Final = {_S.WAITING, _S.COMPUTING, _S.DELIVERING}
_PAUSES_S: Final = {_S.SEARCHING: 0.2, _S.OTHER_MASTER: 1.0, _S.WRONG_MODEL: 1.0}
"""Real time between the beginnings of two attempts after a failure of each kind."""


class ControlLink:
    """State and counters of the link; its changes are events of the journal.

    Args:
        holder: Number that this optimiser has given itself, 1 to 0xFFFFFFFF.
        journal: Takes the events.
        noted: Called after every event.
    """

    def __init__(self, holder: int, journal: Journal, noted: Callable[[], object]) -> None:
        self.state = _S.SEARCHING
        self.holder = holder
        """Number that this optimiser has given itself."""
        self._counts = dict.fromkeys(("breaks", "damaged", "rejected", "interrupted"), 0)
        self._journal = journal
        self._tell = noted
        self._noted = _S.SEARCHING
        self._attempted_at = -math.inf
        self._logged_at: dict[str, float] = {}
        self.tick = 0
        """Tick of the last update, for events."""
        self.was_up = False
        """The control PLC has been found, with our model, since the start."""

    def registers(self) -> ControlLinkStatus:
        """Return what the registers show."""
        return ControlLinkStatus(self.state, self.holder, **self._counts)

    # -- what happens --------------------------------------------------------------------------------------------------

    def attempt(self, now: float) -> None:
        """An attempt to reach the control PLC begins at `now`, s."""
        self._attempted_at = now

    def answered(self) -> None:
        """The control PLC answers, with our register map."""
        if self.state is _S.SEARCHING:
            self._go(_S.INTRODUCING)

    def introduced(self) -> None:
        """The control PLC has our model and has granted us its lease."""
        self.was_up = True
        self._go(_S.WAITING)

    def computes(self) -> None:
        """An update has arrived."""
        self._go(_S.COMPUTING)

    def delivers(self) -> None:
        """The answer to the update is ready."""
        self._go(_S.DELIVERING)

    def acknowledged(self, verdict: Verdict) -> None:
        """The control PLC has judged the sequence."""
        self._go(_S.WAITING, rejected=int(verdict is not Verdict.ACCEPTED))

    def interrupted(self) -> None:
        """The computation was given up for a newer update."""
        self._go(_S.WAITING, interrupted=1)

    def damaged(self) -> None:
        """An answer arrived with a broken seal, or without one."""
        self._set(self.state, damaged=1)

    def failed(self, error: ColdloopError) -> None:
        """An attempt, or the link, has failed."""
        state = _S.SEARCHING
        if isinstance(error, ModelFileError):
            state = _S.WRONG_MODEL
        elif isinstance(error, RequestRefusedError) and error.exception_code == BUSY:
            state = _S.OTHER_MASTER
        self._set(state, breaks=int(self.state in _UP), damaged=int(isinstance(error, DamagedAnswerError)))

    # -- when to try again, and when to say so -------------------------------------------------------------------------

    def pause_s(self, now: float) -> float:
        """Return the real time from `now`, s, until the next attempt may begin."""
        return max(0.0, self._attempted_at + _PAUSES_S.get(self.state, 0.0) - now)

    def is_worth_logging(self, reason: str, now: float) -> bool:
        """Return whether to log at `now`, s: for a new reason, or an old one after `REPEAT_S`."""
        if now - self._logged_at.get(reason, -math.inf) < REPEAT_S:
            return False
        if len(self._logged_at) >= MOST_REASONS:
            self._logged_at.clear()
        self._logged_at[reason] = now
        return True

    # -- transitions ---------------------------------------------------------------------------------------------------

    def _go(self, state: ControlLinkState, **counts: int) -> None:
        if state not in _NEXT[self.state]:
            raise RuntimeError(f"the link does not go from {self.state.name} to {state.name}")
        self._set(state, **counts)

    def _set(self, state: ControlLinkState, **counts: int) -> None:
        """Change the state, add to counters, and note in the journal whether the link is up, or why it is not."""
        self.state = state
        for name, count in counts.items():
            self._counts[name] = (self._counts[name] + count) & 0xFFFFFFFF
        shown = _S.WAITING if state in _UP else state
        if shown not in (self._noted, _S.INTRODUCING):
            self._noted = shown
            self._journal.note(self.tick, EventKind.CONTROL_LINK, shown)
            self._tell()
