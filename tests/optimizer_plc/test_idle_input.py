"""An input that has lost its effect: CV156 while the turbine stands, for all that speed and pressures say."""

import numpy as np
import pytest

from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES, V1
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Plan, Update
from coldloop.safety.writers import InputSequence
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName

P5, P6, T5 = (OUTPUT_NAMES.index(name) for name in ("P5", "P6", "T5"))
CV156 = INPUT_NAMES.index("CV156")
BIT = 1 << len(OUTPUT_NAMES) + CV156
STANDS = {V1: 0.0, P5: 1.03, P6: 1.04, T5: 18.0}
"""Readings of a turbine that has tripped."""


def answer(program: OptimizerProgram, model: LtiModel, readings: dict[int, float]) -> tuple[Plan, InputSequence]:
    """Return plan and sequence for an update with these readings, the others as at the operating point."""
    y = model.y0.copy()
    for output, value in readings.items():
        y[output] = value
    u = tuple(model.u0.tolist())
    update = Update(1, 0, 0, 0, load=model.w0 + 40.0, u_before=u, u=u, y=tuple(y.tolist()), x=tuple(model.x0.tolist()))
    plan = program.plan(update)
    return plan, program.solve()


def moves(sequence: InputSequence, model: LtiModel) -> np.ndarray:
    """Return by how much each input leaves where it is."""
    return np.abs(np.array(sequence.rows) - model.u0).max(axis=0)


@pytest.mark.parametrize("solver", [SolverName.ODE, SolverName.INTERIOR_POINT])
def test_the_valve_of_a_turbine_that_stands_is_left_where_it_is(model: LtiModel, solver: SolverName) -> None:
    program = OptimizerProgram(model, ProgramSettings(solver=solver), InputLimits())
    program.restart(5.0)
    plan, sequence = answer(program, model, STANDS)
    assert plan.suspects & BIT
    assert moves(sequence, model)[CV156] < 1e-5
    assert moves(sequence, model).max() > 0.1, "the others go on"
    program.restart(5.0)
    plan, sequence = answer(program, model, {T5: 18.0})
    assert not plan.suspects & BIT, "it comes back by itself"
    assert moves(sequence, model)[CV156] > 0.01


@pytest.mark.parametrize("readings", [{V1: 0.0}, {P6: 1.0}, {V1: np.nan, P6: 1.0}, {V1: 0.0, P6: np.nan}])
def test_no_sensor_alone_says_that_the_turbine_stands(model: LtiModel, readings: dict[int, float]) -> None:
    program = OptimizerProgram(model, ProgramSettings(), InputLimits())
    program.restart(5.0)
    assert not answer(program, model, readings)[0].suspects & BIT


def test_the_target_leaves_it_where_it_is_too(model: LtiModel) -> None:
    program = OptimizerProgram(model, ProgramSettings(), InputLimits())
    program.restart(5.0)
    answer(program, model, STANDS)
    assert program.state.target[CV156] == pytest.approx(0.0, abs=1e-6)
