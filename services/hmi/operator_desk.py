"""Carries out commands: two steps, a connection with the operator's role only meanwhile, and a read-back."""

import asyncio
import secrets
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from itertools import pairwise
from typing import Any, Final, NamedTuple

from coldloop.endpoints import Endpoint
from coldloop.errors import BUSY, LinkError, RequestRefusedError, UsageError
from coldloop.event_text import word
from coldloop.modbus.client import RegisterClient
from coldloop.process import INPUT_NAMES, INPUT_UNITS, OUTPUT_NAMES, TICK_S
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import Cause, LadderStatus, Mode, Operator, OperatorMode
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.plant import AHEAD_STEPS, LiveLoad, LoadAhead, LoadStatus, SensorFault, SensorFaultKind
from coldloop.registers.safety import ALL_ALARMS, Alarm, AlarmCommand, AlarmKind, AlarmState
from coldloop.seal import sealed
from hmi.commands import (
    Command,
    FaultSensor,
    PlayLoad,
    SetFactor,
    SetLoad,
    SetMode,
    SetPaused,
    SetSetpoint,
    TreatAlarm,
    read_load,
)
from hmi.model import Model
from hmi.signals import MAPS

CONFIRM_WITHIN_S: Final = 60.0
EFFECT_S: Final = 2.0
"""How long the effect of a command is waited for."""
LOOK_S: Final = 0.1
LEAD_TICKS: Final = 8
"""A load that is to begin now begins so many ticks later, so that it is there in time."""
MOST_PREPARED: Final = 100
TIMEOUT_S: Final = 3.0
LONGEST_STEP: Final = 0xFFFF
HINTS: Final = {
    1: "the page's certificate or address has not the role of an operator",
    3: "the value is not possible now",
    BUSY: "somebody else is its writer",
}


class Prepared(NamedTuple):
    """A command that waits for its confirmation."""

    command: Command
    user: str
    until: float


class Outcome(NamedTuple):
    """What became of a command."""

    asked: str
    applied: str
    """What was read back; empty when it was refused."""
    refused_because: str


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
        self._now = now
        self._training = training
        self._prepared: OrderedDict[str, Prepared] = OrderedDict()
        self._turn = asyncio.Lock()

    async def prepare(self, command: Command, user: str) -> str:
        """Take a command, and return the token that confirms it.

        Raises:
            UsageError: It is not possible now.
            LinkError: The service does not answer.
        """
        await self._check(command)
        token = secrets.token_urlsafe(16)
        self._prepared[token] = Prepared(command, user, self._now() + CONFIRM_WITHIN_S)
        while len(self._prepared) > MOST_PREPARED:
            self._prepared.popitem(last=False)
        return token

    async def _check(self, command: Command) -> None:
        if isinstance(command, FaultSensor) and not self._training:
            raise UsageError("sensor faults are offered only where hmi.training is switched on")
        if isinstance(command, SetSetpoint):
            place = INPUT_NAMES.index(command.input)
            low, high = self._model.limits.input_low[place], self._model.limits.input_high[place]
            if high > low and not low <= command.value <= high:
                unit = INPUT_UNITS[place]
                raise UsageError(f"{command.input} = {command.value:g} {unit} is not from {low:g} to {high:g} {unit}")
            await self._with("control_plc", _check_manual)

    async def confirm(self, token: str, user: str) -> Outcome:
        """Carry out a command that was prepared, once.

        Raises:
            UsageError: There is none with this token, or it is another user's, or it was prepared too long ago.
        """
        prepared = self._prepared.pop(token, None)
        if prepared is None or prepared.user != user or self._now() > prepared.until:
            raise UsageError(
                f"nothing to confirm: a command is confirmed once, within {CONFIRM_WITHIN_S:g} s, by who prepared it"
            )
        asked = prepared.command.text
        async with self._turn:
            try:
                return Outcome(asked, await self._carry_out(prepared.command), "")
            except RequestRefusedError as error:
                hint = HINTS.get(error.exception_code)
                return Outcome(asked, "", f"{error}: {hint}" if hint else str(error))
            except (LinkError, UsageError) as error:
                return Outcome(asked, "", str(error))

    async def _carry_out(self, command: Command) -> str:
        if isinstance(command, SetFactor):
            return await self._set_pace(lambda pace: pace._replace(realtime=1, factor=command.factor))
        if isinstance(command, SetPaused):
            return await self._set_pace(lambda pace: pace._replace(paused=int(command.paused)))
        service, work = _WORK[type(command)]
        return await self._with(service, lambda client: work(client, command))

    async def _with(self, service: str, work: Callable[[RegisterClient], Awaitable[str]]) -> str:
        client = self._client(service)
        try:
            await client.connect(0.0)
            return await work(client)
        finally:
            client.close()

    def _client(self, service: str) -> RegisterClient:
        register_map: RegisterMap = MAPS[service]
        return RegisterClient.at(register_map, self._endpoints[service].model_copy(update={"timeout_s": TIMEOUT_S}))

    async def _set_pace(self, change: Callable[[SessionPace], SessionPace]) -> str:
        """Write the time base: the plant first, then those who follow it."""
        clients = {service: self._client(service) for service in MAPS}
        try:
            plant = clients["plant"]
            await plant.connect(0.0)
            present = await plant.read(SessionPace)
            pace = change(present)
            if pace.paused and not pace.realtime:
                raise UsageError("the session is in lock-step: it goes as far as it is granted")
            for client in clients.values():
                await client.connect(0.0)
                if (await client.read(Identity)).session == present.session:
                    await client.write(pace)
            back = await plant.read(SessionPace)
            return f"{'paused' if back.paused else 'running'}, factor {back.factor:g}"
        finally:
            for client in clients.values():
                client.close()


