"""Requests of commands to a running rig over Modbus: its status, or writes with the role of an operator."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from contextlib import AsyncExitStack, nullcontext
from typing import Any, Final, NamedTuple

from coldloop.errors import LinkError, PeerUnreachableError, RequestRefusedError
from coldloop.operating import execution, observer
from coldloop.process.declaration import Process
from coldloop.registers import common, control_plc, optimizer_plc
from coldloop.registers.plant import LoadStatus
from coldloop.service.journal import alarm_cause, alarm_word
from coldloop.text import value_text
from coldloop_rig.cosim.wiring import RigEndpoints, answered_in_time
from coldloop_rig.text_tables import Colour, coloured

Work = Callable[[execution.Clients], Awaitable[str]]
QUIET: Final = (common.AlarmState.NORMAL, common.AlarmState.SHELVED, common.AlarmState.OUT_OF_SERVICE)


async def ask(rig: RigEndpoints, process: Process, services: Iterable[str], work: Work, *, limited: bool = True) -> str:
    """Connect to the services of a request, carry it out, and return the result.

    With `limited` it may not take longer than a rig takes to answer.

    Raises:
        LinkError: A service is not there, refuses, or answers too late.
        UsageError: It is not possible now.
    """
    clients = execution.clients_of({service: getattr(rig, service) for service in services}, process)
    async with AsyncExitStack() as stack:
        async with answered_in_time("to connect"):
            await stack.enter_async_context(execution.connected(clients))
        async with answered_in_time("the command") if limited else nullcontext():
            try:
                return await work(clients)
            except RequestRefusedError as error:
                raise LinkError(execution.reason_of(error)) from None


class PlantStatus(NamedTuple):
    """Status of the plant at one time."""

    identity: common.Identity
    pace: common.SessionPace
    load: LoadStatus


class ControlStatus(NamedTuple):
    """Status of the control PLC at one time."""

    ladder: control_plc.LadderStatus
    operator: control_plc.Operator
    y: tuple[float, ...]
    """Outputs of the last scan; all are 0 before the first."""
    alarms: tuple[str, ...]


class RigStatus(NamedTuple):
    """Status of the services of a rig at one time."""

    process: Process
    plant: PlantStatus | None
    """State of the plant; None if it does not answer, as with the fields below."""
    control: ControlStatus | None
    update: optimizer_plc.Optimization | None
    """The last one that was done; None before the first as well, and of an optimiser that is not ours."""
    silent: tuple[str, ...] = ()
    """Messages about the services that do not answer, one each."""


async def read_status(clients: execution.Clients) -> RigStatus:
    """Return the state of a rig, of which some services may be away.

    Raises:
        LinkError: Neither the plant nor the control PLC answers, or an answer is not possible.
    """
    readers = {"plant": _plant, "control_plc": _control, "optimizer_plc": observer.last_update}
    names = [name for name in readers if name in clients]
    answers = await asyncio.gather(*(_answer(readers[name], clients[name]) for name in names))
    found: dict[str, Any] = dict(zip(names, answers, strict=True))
    absent = [answer for answer in answers if isinstance(answer, LinkError)]
    plant, control, update = (
        None if isinstance(found.get(name), LinkError) else found.get(name) for name in readers
    )  # fmt: skip
    if plant is None and control is None:
        raise absent[0]
    return RigStatus(clients[names[0]].process, plant, control, update, tuple(map(str, absent)))


async def _answer(read: Callable[[execution.CommandClient], Awaitable[Any]], client: execution.CommandClient) -> Any:  # noqa: ANN401 any
    try:
        async with answered_in_time("to read the status"):
            await client.connect(0.0)
            return await read(client)
    except PeerUnreachableError as error:
        return error


async def _plant(client: execution.CommandClient) -> PlantStatus:
    return PlantStatus(
        await client.read(common.Identity), await client.read(common.SessionPace), await client.read(LoadStatus)
    )


async def _control(client: execution.CommandClient) -> ControlStatus:
    rows, process = await observer.read_alarms(client), client.process
    causes = [f" ({cause})" if (cause := alarm_cause(i, row.cause, process)) else "" for i, row in enumerate(rows)]
    alarms = tuple(
        f"{alarm_word(i, process)}{causes[i]}, {common.AlarmState.word_of(row.state)}"
        for i, row in enumerate(rows)
        if row.state not in QUIET
    )
    y = (await client.read(control_plc.ProcessNow)).y
    return ControlStatus(
        await client.read(control_plc.LadderStatus), await client.read(control_plc.Operator), y, alarms
    )


def _pace(plant: PlantStatus) -> str:
    pace = plant.pace
    if not plant.identity.session:
        return "no session"
    if not pace.realtime:
        return "lock-step"
    return f"paused (factor {value_text(pace.factor)})" if pace.paused else f"{value_text(pace.factor)} x real time"


def _tau_u(status: RigStatus) -> str:
    return "-" if status.update is None else f"{status.update.tau_u * status.process.tick_s:g} s"


def colour(status: RigStatus) -> Colour:
    """Return the colour of a state: good is MPC without an alarm, failed is a service that does not answer."""
    if status.silent or status.control is None:
        return Colour.FAILED
    good = status.control.ladder.mode == control_plc.Mode.MPC and not status.control.alarms
    return Colour.GOOD if good else Colour.ATTENTION


def page(status: RigStatus) -> str:
    """Return the state as a page."""
    plant, control, process, tick_s = status.plant, status.control, status.process, status.process.tick_s
    rows = []
    if plant is not None:
        rows.append(("session", f"{plant.identity.session}, {_pace(plant)}, {plant.identity.tick * tick_s:.2f} s"))
    if control is not None:
        mode, cause = control_plc.Mode.word_of(control.ladder.mode), control_plc.Cause.word_of(control.ladder.cause)
        rows.append(("mode", f"{mode} ({cause}) since {control.ladder.since * tick_s:g} s"))
        rows.append(("operator", control_plc.OperatorMode.word_of(control.operator.mode)))
    if plant is not None and process.has_load:
        load, unit = plant.load, process.load.unit
        then = f", {value_text(load.next_watts, unit)} from {load.next_tick * tick_s:g} s" if load.upcoming else ""
        rows.append(("load", f"{value_text(load.watts, unit)}{then}"))
    if control is not None:
        known = any(control.y)  # a control PLC that was started again shows nothing before its first scan
        for i, one in zip(process.controlled, process.banded, strict=True):
            rows.append((one.name, f"{control.y[i]:.3f} {one.unit}" if known else "-"))
    rows.append(("tau_u", _tau_u(status)))
    if control is not None:
        rows.append(("alarms", "; ".join(control.alarms) or "none"))
    rows += [("absent", one) for one in status.silent]
    shown = {"mode": colour(status), "alarms": colour(status), "absent": Colour.FAILED}
    return "".join(f"{name:8} {coloured(text, shown[name]) if name in shown else text}\n" for name, text in rows)


def line(status: RigStatus) -> str:
    """Return the state as one line."""
    plant, control, process = status.plant, status.control, status.process
    parts = ["no plant  "] if plant is None else [f"{plant.identity.tick * process.tick_s:10.2f} s"]
    parts.append("no control PLC" if control is None else f"{control_plc.Mode.word_of(control.ladder.mode):9}")
    if plant is not None and process.has_load:
        parts.append(f"{plant.load.watts:6.1f} {process.load.unit}")
    if control is not None:
        bands = zip(process.controlled, process.banded, strict=True)
        parts += [f"{one.name} {control.y[i]:6.2f} {one.unit}" for i, one in bands]
    parts.append(f"tau_u {_tau_u(status):>6}")
    if control is not None:
        parts.append("; ".join(control.alarms) or "no alarms")
    return "  ".join((*parts, *status.silent))
