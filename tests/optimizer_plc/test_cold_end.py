"""CV155 is not opened further where that cools less: the helium before it is then warmer than the bath, T2 above T1."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import T1, T2
from coldloop.process.limits import InputLimits
from coldloop.process.lti_model import LtiModel
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.qp.penalties import Preset
from optimizer_plc.scheme import Constants, most_open, problem_at
from optimizer_plc.settings import ProgramSettings

LIMITS = InputLimits()


def constants(model: LtiModel, **settings: object) -> Constants:
    """Return what an optimiser computes with."""
    return OptimizerProgram(model, ProgramSettings.model_validate(settings), LIMITS).constants


@pytest.fixture(scope="module")
def tuned(model: LtiModel) -> Constants:
    return constants(model)


def limit(c: Constants, cv155: float, approach: float) -> float:
    """Return the limit of CV155, %, at an opening of CV155 and T2 - T1."""
    y = np.array(c.estimator.y0)
    y[T2] = y[T1] + approach
    u0 = c.estimator.u0
    return float(u0[0] + c.input_scale[0] * most_open(c, np.array([cv155, *u0[1:]]) - u0, y))


@pytest.mark.parametrize(
    ("cv155", "approach", "most"),
    [(55.0, 0.3, 55.0), (55.0, 0.35, 51.5), (55.0, 0.2, 62.0), (25.0, 0.0, 50.0), (55.0, 2.0, 50.0), (20.0, 9.0, 50.0)],
)
def test_it_is_70_per_cent_for_each_kelvin_from_0_3_and_never_below_50_per_cent(
    tuned: Constants, cv155: float, approach: float, most: float
) -> None:
    assert limit(tuned, cv155, approach) == pytest.approx(most)


def test_a_temperature_that_is_not_measured_says_nothing_against_opening(tuned: Constants) -> None:
    assert limit(tuned, 55.0, math.nan) == pytest.approx(limit(tuned, 55.0, 0.0))


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
