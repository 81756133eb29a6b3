"""Carries out commands: two steps, a connection with the operator's role only meanwhile, and a read-back."""

import asyncio
import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from coldloop.errors import LinkError, UsageError
from coldloop.modbus.endpoints import Endpoint
from coldloop.operating.commands import (
    Command,
    FaultSensor,
    PlayLoad,
    SetLoad,
    SetSetpoint,
    TreatAlarm,
    clock_text,
    duration_text,
)
from coldloop.operating.execution import (
    WORK,
    CommandClient,
    NotTakenError,
    check_bounds,
    clients_of,
    connected,
    reason_of,
)
from coldloop.registers.common import SessionPace
from coldloop.registers.plant import LoadStatus
from coldloop.registers.safety import AlarmAction
from coldloop_hmi.premises import Premises, differences, read_premises
from coldloop_hmi.process_image import Model

CONFIRM_WITHIN_S: Final = 60.0
MOST_PREPARED: Final = 100
TIMEOUT_S: Final = 3.0


class Preview(NamedTuple):
    """What a command would do, what it would change as it is now, and the token that confirms it."""

    token: str
    text: str
    now: str


class Prepared(NamedTuple):
    """A command that waits for its confirmation."""

    command: Command
    text: str
    user: str
    until: float
    premises: Premises


class PremisesChangedError(UsageError):
    """What a command was prepared for has changed since."""

    def __init__(self, reason: str, preview: Preview) -> None:
        super().__init__(reason)
        self.preview = preview


class CommandResult(NamedTuple):
    """What became of a command: one of the last three says it."""

    asked: str
    applied: str = ""
    """What was read back."""
    refused_because: str = ""
    """It was not done, and why."""
    uncertain_because: str = ""
    """It was written, and it is not known what has become of it, or only a part was done."""


class OperatorDesk:
    """Takes commands and carries them out.

    Args:
        endpoints: Where the services are, with the operator's certificate, by service.
        model: What is known of the rig.
        now: Monotonic clock, s.
        training: Sensor faults are allowed.
    """

    def __init__(
        self, endpoints: dict[str, Endpoint], model: Model, now: Callable[[], float], *, training: bool
    ) -> None:
        self._endpoints = endpoints
        self._model = model
        self.process = model.process
        self._now = now
        self._training = training
        self._prepared: OrderedDict[str, Prepared] = OrderedDict()
        self._turn = asyncio.Lock()
        self._last = ""  # whose the last command was, and what

    async def prepare(self, command: Command, user: str) -> Preview:
        """Take a command, and return what it would do, with the token that confirms it.

        Raises:
            UsageError: It is not possible now.
            LinkError: The service does not answer.
        """
        self._check(command)
        token = secrets.token_urlsafe(16)
        text = f"{command.text}{self._consequences(command)}"
        premises = await self._premises(command)
        self._prepared[token] = Prepared(command, text, user, self._now() + CONFIRM_WITHIN_S, premises)
        while len(self._prepared) > MOST_PREPARED:
            self._prepared.popitem(last=False)
        now = "; ".join(f"{name} {value}" for name, value in premises.items() if name != "session")
        return Preview(token, text, now)

    async def _premises(self, command: Command) -> Premises:
        async with connected(self._clients(WORK[type(command)][0])) as clients:
            return await read_premises(clients, command)

    def _check(self, command: Command) -> None:
        if isinstance(command, FaultSensor) and not self._training:
            raise UsageError("sensor faults are offered only where hmi.training is switched on")
        if isinstance(command, SetSetpoint):
            limits = self._model.limits
            low, high = limits.input_low[command.place], limits.input_high[command.place]
            if high > low:  # they are known
                check_bounds(command, low, high)

    def _consequences(self, command: Command) -> str:
        """Return what a command means at present, beyond its own words."""
        if isinstance(command, TreatAlarm) and command.action == AlarmAction.SHELVE and command.time_s:
            return self._by_the_clock(command.time_s)
        load = self._model.record("plant", LoadStatus)
        if isinstance(command, SetLoad | PlayLoad) and load and load.upcoming:
            until = clock_text(load.last_tick * self.process.tick_s)
            steps = f"{load.upcoming} steps" if load.upcoming > 1 else "step"
            return f"; the {steps} of the load still to come, until {until}, will be dropped"
        return ""

    def _by_the_clock(self, seconds: float) -> str:
        """Return what so much plant time is at present."""
        pace = self._model.record("plant", SessionPace)
        if pace is None or not pace.session:
            return ""
        if not pace.realtime:
            return " of plant time, which advances as it is granted"
        if pace.paused:
            return " of plant time, which is paused"
        if pace.factor == 1.0 or pace.factor <= 0.0:
            return ""
        return f" of plant time, {duration_text(seconds / pace.factor)} by the clock at factor {pace.factor:g}"

    async def confirm(self, token: str, user: str) -> CommandResult:
        """Carry out a command that was prepared, once.

        Raises:
            PremisesChangedError: What it was prepared for has changed; it has a new preview.
            UsageError: There is none with this token, or it is another user's, or it was prepared too long ago.
        """
        prepared = self._prepared.get(token)
        if prepared is None or prepared.user != user or self._now() > prepared.until:
            raise UsageError(
                f"nothing to confirm: a command is confirmed once, within {CONFIRM_WITHIN_S:g} s, by its own user"
            )
        del self._prepared[token]
        async with self._turn:
            try:
                changes = differences(prepared.premises, await self._premises(prepared.command))
            except LinkError as error:
                return CommandResult(prepared.text, refused_because=reason_of(error))
            if changes:
                by = f"; the last command here was {self._last}" if self._last else ""
                reason = f"not done, as it has changed since it was asked: {changes}{by}"
                raise PremisesChangedError(reason, await self.prepare(prepared.command, user))
            result = await self._carry_out(prepared.command, prepared.text)
            if not result.refused_because:
                self._last = f"{user}'s: {prepared.text}"
                self._model.commands += 1
            return result

    async def _carry_out(self, command: Command, asked: str) -> CommandResult:
        services, work = WORK[type(command)]
        clients = self._clients(services)
        try:
            async with connected(clients):
                return CommandResult(asked, applied=await work(clients, command))
        except NotTakenError as error:
            return CommandResult(asked, refused_because=str(error))
        except (LinkError, UsageError) as error:
            if any(client.has_written for client in clients.values()):
                reason = f"{reason_of(error)}; check its effect before repeating it"
                return CommandResult(asked, uncertain_because=reason)
            return CommandResult(asked, refused_because=reason_of(error))

    def _clients(self, services: Iterable[str]) -> dict[str, CommandClient]:
        ends = {service: self._endpoints[service].model_copy(update={"timeout_s": TIMEOUT_S}) for service in services}
        return clients_of(ends, self.process)
