"""Sets of decision and constraint instants: how they are spread, and which is proposed, by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.errors import StudyError
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.plc_sizing.intervals import over_best_fixed
from coldloop_studies.instants import Judged, candidates, drawn, losses, proposed, spread


@given(st.integers(1, 30), st.integers(1, 400))
def test_instants_rise_from_one_to_the_horizon(count: int, horizon: int) -> None:
    instants = spread(count, horizon)
    assert list(instants) == sorted(set(instants))
    assert 1 <= len(instants) <= min(count, horizon)
    assert instants[0] >= 1
    assert instants[-1] == (1 if count == 1 else horizon)


def test_instants_by_hand() -> None:
    assert spread(3, 100) == (1, 10, 100)
    assert spread(4, 4) == (1, 2, 3, 4)


def test_each_candidate_is_a_design_with_the_horizon_of_the_configured_one() -> None:
    found = candidates(ControlDesign())
    assert next(iter(found)) == "configured"
    assert all(design.horizon == 100 for design in found.values())
    assert [len(design.decision_instants) for design in found.values()][-1] == 24


def one(label: str, variables: int, *costs: float) -> Judged:
    return Judged(label, ControlDesign(), variables, 2 * variables, 1.0, 1.0, 1, 1000 // variables, costs)


SETS = [one("configured", 49, 100.0, 400.0), one("small", 14, 102.0, 408.0), one("middle", 28, 100.5, 402.0),
        one("fullest", 168, 100.0, 400.0)]  # fmt: skip


def test_the_smallest_set_that_loses_little_is_proposed() -> None:
    assert losses(SETS) == pytest.approx([1.0, 1.02, 1.005, 1.0])
    assert proposed(SETS).label == "middle"
    assert proposed([SETS[1], SETS[3]]).label == "fullest"


def test_the_figure_has_loss_and_iterations_and_names_the_set_that_is_proposed() -> None:
    loss, iterations = drawn(SETS, ["a", "b"]).axes
    curves = {line.get_label(): np.array(line.get_xydata()).tolist() for line in loss.lines}
    assert curves["load a"] == [[14.0, 1.02], [28.0, 1.005], [168.0, 1.0]]
    assert curves["proposed"][0] == pytest.approx([28.0, 1.005])
    assert np.array(iterations.lines[0].get_xydata()).tolist() == [[14.0, 71.0], [28.0, 35.0], [168.0, 5.0]]


def test_loops_that_cost_nothing_are_not_compared() -> None:
    with pytest.raises(StudyError, match="costs nothing"):
        over_best_fixed(np.array([[0.0, 3.0], [0.0, 2.0]]))
