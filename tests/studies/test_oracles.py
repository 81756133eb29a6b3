"""What the studies of oracles and robustness make of their runs, against cases done by hand."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from rig.results.indicators import Indicators
from rig.studies.beyond.oracles import (
    BEST,
    FAST,
    FASTEST,
    LITERAL,
    OWN,
    SEARCHED,
    WAYS,
    OraclesStudy,
    cost_table,
    shares_of_gap,
    verdict,
    worst,
)
from rig.studies.beyond.robustness import POLICIES, REFERENCE, RULE_CONDITIONS, RobustnessStudy, ratio_table
from rig.studies.hindsight import Objective
from rig.studies.request import Outcome
from rig.studies.study import StudyOptions

if TYPE_CHECKING:
    from tests.studies.conftest import Conducted


def outcome(closed: float, opened: float) -> Outcome:
    nothing = Indicators(*[0] * len(Indicators._fields))
    indicators = nothing._replace(J_open_mean=opened, J_BF=closed)
    return Outcome("", indicators, "", 0, {}, {})


def hour(**costs: tuple[float, float]) -> dict[str, Outcome]:
    """An hour in which everything costs 64, but for what is named: J_BF and open loop."""
    usual = {name: outcome(64.0, 64.0) for name in WAYS}
    return usual | {name: outcome(*pair) for name, pair in costs.items()}


CLOSED, OPEN = Objective.CLOSED_LOOP, Objective.OPEN_LOOP
HOURS = [
    hour(**{LITERAL: (16.0, 20.0), OWN[1]: (4.0, 10.0), SEARCHED[CLOSED]: (1.0, 9.0), SEARCHED[OPEN]: (9.0, 5.0)}),
    hour(**{LITERAL: (4.0, 20.0), OWN[1]: (5.0, 5.0), SEARCHED[CLOSED]: (2.0, 9.0), "fixed 1 s": (1.0, 40.0)}),
]


def test_the_best_sequence_is_the_least_of_all_in_each_hour() -> None:
    """In the second hour a fixed period beats the search, and for the open loop a rule does."""
    assert cost_table(HOURS, CLOSED)[BEST].tolist() == [1.0, 1.0]
    assert cost_table(HOURS, OPEN)[BEST].tolist() == [5.0, 5.0]
    assert cost_table(HOURS, CLOSED)[FASTEST].tolist() == [64.0, 64.0]


def test_shares_are_of_the_gap_to_the_best_sequence() -> None:
    """Closed loop: ln(16/4) + ln(4/5) of ln 16 + ln 4; open loop: ln(20/10) + ln(20/5) of 2 ln(20/5)."""
    closed, opened = (shares_of_gap(cost_table(HOURS, objective)) for objective in (CLOSED, OPEN))
    assert closed[LITERAL].value == 0.0
    assert closed[OWN[1]].value == pytest.approx((math.log(4) + math.log(0.8)) / (math.log(16) + math.log(4)))
    assert opened[OWN[1]].value == pytest.approx((math.log(2) + math.log(4)) / (2 * math.log(4)))


def test_the_verdict_names_who_closes_half_of_the_gap_and_the_worst_hour() -> None:
    closed, opened = cost_table(HOURS, CLOSED), cost_table(HOURS, OPEN)
    assert worst(closed, OWN[1]) == 1.25
    said = verdict("hours", CLOSED, closed, shares_of_gap(closed))
    assert "**No rule closes half of it.**" in said
    assert "Algorithm 1 costs 8.000" in said, "the geometric mean of 16 and 4"
    assert f"{OWN[1]} 0.28" in said
    assert "worst hour +25.0 %" in said
    assert f"Half of it is closed by: {OWN[1]}." in verdict("hours", OPEN, opened, shares_of_gap(opened))


def test_robustness_compares_under_the_same_condition() -> None:
    """Twice the reference in one hour and eight times in the other are four times; each condition has its own scale.

    Of two hours a factor of two from their mean, the interval is 12.7 such factors either way.
    """
    costs = {
        (condition, policy): scale * np.array([1.0, 1.0] if policy == REFERENCE else [2.0, 8.0])
        for scale, condition in enumerate(RULE_CONDITIONS, 1) for policy in POLICIES
    }  # fmt: skip
    ratios = ratio_table(costs)
    for row in ratios.values():
        assert row[REFERENCE] == pytest.approx((1.0, 1.0, 1.0))
        assert row["Algorithm 1"] == pytest.approx((4.0, 4.0 / 2**12.7062, 4.0 * 2**12.7062), rel=1e-4)


@pytest.mark.parametrize("study", [OraclesStudy(), RobustnessStudy()])
def test_the_whole_study_of_half_a_minute_has_a_row_for_each_run(
    study: OraclesStudy | RobustnessStudy, conducted: "Conducted", tmp_path: Path
) -> None:
    options = StudyOptions(seeds=1, ticks=120, loads=("e",))
    result = conducted(study, options)
    assert len(result.rows) == len(study.requests(options))
    assert len({row[-1] for row in result.rows}) > len(FAST), "runs differ"
    section = (tmp_path / study.name / "section.md").read_text()
    names = WAYS if study.name == "oracles" else RULE_CONDITIONS
    assert all(name in section for name in names if "search" not in name)
    assert len(list((tmp_path / study.name).glob("*.png"))) == len(result.figures) >= 2
