"""What a rig that is up is doing, read over Modbus."""

from typing import Final, NamedTuple

from coldloop.number_text import value_text
from coldloop.operating.execution import Clients
from coldloop.operating.rings import last_update
from coldloop.process.load_profile import LOAD_UNIT
from coldloop.process.signals import CONTROLLED, OUTPUT_NAMES, OUTPUT_UNITS, TICK_S
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import Cause, LadderStatus, Mode, Operator, OperatorMode, Process
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import LoadStatus
from coldloop.registers.safety import Alarm, AlarmKind, AlarmState
from coldloop.service.event_text import alarm_cause, alarm_word, word_of

QUIET: Final = (AlarmState.NORMAL, AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE)


class RigStatus(NamedTuple):
    """One look at the services of a rig."""

    plant: Identity
    pace: SessionPace
    ladder: LadderStatus
    operator: Operator
    process: Process
    load: LoadStatus
    update: Optimization | None
    """The last one that was done; None before the first, and of an optimiser that is not ours."""
    alarms: tuple[str, ...]


async def read_status(clients: Clients) -> RigStatus:
    """Return the state of a rig.

    Raises:
        LinkError: A service does not answer.
    """
    plant, control, optimizer = clients["plant"], clients["control_plc"], clients.get("optimizer_plc")
    update = None if optimizer is None else await last_update(optimizer, await optimizer.read(Identity))
    rows = await control.read_rows(Alarm, 0, len(AlarmKind))
    alarms = tuple(_alarm(kind, row) for kind, row in zip(AlarmKind, rows, strict=True) if row.state not in QUIET)
    return RigStatus(
        plant=await plant.read(Identity),
        pace=await plant.read(SessionPace),
        ladder=await control.read(LadderStatus),
        operator=await control.read(Operator),
        process=await control.read(Process),
        load=await plant.read(LoadStatus),
        update=update,
        alarms=alarms,
    )


def _alarm(kind: AlarmKind, row: Alarm) -> str:
    cause = alarm_cause(kind, row.cause)
    state = word_of(AlarmState, row.state)
    return f"{alarm_word(kind)}{f' ({cause})' if cause else ''}, {state}"


def _pace(status: RigStatus) -> str:
    pace = status.pace
    if not status.plant.session:
        return "no session"
    if not pace.realtime:
        return "lock-step"
    return f"paused (factor {value_text(pace.factor)})" if pace.paused else f"{value_text(pace.factor)} x real time"


def _tau_u(status: RigStatus) -> str:
    return "-" if status.update is None else f"{status.update.tau_u * TICK_S:g} s"


def page(status: RigStatus) -> str:
    """Return the state as a page."""
    ladder, load, y = status.ladder, status.load, status.process.y
    known = any(y)  # a control PLC that was started again shows nothing before its first scan
    then = value_text(load.next_watts, LOAD_UNIT)
    following = f", {then} from {load.next_tick * TICK_S:g} s" if load.upcoming else ""
    rows = [
        ("session", f"{status.plant.session}, {_pace(status)}, {status.plant.tick * TICK_S:.2f} s"),
        ("mode", f"{word_of(Mode, ladder.mode)} ({word_of(Cause, ladder.cause)}) since {ladder.since * TICK_S:g} s"),
        ("operator", word_of(OperatorMode, status.operator.mode)),
        ("load", f"{value_text(load.watts, LOAD_UNIT)}{following}"),
        *((OUTPUT_NAMES[i], f"{y[i]:.3f} {OUTPUT_UNITS[i]}" if known else "-") for i in CONTROLLED),
        ("tau_u", _tau_u(status)),
        ("alarms", "; ".join(status.alarms) or "none"),
    ]  # fmt: skip
    return "".join(f"{name:8} {text}\n" for name, text in rows)


def line(status: RigStatus) -> str:
    """Return the state as one line."""
    y = status.process.y
    outputs = "  ".join(f"{OUTPUT_NAMES[i]} {y[i]:6.2f} {OUTPUT_UNITS[i]}" for i in CONTROLLED)
    load = f"{status.load.watts:6.1f} {LOAD_UNIT}"
    return (
        f"{status.plant.tick * TICK_S:10.2f} s  {word_of(Mode, status.ladder.mode):9}  {load}  "
        f"{outputs}  tau_u {_tau_u(status):>6}  "
        f"{'; '.join(status.alarms) or 'no alarms'}"
    )
