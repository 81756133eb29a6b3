"""The optimiser's link to the control PLC: its state, and the requests, repeated when lost or damaged on the way.

SEARCHING ──answers──> INTRODUCING ──ours, our model──> WAITING <───────────────────────┐
    ^                                                     │ update                      │ verdict
    │ no answer, or none that makes sense                 v          answer computed    │
    └───────────── any state                          COMPUTING ──────────────────> DELIVERING
                                                          └── newer update: WAITING
any state ──the lease is held by another──> OTHER_MASTER ──lease granted──> WAITING
any state ──another model there──> WRONG_MODEL ──our model──> WAITING
"""

import math
from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

from coldloop import errors
from coldloop.errors import BUSY, DamagedAnswerError, ModelFileError, RequestRefusedError
from coldloop.modbus import client, requests
from coldloop.modbus.settings import Endpoint
from coldloop.registers import common, declaration, optimizer_plc
from coldloop.registers import control_plc as registers
from coldloop.safety.writers import InputSequence
from coldloop.service.journal import Journal
from coldloop.session import TimeBase

T = TypeVar("T")

REPEAT_S: Final = 10.0  # the same reason is logged at most once in this real time
MOST_REASONS: Final = 32  # different reasons that are remembered for that
ATTEMPTS: Final = 3
"""Attempts of a request whose data arrive damaged: on the way there (exception 03, bad CRC), or back."""
ILLEGAL_VALUE: Final = 3
DAMAGED_THERE: Final = (registers.Verdict.BAD_CRC, registers.Verdict.WRONG_LENGTH)
"""Verdicts on a sequence that is not as it was sent; its number may not be either."""
LONGEST_WAIT_S: Final = 1.0
"""The control PLC answers a request that waits for an update after this real time at the latest."""

_S = optimizer_plc.ControlLinkState
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
    """State and counters of the link; its changes are events of the journal, and `noted` is called after each."""

    def __init__(self, holder: int, journal: Journal, noted: Callable[[], object]) -> None:
        self.state = _S.SEARCHING
        self.holder = holder
        """Number that this optimiser has given itself, 1 to 0xFFFFFFFF."""
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

    def registers(self) -> optimizer_plc.ControlLinkStatus:
        """Return what the registers show."""
        return optimizer_plc.ControlLinkStatus(self.state, self.holder, **self._counts)

    def attempt(self, now: float) -> None:
        """An attempt to reach the control PLC begins at `now`, s."""
        self._attempted_at = now

    def answered(self) -> None:
        """The control PLC answers, with our register map."""
        if self.state is _S.SEARCHING:
            self.go(_S.INTRODUCING)

    def introduced(self) -> None:
        """The control PLC has our model and has granted us its lease."""
        self.was_up = True
        self.go(_S.WAITING)

    def damaged(self) -> None:
        """An answer arrived with a broken seal, or without one."""
        self._set(self.state, damaged=1)

    def failed(self, error: errors.ColdloopError) -> None:
        """An attempt, or the link, has failed."""
        state = _S.SEARCHING
        if isinstance(error, ModelFileError):
            state = _S.WRONG_MODEL
        elif isinstance(error, RequestRefusedError) and error.exception_code == BUSY:
            state = _S.OTHER_MASTER
        self._set(state, breaks=int(self.state in _UP), damaged=int(isinstance(error, DamagedAnswerError)))

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

    def go(self, state: optimizer_plc.ControlLinkState, **counts: int) -> None:
        """Go to a state that may follow, and add to counters: `rejected` sequences, computations `interrupted`."""
        if state not in _NEXT[self.state]:
            raise RuntimeError(f"the link does not go from {self.state.name} to {state.name}")
        self._set(state, **counts)

    def _set(self, state: optimizer_plc.ControlLinkState, **counts: int) -> None:
        """Change the state, add to counters, and note in the journal whether the link is up, or why it is not."""
        self.state = state
        for name, count in counts.items():
            self._counts[name] = (self._counts[name] + count) & 0xFFFFFFFF
        shown = _S.WAITING if state in _UP else state
        if shown not in (self._noted, _S.INTRODUCING):
            self._noted = shown
            self._journal.note(self.tick, common.EventKind.CONTROL_LINK, shown)
            self._tell()