async def _set_mode(client: RegisterClient, command: SetMode) -> str:
    mode = OperatorMode[command.mode.upper()]
    operator = await client.read(Operator)
    await client.write(operator._replace(mode=mode))
    expected = {OperatorMode.MANUAL: {Mode.MANUAL}, OperatorMode.CLASSICAL: {Mode.CLASSICAL}}.get(
        mode, {Mode.MPC, Mode.REST}
    )
    ladder = await client.read(LadderStatus)
    for _ in range(round(EFFECT_S / LOOK_S)):
        if ladder.mode in expected:
            break
        await asyncio.sleep(LOOK_S)
        ladder = await client.read(LadderStatus)
    back = OperatorMode((await client.read(Operator)).mode)
    return (
        f"operator's mode {word(back)}; the control PLC is in {word(Mode(ladder.mode))} ({word(Cause(ladder.cause))})"
    )


async def _check_manual(client: RegisterClient) -> str:
    if (await client.read(Operator)).mode != OperatorMode.MANUAL:
        raise UsageError("setpoints count in manual mode: take over in manual first")
    return ""


async def _set_setpoint(client: RegisterClient, command: SetSetpoint) -> str:
    place = INPUT_NAMES.index(command.input)
    await _check_manual(client)
    operator = await client.read(Operator)
    values = [command.value if i == place else present for i, present in enumerate(operator[1:])]
    await client.write(Operator(operator.mode, *values))
    back = await client.read(Operator)
    return f"setpoint of {command.input} {back[1 + place]:g} {INPUT_UNITS[place]}; approached within the rate limit"


async def _set_load(client: RegisterClient, command: SetLoad) -> str:
    await client.write(sealed(LiveLoad(0, command.watts)))
    status = await client.read(LoadStatus)
    for _ in range(round(EFFECT_S / LOOK_S)):
        if abs(status.watts - command.watts) <= 1e-3 * max(1.0, command.watts):
            return f"load {status.watts:g} W"
        await asyncio.sleep(LOOK_S)
        status = await client.read(LoadStatus)
    return (
        f"load {status.next_watts:g} W from {status.next_tick * TICK_S:g} s on"
        if status.upcoming
        else f"load {status.watts:g} W"
    )


async def _play_load(client: RegisterClient, command: PlayLoad) -> str:
    steps = read_load(command.content)
    identity = await client.read(Identity)
    if not identity.session:
        raise UsageError("the plant has no session")
    begin = identity.tick + LEAD_TICKS
    for first in range(0, len(steps), AHEAD_STEPS):
        part = steps[first : first + AHEAD_STEPS]
        gaps = [later[0] - earlier[0] for earlier, later in pairwise(part)]
        if max(gaps, default=0) > LONGEST_STEP:
            raise UsageError(
                f"a step of more than {LONGEST_STEP * TICK_S:g} s cannot be sent: repeat its value in between"
            )
        watts = (*[step[1] for step in part], *[0.0] * (AHEAD_STEPS - len(part)))
        ticks = (*gaps, *[0] * (AHEAD_STEPS - len(gaps)))
        await client.write(sealed(LoadAhead(identity.session, begin + part[0][0], len(part), watts, ticks)))
    status = await client.read(LoadStatus)
    return f"load of {len(steps)} steps from {begin * TICK_S:g} s to {status.last_tick * TICK_S:g} s"


async def _treat_alarm(client: RegisterClient, command: TreatAlarm) -> str:
    await client.write(AlarmCommand(command.alarm, command.action, command.time_s))
    rows = await client.read_rows(Alarm, 0, len(AlarmKind))
    if command.alarm == ALL_ALARMS:
        waiting = sum(row.state in {AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED} for row in rows)
        return f"{waiting} alarms wait for an acknowledgement"
    row = rows[command.alarm]
    until = f" until {row.shelved_until * TICK_S:g} s" if row.state == AlarmState.SHELVED else ""
    return f"alarm {word(AlarmKind(command.alarm))}: {word(AlarmState(row.state))}{until}"


async def _fault_sensor(client: RegisterClient, command: FaultSensor) -> str:
    row = OUTPUT_NAMES.index(command.output)
    await client.write_rows([SensorFault(command.fault, command.value)], row)
    (back,) = await client.read_rows(SensorFault, row, 1)
    return f"sensor of {command.output}: {word(SensorFaultKind(back.kind))}"


_WORK: Final[dict[type[Command], tuple[str, Callable[[RegisterClient, Any], Awaitable[str]]]]] = {
    SetMode: ("control_plc", _set_mode),
    SetSetpoint: ("control_plc", _set_setpoint),
    SetLoad: ("plant", _set_load),
    PlayLoad: ("plant", _play_load),
    TreatAlarm: ("control_plc", _treat_alarm),
    FaultSensor: ("plant", _fault_sensor),
}
"""Who is written to, and how."""
