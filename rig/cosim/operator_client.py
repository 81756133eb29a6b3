"""An operator's client of a rig that is up: what it asks for is read back."""

import asyncio
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self, TypeVar

from coldloop.errors import LinkError, RequestRefusedError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.process.limits import InputLimits
from coldloop.process.signals import INPUT_NAMES, INPUT_UNITS, TICK_S
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import CONTROL_MAP, Cause, LadderStatus, Mode, Operator, OperatorMode
from coldloop.registers.optimizer_plc import OPTIMIZER_MAP
from coldloop.registers.plant import AHEAD_STEPS, MAX_LOAD_W, PLANT_MAP, LiveLoad, LoadStatus
from coldloop.registers.safety import ALL_ALARMS, Alarm, AlarmAction, AlarmCommand, AlarmKind, AlarmState
from coldloop.registers.seal import sealed
from coldloop.service.event_text import word
from rig.cosim.endpoints import RigEndpoints
from rig.cosim.load_stream import LoadStream

if TYPE_CHECKING:
    from plant.program import LoadProfile

T = TypeVar("T")

EFFECT_S: Final = 2.0
"""How long the effect of a command is waited for."""
LOOK_S: Final = 0.1
FIELDS: Final = dict(zip(("cv155", "ncr22", "cv156"), range(3), strict=True))
HINTS: Final = {
    1: "the certificate or the address of this client has not the role of an operator",
    3: "a value is not possible now",
    6: "another client is its writer",
}


