"""What a command is confirmed against: what it would change, read from the registers, as others may change it."""

from coldloop.number_text import value_text
from coldloop.operating import commands
from coldloop.operating.execution import Clients, check_manual
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import LadderStatus, Mode, Operator, OperatorMode
from coldloop.registers.plant import LoadStatus
from coldloop.service.event_text import word_of

Premises = dict[str, str]
"""Present values by what they are of, in words."""


async def read_premises(clients: Clients, command: commands.Command) -> Premises:
    """Read the premises of a command: of all the session, of one about an alarm or a sensor no more than that.

    Raises:
        LinkError: A service does not answer.
        UsageError: A setpoint, and another mode than manual.
    """
    found = {"session": str((await next(iter(clients.values())).read(Identity)).session)}
    match command:
        case commands.SetMode():
            mode = (await clients["control_plc"].read(LadderStatus)).mode
            found["operator's mode"] = word_of(OperatorMode, (await clients["control_plc"].read(Operator)).mode)
            found["active"] = word_of(Mode, Mode.MPC if mode == Mode.REST else mode)  # between two sequences
        case commands.SetSetpoint():
            operator = await check_manual(clients["control_plc"])
            found[f"setpoint of {command.input}"] = value_text(operator.u[command.place], command.unit)
        case commands.SetLoad() | commands.PlayLoad():
            load, process = await clients["plant"].read(LoadStatus), command.process
            until = f"changing until {commands.clock_text(load.last_tick * process.tick_s)}"  # by itself
            found[process.load.title] = until if load.upcoming else value_text(load.watts, process.load.unit)
        case commands.SetFactor() | commands.SetPaused():
            pace = await clients["plant"].read(SessionPace)
            running = f"{'paused, ' if pace.paused else ''}factor {value_text(pace.factor)}"
            found["plant time"] = running if pace.realtime else "lock-step"
    return found


def differences(before: Premises, now: Premises) -> str:
    """Return what has changed, in words; empty if nothing has."""
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return "; ".join(f"{name}: {before.get(name, 'not known')}, now {now.get(name, 'not known')}" for name in names)
