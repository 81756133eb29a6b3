"""A control PLC on the bench: scans by hand, and sequences that are right unless told otherwise."""

from collections.abc import Callable, Sequence

import pytest

from coldloop.process.cold_box import L1, T5
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits
from coldloop.registers.common import AlarmKind, AlarmState
from coldloop.registers.control_plc import Acknowledgement, Plan, SequenceHeader, Update, Verdict
from coldloop.registers.plant import Actuators, Measurement
from coldloop.safety.writers import InputSequence, with_checksum
from coldloop_control_plc.program import ControlProgram, OperatingPoint
from coldloop_control_plc.settings import ControlSection
from tests.harness.records import Row, as_transmitted

MODEL = 0xC01D1005
HEADER = read_header(DEFAULT_MODEL_FILE)
INITIAL = Row(43.0, 75.0, 36.0)
HOLD_TICKS = 12
"""Of a hold that is short."""


def section(**changed: object) -> ControlSection:
    """Return settings with a short hold."""
    return ControlSection.model_validate({"ladder": {"hold_s": HOLD_TICKS / 4}, **changed})


class Bench:
    """A control program in its first session, driven scan by scan."""

    def __init__(self, limits: InputLimits, section: ControlSection | None = None) -> None:
        point = OperatingPoint(tuple(INITIAL), HEADER.y0, MODEL)
        self.program = ControlProgram(limits=limits, point=point, section=section or ControlSection())
        self.program.restart(session=1)
        self.number = 0
        self.load = 384.0
        self.shortage = 0.0
        """What the optimiser says of it."""
        self.suspects = 0
        self.steady = False
        """The process stands at its setpoints, moved by `level` and `temperature`; else the outputs count the ticks."""
        self.level = self.temperature = 0.0
        self.moving = False
        """Everything trembles about that."""
        self.frozen = False
        """Load and states stand still, too."""
        self.readings: dict[int, float] = {}
        """What single sensors show instead."""

    def scan(self) -> tuple[Row, Update | None]:
        """Do one scan; return what was applied and the update if one was latched."""
        actuators = self.program.begin_scan()
        return Row(*actuators.u), self.program.end_scan(self.measurement(actuators))

    def measurement(self, actuators: Actuators) -> Measurement:
        x = (0.0 if self.frozen else float(actuators.tick), *[float(i) for i in range(1, 28)])
        return Measurement(actuators.tick, self.load, self.outputs(), x, actuators.session, actuators.u)

    def outputs(self) -> tuple[float, ...]:
        tick = self.program.tick
        if not self.steady:
            return tuple(float(tick + i) for i in range(22))
        y = [value + (0.001 * (tick % 7) if self.moving else 0.0) for value in HEADER.y0]
        y[L1] += self.level
        y[T5] += self.temperature
        for output, reading in self.readings.items():
            y[output] = reading
        return tuple(y)

    def scans(self, number: int) -> list[Row]:
        return [self.scan()[0] for _ in range(number)]

    def plan(self, ticks: int, load_step: float = 0.0) -> bool:
        """Plan the next updating instant so many ticks after the last one, or at a load step."""
        update = self.program.player.update
        assert update is not None
        plan = Plan(update.update, update.tick + ticks, load_step, self.shortage, self.suspects)
        return self.program.accept_plan(plan)

    def sequence(self, rows: Sequence[Row], **changed: int) -> InputSequence:
        """Return an answer to the last update, with header fields changed before its checksum is taken."""
        update = self.program.player.update
        assert update is not None
        first = self.program.player.next_update_tick or 0
        self.number += 1
        header = SequenceHeader(
            number=self.number,
            update=update.update,
            first_tick=first,
            length=len(rows),
            tau_u=max(0, first - update.tick),
            model_digest=MODEL,
            crc=0,
        )
        return with_checksum(header._replace(**changed), [as_transmitted(row) for row in rows])

    def play(self, rows: Sequence[Row], ticks: int) -> list[Row]:
        """Plan an update `ticks` after the last one, answer it, and scan up to it; return what was applied."""
        assert self.plan(ticks)
        offered = self.offer(self.sequence(rows))
        assert offered.verdict == Verdict.ACCEPTED, Verdict(offered.verdict).name
        assert self.program.player.next_update_tick is not None
        return self.scans(self.program.player.next_update_tick - self.program.tick)

    def offer(self, sequence: InputSequence) -> Acknowledgement:
        return self.program.offer(sequence)


def alarm(bench: Bench, kind: AlarmKind) -> AlarmState:
    """Return the state of an alarm."""
    return AlarmState(bench.program.alarms.rows[kind].state)


def moved(cv155: float = 0.0, ncr22: float = 0.0, cv156: float = 0.0) -> Row:
    """Return the initial inputs, moved."""
    return Row(INITIAL.cv155 + cv155, INITIAL.ncr22 + ncr22, INITIAL.cv156 + cv156)


@pytest.fixture(scope="session")
def at() -> Callable[..., Row]:
    return moved


@pytest.fixture(scope="session")
def new_bench() -> Callable[[InputLimits], Bench]:
    return Bench


@pytest.fixture
def bench() -> Bench:
    """A control PLC whose first update (at tick 0) has been latched."""
    made = Bench(InputLimits())
    made.scan()
    return made


@pytest.fixture
def rig() -> Bench:
    """A control PLC with a short hold, whose first update has been latched; the process stands at its setpoints."""
    made = Bench(InputLimits(), section())
    made.steady = True
    made.scan()
    return made
