"""Whether an adaptive period pays: against the fixed one that other draws have shown to be the best."""

import numpy as np
import pytest

from coldloop.errors import StudyError
from coldloop_studies.any_process import judged

COSTS = np.array(
    [
        [1.0, 1.0, 4.0],  # adaptive
        [0.5, 2.0, 2.0],
        [0.9, 0.1, 0.1],  # best on the draws that are judged, which nobody could know
    ]
)


def test_the_best_fixed_period_is_chosen_on_some_draws_and_judged_on_the_others() -> None:
    best, ratio = judged(COSTS, np.array([True, False, False]))
    assert best == 1
    assert ratio.value == pytest.approx(1.0), "the geometric mean of 1/2 and 4/2"


def test_where_there_are_no_other_draws_it_is_judged_on_the_same() -> None:
    best, ratio = judged(COSTS, np.array([True, True, True]))
    assert best == 2
    assert ratio.value == pytest.approx((4.0 / 0.009) ** (1 / 3))


def test_loops_that_cost_nothing_cannot_be_compared() -> None:
    with pytest.raises(StudyError):
        judged(np.zeros((3, 2)), np.array([True, False]))
