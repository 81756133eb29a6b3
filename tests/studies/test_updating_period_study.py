"""What the study of the updating period makes of outcomes, computed by hand."""

from typing import TYPE_CHECKING

import pytest

from rig.studies import STUDIES
from rig.studies.study import StudyOptions
from rig.studies.updating_period import FEW, POLICIES

if TYPE_CHECKING:
    from pathlib import Path

    from tests.studies.conftest import MakeOutcome

NAMES = [policy.label for policy in POLICIES]


@pytest.fixture
def two_hours(tmp_path: "Path") -> StudyOptions:
    """Two loads, three fixed periods, and the rules."""
    files = [tmp_path / f"{name}.csv" for name in ("one", "two")]
    for file in files:
        file.write_text("time_s,load_w\n0,385\n100,445\n")
    return StudyOptions(loads=tuple(map(str, files)), quick=True)


def test_rules_are_judged_against_the_fixed_periods_of_their_hour(
    two_hours: StudyOptions, made_up: "MakeOutcome"
) -> None:
    """1, 2.5 and 5 s cost 4, 2 and 6 in the first hour, and 1, 2 and 3 in the second, where no optimum is inside."""
    assert FEW == (1.0, 2.5, 5.0)
    assert NAMES[0] == "Algorithm 1"
    open_loop = [4, 2, 6, 1.9, 2.1, 4.1, 2.03, 2.5, 1, 2, 3, 1.01, 1.5, 0.8, 2.5, 1.0]
    closed = [10, 20, 30, 11, 8, 9, 10, 10, 6, 5, 8, 4, 5, 6, 7, 8]
    empty = {"tick": [], "tau_u": [], "j_effective": [], "j_hot_start": [], "j_delivered": []}
    runs = [made_up(empty, J_open_mean=one, J_BF=other) for one, other in zip(open_loop, closed, strict=True)]
    study = STUDIES["updating-period"]
    values = study.evaluate(two_hours, dict(zip(study.requests(two_hours), runs, strict=True))).values
    assert values["interior optimum from 1 to 5 s, share of hours"] == [0.5]
    assert values["worst end over best from 1 to 5 s, smallest of hours"] == [3.0], "6 / 2 and 3 / 1"
    # means of the fixed periods: 4 and 2; the best: 2 and 1
    literal = {
        name.removesuffix(": Algorithm 1, hours"): found for name, found in values.items() if "Algorithm 1, h" in name
    }
    assert literal == {
        "better than the mean fixed period, share": [1.0],
        "best of all, share": [0.5],
        "within 2 % of the best fixed period, share": [1.0],
        "cost over that of the best fixed period, geometric mean": [pytest.approx((0.95 * 1.01) ** 0.5)],
        "J_BF over that of fixed 2.5 s, all together": [pytest.approx(15 / 25)],
        "J_BF over that of the best fixed period, geometric mean": [pytest.approx((1.1 * 0.8) ** 0.5)],
    }
    own = "contraction rule, interrupt, hours"
    assert values[f"better than the mean fixed period, share: {own}"] == [0.5], "4.1 is above 4"
    assert values[f"within 2 % of the best fixed period, share: {own}"] == [0.5]
    assert values[f"best of all, share: {own}"] == [0.5]
    assert values[f"J_BF over that of fixed 2.5 s, all together: {own}"] == [15 / 25]
    control = "fixed 2.5 s, interrupt, hours"
    assert values[f"within 2 % of the best fixed period, share: {control}"] == [0.5], "2.03 is within 2 % of 2"
