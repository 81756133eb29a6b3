import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.problem import interpolation, shift

KNOTS = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 50.0, 100.0])

Array = NDArray[np.float64]

knot_sets = st.lists(st.integers(1, 120), min_size=2, max_size=9, unique=True).map(
    lambda knots: np.array(sorted(knots), float)
)


@given(knots=knot_sets, by=st.floats(0.0, 50.0))
def test_a_shifted_value_is_an_average_of_the_old_ones(knots: Array, by: float) -> None:
    S = shift(knots, by)
    assert (S >= 0).all()
    assert S.sum(axis=1) == pytest.approx(np.ones(len(knots)), rel=1e-12)


@given(values=st.lists(st.floats(-100, 100), min_size=7, max_size=7), by=st.floats(0.0, 120.0))
def test_a_shifted_knot_reads_the_old_profile_later_and_the_last_value_behind_the_horizon(
    values: list[float], by: float
) -> None:
    expected = np.interp(KNOTS + by, KNOTS, values)
    assert shift(KNOTS, by) @ np.array(values) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_profile_is_constant_before_its_first_knot_and_meets_each_knot() -> None:
    W = interpolation(np.array([3.0, 5.0, 9.0]), np.array([1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 9.0, 12.0]))
    assert W.tolist() == [
        [1, 0, 0],
        [1, 0, 0],
        [1, 0, 0],
        [0.5, 0.5, 0],
        [0, 1, 0],
        [0, 0.5, 0.5],
        [0, 0, 1],
        [0, 0, 1],
    ]
