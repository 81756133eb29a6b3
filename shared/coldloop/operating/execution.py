"""Commands carried out: what is written for each, loads of any length among them, and what is read back of it."""

import asyncio
import math
from bisect import bisect_right
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, Final, TypeVar

from coldloop.errors import BUSY, LinkError, PeerUnreachableError, RequestRefusedError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.settings import Endpoint
from coldloop.operating import commands, observer
from coldloop.operating.commands import Command, TreatAlarm, clock_text
from coldloop.process import declaration, load_profile
from coldloop.registers import Maps, codec, common, maps_of
from coldloop.registers import plant as registers
from coldloop.registers.control_plc import Cause, LadderStatus, Mode, Operator, OperatorMode
from coldloop.service.journal import alarm_word
from coldloop.text import value_text

R = TypeVar("R")
LAST_TICK: Final = 2**32 - 1
KEPT_AHEAD: Final = registers.LOAD_ROWS
"""Steps that the plant is to know in advance; it keeps twice as many."""
EFFECT_S: Final = 2.0
"""How long the effect of a command is waited for."""
LOOK_S: Final = 0.1
LEAD_TICKS: Final = 8
"""A load that is to begin now begins so many ticks later, so that it is there in time, ..."""
LEAD_S: Final = 2.0
"""... and not sooner than this by the clock: at a high factor ticks pass quickly."""
MOST_NAMES: Final = 6
"""Alarms that are named; more are counted."""
WAITING: Final = frozenset({common.AlarmState.UNACKNOWLEDGED, common.AlarmState.RETURNED})
HINTS: Final = {
    1: "the certificate or the address of this client does not have the operator role",
    3: "the value is not possible now",
    BUSY: "another client is its writer",
}
ALL_SERVICES: Final = Maps._fields


class LoadStream:
    """Keeps the plant supplied with the steps of the load of a session, of which it has `sent` already.

    The load begins at tick `begin`. A step beyond the last tick of a session raises a UsageError.
    """

    def __init__(
        self, plant: RegisterClient, session: int, load: load_profile.LoadProfile, *, sent: int = 0, begin: int = 0
    ) -> None:
        self._plant = plant
        self._session = session
        self._times = [begin + tick for tick in load.times]
        if self._times[-1] > LAST_TICK:
            raise UsageError(f"a load with a step at tick {self._times[-1]}: the last tick of a session is {LAST_TICK}")
        self._watts = load.watts
        self._sent = sent
        self._unanswered = 0
        """Steps behind those of which it is not known whether the plant has them."""

    @property
    def steps(self) -> int:
        """Steps of the load."""
        return len(self._times)

    @property
    def done(self) -> bool:
        """Whether the plant has all steps."""
        return self._sent >= len(self._times)

    @property
    def known_until(self) -> int | None:
        """First tick whose load the plant does not know yet; None when it knows all of it."""
        return None if self.done else self._times[self._sent]

    async def feed(self, tick: int) -> None:
        """Write what the plant should know at `tick`.

        Raises:
            LinkError: The plant does not answer; or it refuses steps, because they come too late or the session is
                another one.
        """
        while not self.done and self._sent - bisect_right(self._times, tick) < KEPT_AHEAD:
            await self._send()

    async def fill(self) -> int:
        """Write as much as the plant has room for; return how many steps it has by now.

        The first steps replace what it knew from there on, and so make room for themselves.

        Raises:
            LinkError: As `feed`.
        """
        if not self._sent:
            await self._send()
        free = (await self._plant.read(registers.LoadStatus)).free
        while not self.done and free >= registers.AHEAD_STEPS:
            free -= await self._send()
        return self._sent

    async def _send(self) -> int:
        """Write the next steps; return how many."""
        some = slice(self._sent, self._sent + registers.AHEAD_STEPS)
        record = registers.LoadAhead.first_of(self._session, self._times[some], self._watts[some])
        self._unanswered = record.length
        try:
            await self._plant.write(codec.sealed(record, self._plant.map))
        except LinkError as error:
            if not self._sent:
                raise
            kind = PeerUnreachableError if isinstance(error, PeerUnreachableError) else LinkError
            unit, since_s = self._plant.process.load.unit, self._times[self._sent - 1] * self._plant.process.tick_s
            raise kind(
                f"{error}; of {self.steps} steps the plant has taken at least the first {self._sent}, and holds "
                f"{self._watts[self._sent - 1]:g} {unit} from {since_s:g} s on"
            ) from None
        self._sent, self._unanswered = self._sent + record.length, 0
        return record.length

    async def was_replaced(self) -> bool:
        """Return whether another client has written the load since: the last step known is not the last one sent."""
        status = await self._plant.read(registers.LoadStatus)
        if self._unanswered and status.last_tick == self._times[self._sent + self._unanswered - 1]:
            self._sent += self._unanswered  # the answer was lost, the request was not
        self._unanswered = 0
        last = self._times[self._sent - 1] if self._sent else 0
        return status.last_tick != last


