"""What the study of the updating period makes of outcomes, computed by hand."""

import math
from typing import TYPE_CHECKING

import pytest

from coldloop_studies.reproduction import STUDIES
from coldloop_studies.study import StudyOptions
from coldloop_studies.trajectories import held_periods, response, response_table
from coldloop_studies.updating_period import FEW, POLICIES

if TYPE_CHECKING:
    from pathlib import Path

    from coldloop_studies.request import Outcome
    from coldloop_studies.study import Load
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


# -- the response to load steps ---------------------------------------------------------------------------------------


@pytest.fixture
def responding(made_up: "MakeOutcome") -> "Outcome":
    """Periods of 1 s before the step at 100 s and of 1 s for the first one after it, then of 3 s, in quiet of 2 s.

    The step down at 400 s is followed by 5 s to the end, ten minutes in all.
    """
    periods = [(4, 400), (4, 404), (12, 524), (8, 1604), (20, 2404)]
    tick, tau = [0], []
    for period, until in periods:
        while tick[-1] < until:
            tau.append(period)
            tick.append(tick[-1] + period)
    return made_up({"tick": tick[:-1], "tau_u": tau, "j_effective": [2.0 * 1.01**k for k in range(len(tau))]})


def test_a_window_has_the_period_that_is_in_force_tick_by_tick(stepped: "Load", responding: "Outcome") -> None:
    held = held_periods([(responding, stepped)])
    assert len(held.tau_u_s) == 2404 - 400, "before the first load step there is nothing to respond to"
    # up: 1 s for 4 ticks, 3 s for the other 116 of 30 s; down: 2 s for 4 ticks that began before, 5 s for 116
    assert held.mean((0.0, 30.0)) == pytest.approx((4 * 1 + 116 * 3 + 4 * 2 + 116 * 5) / 240)
    assert held.mean((0.0, 1.0)) == 1.5
    # from 60 s on: 240 s up to the step down, all with 2 s, and 141 s with 5 s
    assert held.mean((60.0, math.inf)) == pytest.approx((960 * 2 + 564 * 5) / 1524)
    assert held.share_of_longest((60.0, math.inf)) == pytest.approx(564 / 1524)
    assert math.isnan(held.mean((301.0, math.inf))), "no tick is that far from a step"


def test_the_response_is_one_ratio_and_what_explains_it(stepped: "Load", responding: "Outcome") -> None:
    found = response([(responding, stepped)], "x")
    quiet, soon = (960 * 2 + 564 * 5) / 1524, (4 * 1 + 116 * 3 + 4 * 2 + 116 * 5) / 240
    assert found["tau_u 0 to 30 s after a load step over that in quiet, by time, x"] == pytest.approx(soon / quiet)
    assert found["tau_u in quiet (s), by time, x"] == pytest.approx(quiet)
    assert found["median of |K - 1| in quiet, x"] == pytest.approx(0.01)
    assert found["median of |K - 1| 0 to 30 s after a load step, x"] == pytest.approx(0.01)


def test_the_table_has_no_end_and_leaves_empty_what_there_is_not(stepped: "Load", responding: "Outcome") -> None:
    header, _, row = response_table({"x": [(responding, stepped)]}).splitlines()[2:]
    assert header.split(" | ")[-1] == "from 300 s on |"
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:2] == ["x", "3.00"], "1 s for 4 ticks and 3 s for 6; 2 s for 4 ticks and 5 s for 6"
    assert cells[-1] == ""


def test_the_two_hours_are_judged_by_their_hashes_bands_and_response(
    under: StudyOptions, stepped: "Load", responding: "Outcome", made_up: "MakeOutcome"
) -> None:
    trace = {name: [1.0, 2.0] for name in ("time_s", "load", "L1", "T5", "CV155", "NCR22_A", "CV156", "cost")}

    def run(sha: str, level: float, temperature: float) -> "Outcome":
        return made_up(responding.updates, trace, sha, outside_band_pct={"L1": level, "T5": temperature})

    study = STUDIES["adaptive-2h"]
    runs = [run("same", 1.0, 2.0), run("same", 1.0, 2.0), run("one", 3.5, 0.5), run("other", 0.0, 0.0)]
    values = study.evaluate(under, dict(zip(study.requests(under), runs, strict=True))).values
    expected = {
        f"adaptive-2h: {name}": [value] for name, value in response([(responding, stepped)], "adaptive").items()
    }
    assert values == {
        "adaptive-2h: same trace, 2.5 s": [1.0],
        "adaptive-2h: time outside the bands, 2.5 s": [2.0],
        "adaptive-2h: same trace, adaptive": [0.0],
        "adaptive-2h: time outside the bands, adaptive": [3.5],
        **expected,
    }
