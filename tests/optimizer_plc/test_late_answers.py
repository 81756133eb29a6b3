"""Answers that come late by the clock: the PLC's budget is not what machine and link really take."""

import pytest

from coldloop.process.limits import InputLimits
from coldloop.process.lti_model import LtiModel
from coldloop.registers.control_plc import Update
from optimizer_plc.budget import MAX_PERIOD_TICKS
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.settings import ProgramSettings


def period(program: OptimizerProgram, model: LtiModel) -> int:
    """Return the updating period, in ticks, that is planned for the first update of whoever begins again."""
    u, y, x = (tuple(values.tolist()) for values in (model.u0, model.y0, model.x0))
    return program.plan(Update(1, 0, 0, 1, load=model.w0, u_before=u, u=u, y=y, x=x)).next_update_tick


@pytest.fixture
def program(model: LtiModel) -> OptimizerProgram:
    return OptimizerProgram(model, ProgramSettings(), InputLimits())


def test_a_late_answer_is_followed_by_longer_periods_and_those_in_time_by_shorter_ones(
    program: OptimizerProgram, model: LtiModel
) -> None:
    program.restart(0.0)
    usual = period(program, model)
    longer = []
    for _ in range(3):
        program.answered(late=True)
        longer.append(period(program, model) - usual)
    assert longer == [1, 2, 4]
    for _ in range(4):
        program.answered(late=False)
    assert period(program, model) == usual
    program.answered(late=False)
    assert period(program, model) == usual


def test_no_period_is_longer_than_the_longest(program: OptimizerProgram, model: LtiModel) -> None:
    program.restart(0.0)
    for _ in range(20):
        program.answered(late=True)
    assert period(program, model) == MAX_PERIOD_TICKS
    program.restart(0.0)
    assert period(program, model) < MAX_PERIOD_TICKS, "a session begins without"


def test_a_fixed_period_is_fixed(program: OptimizerProgram, model: LtiModel) -> None:
    program.restart(2.5)
    program.answered(late=True)
    assert period(program, model) == 10