async def write_table(plant: RegisterClient, load: load_profile.LoadProfile) -> int:
    """Write the load table of a session that is to begin; return the steps that are in it.

    Raises:
        LinkError: The plant does not answer, or refuses.
    """
    steps = [
        registers.LoadStep(*step)
        for step in zip(load.times[: registers.LOAD_ROWS], load.watts[: registers.LOAD_ROWS], strict=True)
    ]
    await plant.write_rows(steps)
    return len(steps)


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


def clients_of(endpoints: Mapping[str, Endpoint], process: declaration.Process) -> dict[str, CommandClient]:
    """Return clients of services of a process, not connected yet."""
    maps = maps_of(process).by_service
    return {service: CommandClient.at(maps[service], endpoint) for service, endpoint in endpoints.items()}


@asynccontextmanager
async def connected(clients: Clients) -> AsyncIterator[Clients]:
    """Connect clients, all before one is written to, and close them at the end.

    Raises:
        PeerUnreachableError: A service is not there.
    """
    try:
        for client in clients.values():
            await client.connect(0.0)
        yield clients
    finally:
        for client in clients.values():
            client.close()


def reason_of(error: Exception) -> str:
    """Return why a command came to nothing; a refusal is put into words."""
    hint = HINTS.get(error.exception_code) if isinstance(error, RequestRefusedError) else None
    return f"{error}: {hint}" if hint else str(error)


async def _read_until(read: Callable[[], Awaitable[R]], met: Callable[[R], bool]) -> R:
    """Read again and again, for `EFFECT_S`, until what is read is as expected; return what was read last."""
    found = await read()
    for _ in range(round(EFFECT_S / LOOK_S)):
        if met(found):
            break
        await asyncio.sleep(LOOK_S)
        found = await read()
    return found


async def set_mode(clients: Clients, command: commands.SetMode) -> str:
    """Write the operating mode; wait until the control PLC follows."""
    client = clients["control_plc"]
    mode = OperatorMode[command.mode.upper()]
    operator = await client.read(Operator)
    await client.write(operator._replace(mode=mode))
    manual = {OperatorMode.MANUAL: {Mode.MANUAL}, OperatorMode.CLASSICAL: {Mode.CLASSICAL}}
    expected = manual.get(mode, {Mode.MPC, Mode.REST})
    ladder = await _read_until(lambda: client.read(LadderStatus), lambda ladder: ladder.mode in expected)
    back = OperatorMode((await client.read(Operator)).mode)
    return f"operator's mode {back.word}; the control PLC is in {Mode(ladder.mode).word} ({Cause(ladder.cause).word})"


def check_bounds(command: commands.SetSetpoint, low: float, high: float) -> None:
    """Check a setpoint against the bounds of its input (UsageError: it is beyond them)."""
    unit = command.unit
    if not low <= command.value <= high:
        span = f"{value_text(low)} to {value_text(high, unit)}"
        raise UsageError(f"{command.input} = {value_text(command.value, unit)} is not from {span}")


