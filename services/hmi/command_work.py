"""What is written for each command, and what is read back of it. A connection with the operator's role is given."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, Final

from coldloop.errors import LinkError, RequestRefusedError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.process.signals import INPUT_NAMES, INPUT_UNITS, OUTPUT_NAMES, TICK_S
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import Cause, LadderStatus, Mode, Operator, OperatorMode
from coldloop.registers.plant import AHEAD_STEPS, LiveLoad, LoadAhead, LoadStatus, SensorFault, SensorFaultKind
from coldloop.registers.safety import ALL_ALARMS, Alarm, AlarmAction, AlarmCommand, AlarmKind, AlarmState
from coldloop.registers.seal import sealed
from coldloop.service.event_text import word
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
    clock_text,
    read_load,
)

EFFECT_S: Final = 2.0
"""How long the effect of a command is waited for."""
LOOK_S: Final = 0.1
LEAD_TICKS: Final = 8
"""A load that is to begin now begins so many ticks later, so that it is there in time."""
LEAD_S: Final = 0.5
"""And not sooner than this by the clock: at a high factor ticks pass quickly."""
WAITING: Final = frozenset({AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED})


class NotTakenError(UsageError):
    """A command was written, and what was read back says that it was not carried out."""


class CommandClient(RegisterClient):
    """A client that knows whether something it has written may count."""

    has_written = False

    async def write_rows(self, records: Sequence[tuple[Any, ...]], start: int = 0) -> None:
        """Write rows; only a refusal says that they do not count."""
        before, self.has_written = self.has_written, True
        try:
            await super().write_rows(records, start)
        except RequestRefusedError:
            self.has_written = before
            raise


Clients = Mapping[str, CommandClient]
"""One for each service that a command concerns; connected."""


async def set_mode(clients: Clients, command: SetMode) -> str:
    """Write who drives; wait until the control PLC follows."""
    client = clients["control_plc"]
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


async def check_manual(client: RegisterClient) -> Operator:
    """Return what the operator has written, if manual drives.

    Raises:
        UsageError: It does not.
    """
    operator = await client.read(Operator)
    if operator.mode != OperatorMode.MANUAL:
        raise UsageError("setpoints count in manual mode: take over in manual first")
    return operator


async def set_setpoint(clients: Clients, command: SetSetpoint) -> str:
    """Write one setpoint; the others stay as they are."""
    client, place = clients["control_plc"], INPUT_NAMES.index(command.input)
    operator = await check_manual(client)
    values = [command.value if i == place else present for i, present in enumerate(operator[1:])]
    await client.write(Operator(operator.mode, *values))
    back = await client.read(Operator)
    return f"setpoint of {command.input} {back[1 + place]:g} {INPUT_UNITS[place]}; approached within the rate limit"


async def set_load(clients: Clients, command: SetLoad) -> str:
    """Write the load; wait until the plant has it."""
    client = clients["plant"]
    await client.write(sealed(LiveLoad(0, command.watts)))
    status = await client.read(LoadStatus)
    for _ in range(round(EFFECT_S / LOOK_S)):
        if abs(status.watts - command.watts) <= 1e-3 * max(1.0, command.watts):
            return f"load {status.watts:g} W"
        await asyncio.sleep(LOOK_S)
        status = await client.read(LoadStatus)
    if status.upcoming:
        return f"load {status.next_watts:g} W from {clock_text(status.next_tick * TICK_S)} on"
    return f"load {status.watts:g} W"


async def play_load(clients: Clients, command: PlayLoad) -> str:
    """Write a load file, as many steps as fit into a request at a time."""
    client = clients["plant"]
    steps = read_load(command.content)
    identity = await client.read(Identity)
    if not identity.session:
        raise UsageError("the plant has no session")
    begin = identity.tick + lead_ticks(await client.read(SessionPace))
    times, watts = [begin + tick for tick, _ in steps], [each for _, each in steps]
    taken = 0
    while taken < len(steps):
        some = slice(taken, taken + AHEAD_STEPS)
        part = LoadAhead.first_of(identity.session, times[some], watts[some])
        try:
            await client.write(sealed(part))
        except LinkError as error:
            if not taken:
                raise
            raise LinkError(
                f"{error}; of {len(steps)} steps the plant has taken the first {taken}, and holds {watts[taken - 1]:g} "
                f"W from {clock_text(times[taken - 1] * TICK_S)} on"
            ) from None
        taken += part.length
    status = await client.read(LoadStatus)
    return (
        f"load of {len(steps)} steps from {clock_text(begin * TICK_S)} to {clock_text(status.last_tick * TICK_S)}; its "
        "last value is held"
    )


def lead_ticks(pace: SessionPace) -> int:
    """Return how many ticks ahead of now a load is to begin."""
    return max(LEAD_TICKS, math.ceil(LEAD_S * pace.factor / TICK_S)) if pace.realtime else LEAD_TICKS


async def treat_alarm(clients: Clients, command: TreatAlarm) -> str:
    """Write what is done with alarms; wait until their states say that it was."""
    client, action = clients["control_plc"], AlarmAction(command.action)
    kinds = list(AlarmKind) if command.alarm == ALL_ALARMS else [AlarmKind(command.alarm)]
    if command.seen is None:
        await client.write(AlarmCommand(command.alarm, action, command.time_s))
        raised_again: list[AlarmKind] = []
    else:
        kinds, raised_again = _seen(await client.read_rows(Alarm, 0, len(AlarmKind)), kinds, command.seen)
        for kind in kinds:
            await client.write(AlarmCommand(kind, action, command.time_s))
    rows = await client.read_rows(Alarm, 0, len(AlarmKind))
    for _ in range(round(EFFECT_S / LOOK_S)):
        if all(_is_done(action, rows[kind].state) for kind in kinds):
            break
        await asyncio.sleep(LOOK_S)
        rows = await client.read_rows(Alarm, 0, len(AlarmKind))
    return _treated(action, rows, kinds, raised_again)


def _seen(
    rows: Sequence[Alarm], kinds: Sequence[AlarmKind], seen: Mapping[str, int]
) -> tuple[list[AlarmKind], list[AlarmKind]]:
    """Return the alarms that are as the operator has seen them, and those that were raised again since.

    Raises:
        UsageError: None is as it was seen.
    """
    waiting = [kind for kind in kinds if word(kind) in seen or rows[kind].state in WAITING]
    same = [kind for kind in waiting if seen.get(word(kind)) == rows[kind].times]
    again = [kind for kind in waiting if kind not in same]
    if not waiting:
        raise UsageError("no alarm waits for an acknowledgement any more")
    if not same:
        raise UsageError(f"raised again since it was shown: {_names(again)}; look at it first")
    return same, again


def _is_done(action: AlarmAction, state: int) -> bool:
    if action is AlarmAction.ACKNOWLEDGE:
        return state not in WAITING
    if action in (AlarmAction.SHELVE, AlarmAction.OUT_OF_SERVICE):
        return state == {AlarmAction.SHELVE: AlarmState.SHELVED}.get(action, AlarmState.OUT_OF_SERVICE)
    return state != {AlarmAction.UNSHELVE: AlarmState.SHELVED}.get(action, AlarmState.OUT_OF_SERVICE)


def _treated(
    action: AlarmAction, rows: Sequence[Alarm], kinds: Sequence[AlarmKind], raised_again: Sequence[AlarmKind]
) -> str:
    """Return what has become of alarms.

    Raises:
        NotTakenError: Nothing of what was asked for.
    """
    left = [kind for kind in kinds if not _is_done(action, rows[kind].state)]
    if len(left) == len(kinds):
        states = ", ".join(sorted({word(AlarmState(rows[kind].state)) for kind in left}))
        raise NotTakenError(f"{_names(left)}: {states}; the control PLC did not take it")
    done = [kind for kind in kinds if kind not in left]
    if len(kinds) == 1:
        row = rows[kinds[0]]
        until = f" until {clock_text(row.shelved_until * TICK_S)}" if row.state == AlarmState.SHELVED else ""
        text = f"alarm {word(kinds[0])}: {word(AlarmState(row.state))}{until}"
    else:
        states = ", ".join(
            f"{sum(rows[kind].state == state for kind in done)} {word(state)}"
            for state in AlarmState
            if any(rows[kind].state == state for kind in done)
        )
        text = f"of {len(kinds)} alarms {states}"
    if left:
        text += f"; not {_names(left)}"
    if raised_again:
        text += f"; raised again since they were shown, and left: {_names(raised_again)}"
    return text


def _names(kinds: Sequence[AlarmKind]) -> str:
    return ", ".join(word(kind) for kind in kinds)


async def fault_sensor(clients: Clients, command: FaultSensor) -> str:
    """Put a fault into a sensor."""
    client, row = clients["plant"], OUTPUT_NAMES.index(command.output)
    await client.write_rows([SensorFault(command.fault, command.value)], row)
    (back,) = await client.read_rows(SensorFault, row, 1)
    return f"sensor of {command.output}: {word(SensorFaultKind(back.kind))}"


async def set_factor(clients: Clients, command: SetFactor) -> str:
    """Write how fast plant time goes."""
    return await _set_pace(clients, lambda pace: pace._replace(realtime=1, factor=command.factor))


async def set_paused(clients: Clients, command: SetPaused) -> str:
    """Let plant time stand still, or go on."""
    return await _set_pace(clients, lambda pace: pace._replace(paused=int(command.paused)))


async def _set_pace(clients: Clients, change: Callable[[SessionPace], SessionPace]) -> str:
    """Write the time base: the plant first, then those who follow it."""
    plant = clients["plant"]
    present = await plant.read(SessionPace)
    pace = change(present)
    if pace.paused and not pace.realtime:
        raise UsageError("the session is in lock-step: it goes as far as it is granted")
    for client in clients.values():
        if (await client.read(Identity)).session == present.session:
            await client.write(pace)
    back = await plant.read(SessionPace)
    return f"{'paused' if back.paused else 'running'}, factor {back.factor:g}"


Work = Callable[[Clients, Any], Awaitable[str]]
ALL_SERVICES: Final = ("plant", "control_plc", "optimizer_plc")
WORK: Final[Mapping[type[Command], tuple[tuple[str, ...], Work]]] = {
    SetMode: (("control_plc",), set_mode),
    SetSetpoint: (("control_plc",), set_setpoint),
    SetLoad: (("plant",), set_load),
    PlayLoad: (("plant",), play_load),
    TreatAlarm: (("control_plc",), treat_alarm),
    FaultSensor: (("plant",), fault_sensor),
    SetFactor: (ALL_SERVICES, set_factor),
    SetPaused: (ALL_SERVICES, set_paused),
}
"""Who is written to, and how."""
