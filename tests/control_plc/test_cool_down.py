"""The cool-down of a cold box: which step follows which, what each asks for, and that the optimiser stays out."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import L1, OUTPUT_NAMES, T1, T5
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Cause, CoolDownStep, Mode, Operator, OperatorMode
from coldloop_control_plc.program import ControlProgram, OperatingPoint
from coldloop_control_plc.scan import choose, cool, follow_cool_down, want
from coldloop_control_plc.settings import ControlSection, CoolDownSettings
from tests.harness.records import Row

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

INPUTS = (43.0, 75.0, 36.0)
BY_LOOPS = Row(50.0, 20.0, 30.0)


def outputs(level: float, bath: float, exhaust: float) -> list[float]:
    y = [0.0] * len(OUTPUT_NAMES)
    y[L1], y[T1], y[T5] = level, bath, exhaust
    return y


class CoolDown:
    """The cool-down alone."""

    def __init__(self) -> None:
        point = OperatingPoint(INPUTS, tuple(outputs(60.0, 4.44, 10.4)), 0)
        section = ControlSection(cool_down=CoolDownSettings(settled_s=10.0))
        program = ControlProgram(limits=InputLimits(), point=point, section=section)
        self._constants, self.scan = program.scan_constants, program.scan

    def observe(self, tick: int, y: list[float]) -> bool:
        self.scan.sensors.good[:] = y
        return follow_cool_down(self._constants, self.scan, tick)

    @property
    def step(self) -> CoolDownStep:
        return CoolDownStep(self.scan.ladder.step)

    @property
    def is_active(self) -> bool:
        return self.step is not CoolDownStep.FINISHED

    @property
    def standing(self) -> list[int]:
        return [output for output, stands in enumerate(self.scan.sensors.standing) if stands]

    def wanted(self, by_loops: Row) -> tuple[float, ...]:
        want(self.scan.ladder, by_loops)
        cool(self._constants, self.scan.ladder)
        return tuple(self.scan.ladder.wanted)

    def mode(self, operator: OperatorMode) -> tuple[int, int]:
        self.scan.ladder.operator = operator
        return choose(self._constants, self.scan, 1, plays=True)


def test_a_cold_plant_is_not_cooled_down_even_if_its_bath_runs_dry_later() -> None:
    sequence = CoolDown()
    assert not sequence.observe(0, outputs(60.0, 4.44, 10.4))
    assert not sequence.observe(1, outputs(0.0, 250.0, 200.0))
    assert not sequence.is_active
    assert not sequence.standing


@pytest.mark.parametrize("lying", [outputs(60.0, 290.0, 10.4), outputs(0.0, 4.44, 10.4)], ids=["T1", "L1"])
def test_one_sensor_that_lies_does_not_have_a_cold_plant_cooled_down(lying: list[float]) -> None:
    sequence = CoolDown()
    assert not sequence.observe(0, lying)
    assert not sequence.is_active


def test_a_warm_plant_goes_through_the_steps_in_their_order_and_each_has_its_inputs() -> None:
    sequence = CoolDown()
    courses = (
        (0, outputs(0.0, 300.0, 300.0), CoolDownStep.TURBINE, (60.0, 0.0, 36.0)),
        (1, outputs(0.0, 250.0, 10.3), CoolDownStep.BATH, (60.0, 0.0, 30.0)),
        (2, outputs(1.1, 4.4, 12.0), CoolDownStep.FILLING, (43.0, 0.0, 30.0)),
        (3, outputs(59.1, 4.4, 12.0), CoolDownStep.SETTLING, (43.0, 20.0, 30.0)),
    )
    for tick, y, step, wanted in courses:
        assert sequence.observe(tick, y)
        assert sequence.step is step
        assert tuple(sequence.wanted(BY_LOOPS)) == wanted
    assert L1 not in sequence.standing


def test_it_ends_when_both_outputs_have_stayed_in_their_bands() -> None:
    sequence, inside = CoolDown(), outputs(60.0, 4.44, 10.4)
    for tick, y in enumerate((outputs(0.0, 300.0, 300.0), outputs(0.0, 250.0, 10.0), outputs(2.0, 4.4, 10.0), inside)):
        sequence.observe(tick, y)
    for tick in range(4, 30):
        sequence.observe(tick, inside)
    sequence.observe(30, outputs(61.2, 4.44, 10.4))
    for tick in range(31, 71):
        sequence.observe(tick, inside)
        assert sequence.is_active
    assert sequence.observe(71, inside)
    assert not sequence.is_active


@pytest.mark.parametrize("operator", OperatorMode)
def test_while_it_lasts_the_ladder_is_classical_unless_an_operator_drives(operator: OperatorMode) -> None:
    sequence = CoolDown()
    assert sequence.observe(0, outputs(0.0, 300.0, 300.0))
    chosen = {
        OperatorMode.AUTO: (Mode.CLASSICAL, Cause.COOL_DOWN),
        OperatorMode.CLASSICAL: (Mode.CLASSICAL, Cause.OPERATOR),
        OperatorMode.MANUAL: (Mode.MANUAL, Cause.OPERATOR),
    }
    assert sequence.mode(operator) == chosen[operator]


@pytest.mark.parametrize("reached", [CoolDownStep.FILLING, CoolDownStep.SETTLING])
def test_a_control_plc_that_is_restarted_goes_on_from_the_step_it_had_reached(
    reached: CoolDownStep, new_bench: "Callable[[InputLimits], Bench]"
) -> None:
    """Once one that was restarted while the bath filled invited the optimiser."""
    bench = new_bench(InputLimits())
    bench.steady = True
    program, applied = bench.program, Row(*INPUTS)
    program.resume(1, 500, applied, updates=0, operator=Operator(OperatorMode.AUTO, tuple(applied)), cool_down=reached)
    bench.readings = {L1: 30.0}
    bench.scans(5)
    assert program.cool_down is reached
    assert (program.mode, program.ladder.cause) == (Mode.CLASSICAL, Cause.COOL_DOWN)
    assert not program.player.invited
    bench.readings = {}
    bench.scans(4 * 620)
    assert program.cool_down is CoolDownStep.FINISHED
    assert program.player.invited