async def check_manual(client: RegisterClient) -> Operator:
    """Return what the operator has written, if manual drives (UsageError: it does not)."""
    operator = await client.read(Operator)
    if operator.mode != OperatorMode.MANUAL:
        raise UsageError("setpoints apply in manual mode only: take over in manual first")
    return operator


async def set_setpoint(clients: Clients, command: commands.SetSetpoint) -> str:
    """Write one setpoint; the others stay as they are."""
    client, place, unit = clients["control_plc"], command.place, command.unit
    operator = await check_manual(client)
    values = [command.value if i == place else present for i, present in enumerate(operator.u)]
    await client.write(Operator(operator.mode, tuple(values)))
    back = await client.read(Operator)
    was = f"was {value_text(operator.u[place], unit)}"
    now = f"setpoint of {command.input} {value_text(back.u[place], unit)}"
    return f"{now} ({was}); approached within the rate limit"


async def set_load(clients: Clients, command: commands.SetLoad) -> str:
    """Write the load; wait until the plant has it, where it is to have it at once.

    Raises:
        UsageError: It is to begin at a tick that has passed.
        LinkError: The plant knows another load afterwards.
    """
    client = clients["plant"]
    before, now = await client.read(registers.LoadStatus), (await client.read(common.Identity)).tick
    if 0 < command.tick <= now:
        raise UsageError(f"plant time is {now * client.process.tick_s:g} s already: name a later one")
    await client.write(codec.sealed(registers.LiveLoad(command.tick, command.watts), client.map))
    status = await _read_until(
        lambda: client.read(registers.LoadStatus),
        lambda status: bool(command.tick) or math.isclose(status.watts, command.watts, rel_tol=1e-6),
    )
    unit, tick_s = command.process.load.unit, command.process.tick_s
    was = f"(was {value_text(before.watts, unit)})"
    if not status.upcoming:
        return f"load {value_text(status.watts, unit)} now {was}"
    if command.tick and status.last_tick != command.tick:
        raise LinkError(f"the load from {command.tick * tick_s:g} s on is different: another client has overwritten it")
    text = f"load {value_text(command.watts, unit)} from {status.last_tick * tick_s:g} s on"
    if status.next_tick == status.last_tick:
        return f"{text} {was}"
    return f"{text}, before it {value_text(status.next_watts, unit)} from {status.next_tick * tick_s:g} s on {was}"


async def play_load(clients: Clients, command: commands.PlayLoad) -> str:
    """Write a load file at once (LinkError: the plant has no room for all of it)."""
    return await stream_load(clients, command.profile, 0, None)


async def stream_load(
    clients: Clients, load: load_profile.LoadProfile, tick: int, say: Callable[[str], None] | None
) -> str:
    """Write a load of any length from a tick on (0 is now), as fast as the plant can store it.

    Raises:
        UsageError: It is to begin at a tick that has passed, or the plant has no session.
        LinkError: Another client has overwritten it; or the plant has no room for all of it, and nobody to `say` so to.
    """
    plant = clients["plant"]
    identity, tick_s = await plant.read(common.Identity), plant.process.tick_s
    if not identity.session:
        raise UsageError("the plant has no session")
    if 0 < tick <= identity.tick:
        raise UsageError(f"plant time is {identity.tick * tick_s:g} s already: name a later one")
    begin = tick or identity.tick + lead_ticks(await plant.read(common.SessionPace), tick_s)
    stream = LoadStream(plant, identity.session, load, begin=begin)
    taken = await stream.fill()
    if not stream.done:
        if say is None:
            raise LinkError(f"the plant has room for {taken} steps of {stream.steps}: it holds the last of them")
        say(f"the plant has taken {taken} steps of {stream.steps}: the rest is written as it takes them")
    while not stream.done:
        await asyncio.sleep(LOOK_S)
        if await stream.was_replaced():
            raise LinkError("another client has overwritten the load: the rest of the file is not written")
        await stream.fill()
    end = (await plant.read(registers.LoadStatus)).last_tick
    return f"load of {stream.steps} steps from {begin * tick_s:g} s to {end * tick_s:g} s; its last value is held"