class ControlClient:
    """The control PLC, as the optimiser uses it.

    Every request raises `LinkError` when the link fails, and `RequestRefusedError` with code 6 when another optimiser
    holds the lease, the constructor ConfigurationError if the files for TLS cannot be used. The link counts damaged
    answers; the name of our model is for messages.
    """

    def __init__(
        self,
        register_map: declaration.RegisterMap,
        endpoint: Endpoint,
        link: ControlLink,
        model_digest: int,
        model_name: str,
    ) -> None:
        self._map = register_map
        header, row = (
            register_map.block_of(record).row_words for record in (registers.SequenceHeader, registers.SequenceRow)
        )
        self._rows_with_header = (requests.MAX_READ_WRITE_WORDS - header) // row
        """Rows that fit into one request with the header that commits them: 18 of three inputs."""
        self._endpoint, self._link = endpoint, link
        self._model_digest, self._model_name = model_digest, model_name
        self._client = client.RegisterClient.at(self._map, endpoint)
        self._beats = 0

    def close(self) -> None:
        """Close the connection; the next request opens another."""
        self._client.close()

    def reload_certificates(self) -> None:
        """Start over with the present files for TLS, which may be new ones; ConfigurationError: they cannot be used."""
        if self._endpoint.tls is not None:
            self._client.close()
            self._client = client.RegisterClient.at(self._map, self._endpoint)

    async def introduce(self) -> None:
        """Connect, send our number and our model's digest; ModelFileError: the control PLC has another model."""
        await self._client.connect(0.0)
        self._link.answered()
        if self._link.state is _S.WRONG_MODEL:  # a heartbeat would keep the right optimiser out
            await self._check_model()
        await self._beat()
        await self._check_model()
        self._link.introduced()

    async def _check_model(self) -> None:
        theirs = (await self._client.read(common.Identity)).model_digest
        if theirs == self._model_digest:
            return
        if (await self._client.read(common.Identity)).model_digest != theirs:  # this block is not sealed
            raise DamagedAnswerError(f"{self._client.peer}: its identity arrived damaged")
        raise ModelFileError(
            f"{self._client.peer} runs model {theirs:08x}, this optimiser {self._model_digest:08x} "
            f"({self._model_name}): give both PLCs the same model.file"
        )

    def _heartbeat(self) -> registers.Heartbeat:
        self._beats = (self._beats + 1) & 0xFFFF
        return registers.Heartbeat(self._beats, self._model_digest, self._link.holder)

    async def pace(self, session: int) -> TimeBase | None:
        """Return the time base of a session; None where the control PLC is in another, or shows none that can be."""

        async def twice() -> common.SessionPace:  # this block is not sealed, and what it says is not asked for again
            one, other = await self._client.read(common.SessionPace), await self._client.read(common.SessionPace)
            if one != other:
                raise DamagedAnswerError(f"{self._client.peer}: its pace arrived damaged")
            return one

        shown = await self._again(twice)
        try:
            return shown.of(session) if shown.session == session else None
        except ValueError:
            return None

    async def next_update(self, wanted: registers.AwaitUpdate) -> registers.Update:
        """Wait for an update; after `LONGEST_WAIT_S` return the last one there was, or an empty one."""
        patience_s = self._endpoint.timeout_s + LONGEST_WAIT_S

        async def waiting() -> registers.Update:
            try:
                return await self._client.exchange(wanted, registers.Update, patience_s=patience_s)
            except DamagedAnswerError:
                self._link.damaged()
                return await self._client.read(registers.Update)  # it is latched: asking to wait again could give it up

        return await self._again(waiting)

    async def plan(self, plan: registers.Plan) -> None:
        """Send the updating period."""
        await self._again(lambda: self._client.write(plan))

    async def newest(self) -> registers.LatchedUpdate:
        """Give a sign of life; return which update is the newest."""
        return await self._again(lambda: self._client.exchange(self._heartbeat(), registers.LatchedUpdate))

    async def deliver(self, sequence: InputSequence, plan: registers.Plan | None = None) -> registers.Verdict:
        """Send the answer to an update, the header that commits it last; return the verdict of the control PLC.

        A plan, its updating period where that has not been sent, goes first, in the same segment.
        """
        for attempt in range(1, ATTEMPTS + 1):
            answer = await self._again(lambda: self._commit(sequence, plan))
            if answer.verdict not in DAMAGED_THERE or attempt == ATTEMPTS:
                break
        if answer.number != sequence.header.number or answer.verdict not in registers.Verdict.__members__.values():
            raise errors.LinkError(
                f"{self._client.peer} acknowledges sequence {answer.number} with verdict {answer.verdict} after "
                f"sequence {sequence.header.number}: look for a second optimiser"
            )
        return registers.Verdict(answer.verdict)

    async def _commit(self, sequence: InputSequence, plan: registers.Plan | None) -> registers.Acknowledgement:
        header, rows = sequence.header, list(map(registers.SequenceRow, sequence.rows))
        await self._client.write_rows(rows[self._rows_with_header :], start=self._rows_with_header)
        try:
            return await self._client.exchange(
                header, registers.Acknowledgement, rows=rows[: self._rows_with_header], before=plan
            )
        except DamagedAnswerError:  # the sequence has been judged, and may have been accepted
            self._link.damaged()
            return await self._again(lambda: self._client.read(registers.Acknowledgement))

    async def verdict_on(self, sequence: InputSequence) -> registers.Verdict | None:
        """Return the verdict on a sequence whose acknowledgement was lost; None when it has not arrived."""
        answer = await self._again(lambda: self._client.read(registers.Acknowledgement))
        known = answer.number == sequence.header.number and answer.verdict in registers.Verdict.__members__.values()
        return registers.Verdict(answer.verdict) if known else None

    async def _again(self, request: Callable[[], Awaitable[T]]) -> T:
        """Make a request; a connection opened since the introduction introduces itself and tries again."""
        try:
            return await self._undamaged(request)
        except RequestRefusedError as error:
            if error.exception_code != BUSY:
                raise
        await self._beat()
        return await self._undamaged(request)

    async def _beat(self) -> None:
        await self._undamaged(lambda: self._client.write(self._heartbeat()))

    async def _undamaged(self, request: Callable[[], Awaitable[T]]) -> T:
        """Make a request, up to `ATTEMPTS` times when it arrives damaged there (exception 03), or its answer here."""
        for _ in range(ATTEMPTS - 1):
            try:
                return await request()
            except DamagedAnswerError:
                self._link.damaged()
            except RequestRefusedError as error:
                if error.exception_code != ILLEGAL_VALUE:
                    raise
        return await request()
