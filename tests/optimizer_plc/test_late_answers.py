"""Answers that come late by the clock: the PLC's budget is not what machine and link really take."""

from typing import Any

import numpy as np
import pytest

from coldloop.process.cold_box import TICK_S, TICKS_PER_SAMPLE
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Update, Verdict
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.decisions import PROVEN
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.scheme import shortest_sequence
from coldloop_optimizer_plc.settings import ProgramSettings


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
    shorter = []
    for _ in range(4 * PROVEN):
        program.answered(late=False)
        shorter.append(period(program, model) - usual)
    assert shorter == [*[4] * (PROVEN - 1), *[2] * PROVEN, *[1] * PROVEN, *[0] * (PROVEN + 1)]


def test_where_a_tick_is_needed_for_good_few_answers_are_late(program: OptimizerProgram, model: LtiModel) -> None:
    program.restart(0.0)
    usual, late = period(program, model), []
    for _ in range(90):
        late.append(period(program, model) == usual)
        program.answered(late=late[-1])
    assert sum(late) == 10


def test_no_period_is_longer_than_the_longest(program: OptimizerProgram, model: LtiModel) -> None:
    program.restart(0.0)
    for _ in range(20):
        period(program, model)
        program.answered(late=True)
    assert period(program, model) == TICKS_PER_SAMPLE
    program.restart(0.0)
    assert period(program, model) < TICKS_PER_SAMPLE, "a session begins without"


@pytest.mark.parametrize("fixed_s", [0.0, 5.0])
def test_where_a_period_cannot_grow_an_answer_comes_sooner(model: LtiModel, fixed_s: float) -> None:
    """At the longest period, too, an optimiser that is late is in time in the end: there are fewer iterations."""
    longest = {"adaptive": {"q_first": 19, "q_min": 19, "q_max": 19}}
    program = OptimizerProgram(model, ProgramSettings.model_validate(longest), InputLimits())
    program.restart(fixed_s)
    slack = []
    for _ in range(7):
        slack.append(period(program, model) * TICK_S - program.answer_after_s())
        program.solve()
        program.answered(late=True)
    assert slack[0] < 0.25, "no time for machine and link"
    assert slack == sorted(slack)
    assert slack[-1] > 4.0
    assert program.report(Verdict.LATE).iterations >= 1


def test_a_fixed_period_is_fixed(program: OptimizerProgram, model: LtiModel) -> None:
    program.restart(2.5)
    program.answered(late=True)
    assert period(program, model) == 10


def test_while_others_drive_the_guess_is_where_they_have_led_the_inputs(
    program: OptimizerProgram, model: LtiModel
) -> None:
    """Nothing of ours is played: update after update finds the inputs elsewhere."""
    program.restart(0.0)
    u0, y, x = (tuple(values.tolist()) for values in (model.u0, model.y0, model.x0))
    for number in range(4):
        u = (u0[0], u0[1], u0[2] + 0.125 * number)
        program.plan(Update(1, number, 10_000 + 20 * number, 0, load=model.w0, u_before=u, u=u, y=y, x=x))
        deviation = np.array(u) - model.u0
        np.testing.assert_allclose(program.state.playing.z, program.problem.hold(deviation), atol=1e-12)
        np.testing.assert_allclose(program.state.playing.u_before, deviation, atol=1e-12)
        program.solve()


@pytest.mark.parametrize(
    ("settings", "rows"),
    [
        ({}, 18),
        ({"interrupting_load_step_w": 10.0}, 39),
        ({"interrupting_load_step_w": 10.0, "sequence_ticks": 240}, 240),
        ({"adaptive": {"rule": "contraction"}}, 18),
        ({"adaptive": {"rule": "contraction"}, "budget": {"power": 0.5}}, 18),
        ({"adaptive": {"rule": "algorithm-1", "delta": 10, "q_first": 1, "q_min": 1}, "budget": {"power": 0.5}}, 20),
    ],
)
def test_a_sequence_lasts_until_the_next_one_can_arrive(settings: dict[str, Any], rows: int) -> None:
    given = ProgramSettings.model_validate(settings)
    assert shortest_sequence(given, PlcBudget(given.budget, 0.25)) == rows