def lead_ticks(pace: common.SessionPace, tick_s: float) -> int:
    """Return how many ticks ahead of now a load is to begin."""
    return max(LEAD_TICKS, math.ceil(LEAD_S * pace.factor / tick_s)) if pace.realtime else LEAD_TICKS


async def treat_alarm(clients: Clients, command: TreatAlarm) -> str:
    """Write what is done with alarms; wait until their states say that it was.

    Raises:
        UsageError: None is as the operator has seen it.
        NotTakenError: Nothing of the command took effect.
    """
    client, action = clients["control_plc"], common.AlarmAction(command.action)
    kinds = list(common.alarms_of(command.process)) if command.alarm == common.ALL_ALARMS else [command.alarm]
    raised_again: list[int] = []
    before = await observer.read_alarms(client)
    if command.seen is None:
        await client.write(common.AlarmCommand(command.alarm, action, command.time_s))
        if action is common.AlarmAction.ACKNOWLEDGE:
            kinds = [kind for kind in kinds if before[kind].state in WAITING]
            if not kinds:
                return "no alarm waits to be acknowledged"
    else:
        words, seen = {kind: alarm_word(kind, command.process) for kind in kinds}, command.seen
        waiting = [kind for kind in kinds if words[kind] in seen or before[kind].state in WAITING]
        kinds = [kind for kind in waiting if seen.get(words[kind]) == before[kind].times]
        raised_again = [kind for kind in waiting if kind not in kinds]
        if not waiting:
            raise UsageError("no alarm waits for an acknowledgement any more")
        if not kinds:
            again = _names(raised_again, command.process)
            raise UsageError(f"raised again since it was shown: {again}; look at it first")
        for kind in kinds:
            await client.write(common.AlarmCommand(kind, action, command.time_s))
    rows = await _read_until(
        lambda: observer.read_alarms(client), lambda rows: all(_is_done(action, rows[kind].state) for kind in kinds)
    )
    return _treated(command, rows, kinds, raised_again)


def _is_done(action: common.AlarmAction, state: int) -> bool:
    if action is common.AlarmAction.ACKNOWLEDGE:
        return state not in WAITING
    if action in (common.AlarmAction.SHELVE, common.AlarmAction.OUT_OF_SERVICE):
        return state == {common.AlarmAction.SHELVE: common.AlarmState.SHELVED}.get(
            action, common.AlarmState.OUT_OF_SERVICE
        )
    return state != {common.AlarmAction.UNSHELVE: common.AlarmState.SHELVED}.get(
        action, common.AlarmState.OUT_OF_SERVICE
    )


def _treated(
    command: TreatAlarm, rows: Sequence[common.Alarm], kinds: Sequence[int], raised_again: Sequence[int]
) -> str:
    action, process = common.AlarmAction(command.action), command.process
    left = [kind for kind in kinds if not _is_done(action, rows[kind].state)]
    if len(left) == len(kinds):
        states = ", ".join(sorted({common.AlarmState(rows[kind].state).word for kind in left}))
        raise NotTakenError(f"{_names(left, process)}: {states}; the control PLC did not take it")
    done = [kind for kind in kinds if kind not in left]
    if len(kinds) == 1:
        row = rows[kinds[0]]
        until = (
            f" until {clock_text(row.shelved_until * process.tick_s)}" if row.state == common.AlarmState.SHELVED else ""
        )
        over = action is common.AlarmAction.ACKNOWLEDGE and row.state == common.AlarmState.NORMAL
        state = common.AlarmState(row.state).word
        text = f"alarm {alarm_word(kinds[0], process)}: {'acknowledged, now ' if over else ''}{state}{until}"
    elif len(kinds) <= MOST_NAMES:
        states = "; ".join(f"now {state.word}: {_names(each, process)}" for state, each in _by_state(rows, done))
        text = f"acknowledged; {states}" if action is common.AlarmAction.ACKNOWLEDGE else states
    else:
        counted = ", ".join(f"{len(each)} {state.word}" for state, each in _by_state(rows, done))
        text = f"of {len(kinds)} alarms {counted}"
    if left:
        text += f"; not {_names(left, process)}"
    if raised_again:
        text += f"; raised again since they were shown, and left: {_names(raised_again, process)}"
    return text


