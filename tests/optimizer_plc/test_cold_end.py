"""CV155 is not opened further where that cools less: the helium before it is then warmer than the bath, T2 above T1."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import T1, T2
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.decisions import limit_of_feed, most_open
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.scheme import Constants, problem_at
from coldloop_optimizer_plc.settings import Preset, ProgramSettings

pytestmark = pytest.mark.usefixtures("compiles")  # these kernels are called by others alone

LIMITS = InputLimits()


def constants(model: LtiModel, **settings: object) -> Constants:
    """Return what an optimiser computes with."""
    return OptimizerProgram(model, ProgramSettings.model_validate(settings), LIMITS).constants


@pytest.fixture(scope="module")
def tuned(model: LtiModel) -> Constants:
    return constants(model)


def limit(c: Constants, cv155: float, approach: float) -> float:
    """Return the limit of CV155, %, at an opening of CV155 and T2 - T1."""
    u0 = c.estimator.u0
    return float(u0[0] + c.input_scale[0] * most_open(c, np.array([cv155, *u0[1:]]) - u0, approach))


@pytest.mark.parametrize(
    ("cv155", "approach", "most"),
    [(55.0, 0.3, 55.0), (55.0, 0.35, 51.5), (55.0, 0.2, 62.0), (25.0, 0.0, 50.0), (55.0, 2.0, 50.0), (20.0, 9.0, 50.0)],
)
def test_it_is_70_per_cent_for_each_kelvin_from_0_3_and_never_below_50_per_cent(
    tuned: Constants, cv155: float, approach: float, most: float
) -> None:
    assert limit(tuned, cv155, approach) == pytest.approx(most)


def followed(program: OptimizerProgram, readings: dict[int, float], ticks: int, times: int = 1) -> float:
    """Return the limit of CV155, %, with CV155 at 55 %, after so many updates with these readings over y0 (K)."""
    c, m = program.constants, program.state
    y = np.array(c.estimator.y0)
    m.u[:] = np.array([55.0, *c.estimator.u0[1:]]) - c.estimator.u0
    for output, reading in readings.items():
        y[output] += reading
    for _ in range(times):
        m.belief.numbers["since"] = ticks
        m.numbers["most_open"] = limit_of_feed(c, m, y)
    return float(c.estimator.u0[0] + c.input_scale[0] * m.numbers["most_open"][0])


def program_with(model: LtiModel, estimated: float, **settings: object) -> OptimizerProgram:
    """Return a program whose limit was 55 %, and that believes T2 to be so much warmer than the model says (K)."""
    program = OptimizerProgram(model, ProgramSettings.model_validate(settings), LIMITS)
    c, m = program.constants, program.state
    m.numbers["most_open"], m.numbers["planned"] = (55.0 - c.estimator.u0[0]) / c.input_scale[0], True
    m.belief.x[c.estimator.plausible.constants[T2]] = estimated
    return program


@pytest.mark.usefixtures("compiles")
def test_the_limit_goes_by_the_estimate_whatever_the_readings_show(model: LtiModel) -> None:
    approach = float(model.y0[T2] - model.y0[T1])
    for reading in (0.0, 0.5, math.nan):
        program = program_with(model, 0.33 - approach)
        assert followed(program, {T2: reading}, 240) == pytest.approx(55.0 - 70.0 * 0.03), "after a time constant"


@pytest.mark.usefixtures("compiles")
def test_the_limit_follows_with_its_time_constant_so_that_noise_moves_it_little(model: LtiModel) -> None:
    approach = float(model.y0[T2] - model.y0[T1])
    program = program_with(model, 0.27 - approach)
    assert followed(program, {}, 4) == pytest.approx(55.0 + 70.0 * 0.03 / 60.0)


@pytest.mark.usefixtures("compiles")
def test_readings_count_where_no_constant_is_estimated_and_the_model_where_they_are_left_out(model: LtiModel) -> None:
    settings = {"kind": "state-feedback"}
    program = OptimizerProgram(model, ProgramSettings.model_validate({"estimator": settings}), LIMITS)
    approach = float(model.y0[T2] - model.y0[T1])
    assert followed(program, {T2: 0.33 - approach}, 240) == pytest.approx(55.0 - 70.0 * 0.03)
    assert followed(program, {T2: 0.25 - approach}, 240) == pytest.approx(55.0 + 70.0 * 0.05)
    assert followed(program, {T2: math.nan}, 240) == pytest.approx(55.0 + 70.0 * (0.3 - approach))


def test_the_paper_has_no_such_limit(model: LtiModel) -> None:
    c = constants(model, preset=Preset.PAPER)
    assert limit(c, 60.0, 50.0) == math.inf


@given(before=st.floats(20.0, 60.0), most=st.floats(50.0, 80.0), share=st.floats(0.05, 1.0))
def test_all_knots_are_within_the_limit_or_within_the_rate_of_it(
    tuned: Constants, before: float, most: float, share: float
) -> None:
    u0, scale, rate = float(tuned.estimator.u0[0]), float(tuned.input_scale[0]), LIMITS.rate[0] * share
    x, u_before = np.zeros(tuned.estimator.steps.A.shape[1]), np.array([before - u0, 0.0, 0.0])
    free = problem_at(tuned, x, 0.0, u_before, share, np.zeros(3), math.inf, -1)
    limited = problem_at(tuned, x, 0.0, u_before, share, np.zeros(3), (most - u0) / scale, -1)
    of_cv155 = np.zeros(free.high.size, bool)
    of_cv155[: tuned.n_inputs : 3] = True
    highest = u0 + scale * limited.high[of_cv155]
    assert (highest <= max(most, before - rate) + 1e-9).all()
    assert (limited.low <= limited.high).all()
    assert (limited.high <= free.high).all()
    assert (limited.high[~of_cv155] == free.high[~of_cv155]).all()
    if most >= LIMITS.high[0]:
        assert (limited.high == free.high).all()