class OperatorClient:
    """Connections to all three services; an async context in which they are open.

    Args:
        endpoints: Where they are.
        limits: What setpoints may be.
    """

    def __init__(self, endpoints: RigEndpoints, limits: InputLimits) -> None:
        self._limits = limits
        self.plant = RegisterClient.at(PLANT_MAP, endpoints.plant)
        self.control = RegisterClient.at(CONTROL_MAP, endpoints.control_plc)
        self.optimizer = RegisterClient.at(OPTIMIZER_MAP, endpoints.optimizer_plc)

    async def __aenter__(self) -> Self:
        """Connect.

        Raises:
            PeerUnreachableError: A service is not there.
        """
        try:
            for client in (self.plant, self.control, self.optimizer):
                await client.connect(0)
        except BaseException:
            self.close()
            raise
        return self

    async def __aexit__(self, _kind: type[BaseException] | None, _error: object, _trace: TracebackType | None) -> None:
        """Close the connections."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        for client in (self.plant, self.control, self.optimizer):
            client.close()

    # -- load ----------------------------------------------------------------------------------------------------------

    async def set_load(self, watts: float, at_s: float | None) -> str:
        """Change the load from a tick on; return what came back."""
        if not 0.0 <= watts <= MAX_LOAD_W:
            raise UsageError(f"load {watts:g} W: not from 0 to {MAX_LOAD_W:g} W")
        before = await self.plant.read(LoadStatus)
        tick = 0 if at_s is None else await self._tick_to_come(at_s)
        await _asked(self.plant.write(sealed(LiveLoad(tick, watts))))
        return f"{await self._load_text(tick, watts)} (was {before.watts:g} W)"

    async def _tick_to_come(self, at_s: float) -> int:
        """Return the tick of a time that is to come."""
        tick, now = round(at_s / TICK_S), (await self.plant.read(Identity)).tick
        if tick <= now:
            raise UsageError(
                f"--at {at_s:g}: plant time is {now * TICK_S:g} s already; give a later one, or leave it out"
            )
        return tick

    async def _load_text(self, tick: int, watts: float) -> str:
        """Return what the plant knows of a load that was written from a tick on; 0 is the next one."""
        status = await self.plant.read(LoadStatus)
        if not status.upcoming:
            return f"load {status.watts:g} W now"
        if tick and status.last_tick != tick:
            raise LinkError(
                f"the load from {tick * TICK_S:g} s on is another one: somebody else has written it meanwhile"
            )
        text = f"load {watts:g} W from {status.last_tick * TICK_S:g} s on"
        if status.next_tick == status.last_tick:
            return text
        return f"{text}, before it {status.next_watts:g} W from {status.next_tick * TICK_S:g} s on"

    async def stream_load(self, load: "LoadProfile", at_s: float | None, say: Callable[[str], None]) -> str:
        """Write a load of any length, as fast as the plant can store it; return what came back."""
        identity = await self.plant.read(Identity)
        if not identity.session:
            raise UsageError(f"{self.plant.peer} has no session")
        begin = identity.tick + LEAD_TICKS if at_s is None else await self._tick_to_come(at_s)
        free = (await self.plant.read(LoadStatus)).free
        stream = LoadStream(self.plant, identity.session, load, begin=begin, ahead=max(0, free - AHEAD_STEPS))
        said = False
        while True:
            await stream.feed((await self.plant.read(Identity)).tick)
            if stream.done:
                break
            if await stream.was_replaced():
                raise LinkError("somebody else has written the load meanwhile: the rest of the file is not written")
            if not said:
                said = True
                say(f"the plant keeps {free} steps of {stream.steps}: this goes on until it has all of them")
            await asyncio.sleep(LOOK_S)
        status = await self.plant.read(LoadStatus)
        times = f"{begin * TICK_S:g} s to {status.last_tick * TICK_S:g} s"
        return f"load of {stream.steps} steps from {times}; its last value is held"

    # -- who drives ----------------------------------------------------------------------------------------------------

    async def set_mode(self, name: str) -> str:
        """Let an operator decide who drives; return what came of it."""
        mode = OperatorMode[name.upper()]
        operator = await self.control.read(Operator)
        await _asked(self.control.write(operator._replace(mode=mode)))
        ladder = await self._effect(mode)
        return (
            f"operator's mode {word(mode)}; the control PLC is in {word(Mode(ladder.mode))} "
            f"({word(Cause(ladder.cause))}) since {ladder.since * TICK_S:g} s"
        )

    async def _effect(self, wanted: OperatorMode) -> LadderStatus:
        """Return the ladder when it has followed, or what it is after a while: in lock-step it may wait for ticks."""
        expected = {OperatorMode.MANUAL: {Mode.MANUAL}, OperatorMode.CLASSICAL: {Mode.CLASSICAL}}.get(
            wanted, {Mode.MPC, Mode.REST}
        )
        ladder = await self.control.read(LadderStatus)
        for _ in range(round(EFFECT_S / LOOK_S)):
            if ladder.mode in expected:
                break
            await asyncio.sleep(LOOK_S)
            ladder = await self.control.read(LadderStatus)
        return ladder

    async def set_setpoint(self, name: str, value: float) -> str:
        """Write a setpoint of manual mode; return what came back."""
        operator = await self.control.read(Operator)
        place = FIELDS[name]
        low, high = self._limits.low[place], self._limits.high[place]
        unit = INPUT_UNITS[place]
        if not low <= value <= high:
            raise UsageError(f"setpoint of {INPUT_NAMES[place]} = {value:g} {unit}: not from {low:g} to {high:g}")
        if operator.mode != OperatorMode.MANUAL:
            raise UsageError(
                f"the operator's mode is {word(OperatorMode(operator.mode))}: setpoints then follow what is applied; "
                "first `coldloop set mode manual`"
            )
        values = [value if i == place else present for i, present in enumerate(operator[1:])]
        await _asked(self.control.write(Operator(operator.mode, *values)))
        back = await self.control.read(Operator)
        return f"setpoint of {INPUT_NAMES[place]} {back[1 + place]:g} {unit} (was {operator[1 + place]:g} {unit})"

    # -- time ----------------------------------------------------------------------------------------------------------

    async def set_factor(self, factor: float) -> str:
        """Change how fast plant time goes; a session in lock-step changes over to real time."""
        pace = await self.plant.read(SessionPace)
        return await self._set_pace(pace._replace(realtime=1, factor=factor))

    async def set_paused(self, *, paused: bool) -> str:
        """Pause or resume plant time."""
        pace = await self.plant.read(SessionPace)
        if not pace.realtime:
            raise UsageError("the session is in lock-step: it goes as far as it is granted")
        return await self._set_pace(pace._replace(paused=int(paused)))

    async def _set_pace(self, pace: SessionPace) -> str:
        if not 0.01 <= pace.factor <= 10_000:
            raise UsageError(f"factor {pace.factor:g}: not from 0.01 to 10000")
        await write_pace((self.plant, self.control, self.optimizer), pace)
        back, tick = await self.plant.read(SessionPace), (await self.plant.read(Identity)).tick
        state = "paused" if back.paused else "real time"
        return f"{state} at {tick * TICK_S:g} s, factor {back.factor:g}"

    # -- alarms --------------------------------------------------------------------------------------------------------

    async def acknowledge(self, name: str | None) -> str:
        """Acknowledge an alarm or all of them; return which ones are left."""
        kinds = {kind.name.lower().replace("_", "-"): kind for kind in AlarmKind}
        if name is not None and name not in kinds:
            raise UsageError(f"no alarm is called '{name}'; there are {', '.join(kinds)}")
        number = ALL_ALARMS if name is None else int(kinds[name])
        before = await self._unacknowledged()
        await _asked(self.control.write(AlarmCommand(number, AlarmAction.ACKNOWLEDGE, 0)))
        left = await self._unacknowledged()
        done = [each for each in before if each not in left]
        return f"acknowledged: {', '.join(done) or 'none'}; not acknowledged: {', '.join(left) or 'none'}"

    async def _unacknowledged(self) -> list[str]:
        rows = await self.control.read_rows(Alarm, 0, len(AlarmKind))
        wanted = (AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED)
        return [word(kind) for kind, row in zip(AlarmKind, rows, strict=True) if row.state in wanted]


LEAD_TICKS: Final = 8
"""A load that is to begin now begins so many ticks later, so that it is there in time."""


async def write_pace(clients: tuple[RegisterClient, ...], pace: SessionPace) -> None:
    """Write the time base of a session: the plant first, then those who follow it. An optimiser may be in none yet.

    Raises:
        LinkError: The plant or the control PLC refuses, or does not answer.
    """
    plant, control, optimizer = clients
    await _asked(plant.write(pace))
    await _asked(control.write(pace))
    if (await optimizer.read(Identity)).session == (await plant.read(Identity)).session:
        await _asked(optimizer.write(pace))


async def _asked(request: Awaitable[T]) -> T:
    """Return the answer; a refusal is put into words."""
    try:
        return await request
    except RequestRefusedError as error:
        hint = HINTS.get(error.exception_code)
        raise LinkError(f"{error}: {hint}" if hint else str(error)) from None