def _by_state(rows: Sequence[common.Alarm], kinds: Sequence[int]) -> list[tuple[common.AlarmState, list[int]]]:
    """Return the states in which alarms are, and which ones are in each."""
    sorted_out = [(state, [kind for kind in kinds if rows[kind].state == state]) for state in common.AlarmState]
    return [(state, each) for state, each in sorted_out if each]


def _names(kinds: Sequence[int], process: declaration.Process) -> str:
    return ", ".join(alarm_word(kind, process) for kind in kinds)


async def fault_sensor(clients: Clients, command: commands.FaultSensor) -> str:
    """Put a fault into a sensor."""
    client, row = clients["plant"], command.process.output_names.index(command.output)
    await client.write_rows([registers.SensorFault(command.fault, command.value)], row)
    (back,) = await client.read_rows(registers.SensorFault, row, 1)
    return f"sensor of {command.output}: {registers.SensorFaultKind(back.kind).word}"


async def set_pace(clients: Clients, command: commands.SetFactor | commands.SetPaused) -> str:
    """Write how fast plant time goes, pause or resume it."""
    plant = clients["plant"]
    pace = await plant.read(common.SessionPace)
    if isinstance(command, commands.SetFactor):
        pace = pace._replace(realtime=1, factor=command.factor)
    else:
        pace = pace._replace(paused=int(command.paused))
    if not pace.realtime:
        raise UsageError("the session is in lock-step: time advances as it is granted")
    await write_pace(clients, pace)
    back, tick = await plant.read(common.SessionPace), (await plant.read(common.Identity)).tick
    state, time_s = "paused" if back.paused else "running", tick * plant.process.tick_s
    return f"{state} at {time_s:g} s, factor {value_text(back.factor)}"


async def write_pace(clients: Mapping[str, RegisterClient], pace: common.SessionPace) -> None:
    """Write the time base of a session: the plant first, then those who follow it. An optimiser may be in none yet.

    Raises:
        LinkError: One refuses, or does not answer; or the control PLC is not in the session of the plant.
    """
    sessions = {service: (await client.read(common.Identity)).session for service, client in clients.items()}
    if sessions["control_plc"] != sessions["plant"]:
        raise LinkError(
            f"{clients['control_plc'].peer} is in session {sessions['control_plc']}, the plant in {sessions['plant']}: "
            "try again when it has found the plant"
        )
    for service, client in clients.items():
        if sessions[service] == sessions["plant"]:
            await client.write(pace)


Work = Callable[[Clients, Any], Awaitable[str]]
WORK: Final[Mapping[type[Command], tuple[tuple[str, ...], Work]]] = {
    commands.SetMode: (("control_plc",), set_mode),
    commands.SetSetpoint: (("control_plc",), set_setpoint),
    commands.SetLoad: (("plant",), set_load),
    commands.PlayLoad: (("plant",), play_load),
    TreatAlarm: (("control_plc",), treat_alarm),
    commands.FaultSensor: (("plant",), fault_sensor),
    commands.SetFactor: (ALL_SERVICES, set_pace),
    commands.SetPaused: (ALL_SERVICES, set_pace),
}
"""Who is written to, and how; in the case of a time base the plant first."""
