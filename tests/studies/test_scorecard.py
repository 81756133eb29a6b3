"""The scorecard cannot flatter: what is asked stands in one file, and verdicts follow from it."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig import paper
from rig.report.document import as_page, deviations, scorecard_table
from rig.report.scorecard import FROM_POINTS, Claim, Verdict, as_json, claims, counts, judge, paper_values, verdict
from rig.studies import STUDIES
from rig.studies.crossing import crossing
from rig.studies.solver_comparison import measures

CLAIM = Claim(
    study="s", value="v", figure="f", says="it is so", of_paper="2", why="w", reproduced=(1.0, 3.0), partly=(0.0, 9.0)
)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((1.0, 3.0), Verdict.REPRODUCED),
        ((1.0, 4.0), Verdict.PARTLY),
        ((9.0, 9.0), Verdict.PARTLY),
        ((0.5, 4.5), Verdict.PARTLY),
        ((9.1, 9.0), Verdict.NOT_REPRODUCED),
        ((math.nan,), Verdict.NOT_REPRODUCED),
        ((), Verdict.NOT_RUN),
        ((math.inf,), Verdict.NOT_REPRODUCED),
    ],
)
def test_a_verdict_needs_all_draws(values: tuple[float, ...], expected: Verdict) -> None:
    assert verdict(CLAIM, values) is expected


def test_without_data_in_the_paper_there_is_no_verdict() -> None:
    assert verdict(CLAIM.model_copy(update={"reproduced": None}), (2.0,)) is Verdict.NO_DATA


def test_every_claim_is_of_a_study_and_its_value_unique() -> None:
    beyond_the_paper = {"coupling", "disturbances"}
    assert {claim.study for claim in claims()} == set(STUDIES) - beyond_the_paper
    assert len({claim.value for claim in claims()}) == len(claims())


def test_what_the_paper_has_points_for_is_computed_from_them() -> None:
    missing = [claim.value for claim in claims() if claim.of_paper == FROM_POINTS and claim.value not in paper_values()]
    assert missing == []


def test_the_paper_itself_is_judged_by_the_same_ranges() -> None:
    """Whoever demanded more than the paper shows would fail the paper; where we do, it is known."""
    failing = {
        claim.value
        for claim in claims()
        if claim.of_paper == FROM_POINTS and verdict(claim, (paper_values()[claim.value],)) is not Verdict.REPRODUCED
    }
    assert failing == {
        "qpOASES from P = 10 on, largest distance from converged",
        "worst end over best from 1 to 5 s, smallest of hours",
    }


def test_the_points_of_the_paper_give_the_figures_of_its_text() -> None:
    found = paper_values()
    assert found["qpOASES over ODE in total cost at P = 1"] == pytest.approx(9.76, abs=0.01)
    assert found["qpOASES over ODE in J_BF at P = 1"] == pytest.approx(1.159, abs=0.001)
    assert 10 < found["crossing in total cost"] < 15
    assert 2 < found["crossing in J_BF"] < 3.2
    assert found["best of all, share: Algorithm 1, hours"] == pytest.approx(1 / 6)
    assert found["better than the mean fixed period, share: Algorithm 1, hours"] == 1.0


def test_measures_work_on_any_table() -> None:
    powers = np.array([0.2, 1.0, 10.0, 25.0])
    falling, flat = np.array([100.0, 10.0, 2.0, 1.0]), np.full(4, 1.5)
    table = {
        solver: dict.fromkeys(("J_total", "J_BF", "c1", "c2"), values)
        for solver, values in (("qpoases", falling), ("ode", flat))
    }
    found = measures(powers, table)
    assert found["qpOASES over converged at P = 0.2"] == 100.0
    assert found["qpOASES, largest rise of total cost with P"] == pytest.approx(-0.5)
    assert 10.0 < found["crossing in total cost"] < 25.0


@given(
    base=st.lists(st.floats(0.1, 10.0), min_size=3, max_size=10),
    factors=st.lists(st.floats(0.2, 5.0), min_size=10, max_size=10),
)
def test_from_a_crossing_on_the_one_is_never_above_the_other(base: list[float], factors: list[float]) -> None:
    powers = np.geomspace(0.2, 25.0, len(base))
    other = np.array(base)
    one = other * np.array(factors[: len(base)])
    found = crossing(powers, one, other)
    if math.isnan(found):
        assert one[-1] > other[-1]
    else:
        assert (one[powers > found * (1 + 1e-9)] <= other[powers > found * (1 + 1e-9)] * (1 + 1e-12)).all()


def test_the_scorecard_is_plain_json_and_counts_every_verdict() -> None:
    judged = judge({claim.value: [1.0, math.nan] for claim in claims()})
    assert len(judged) == len(claims())
    assert sum(sum(numbers.values()) for numbers in counts(judged).values()) == len(judged)
    text = json.dumps(as_json(judged), allow_nan=False)
    assert json.loads(text)[0]["verdict"] in set(Verdict)


def test_the_page_holds_its_pictures_and_colours_its_verdicts(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(b"\x89PNG")
    judged = judge({claim.value: [1.0] for claim in claims()})
    markdown = (
        f"{scorecard_table(judged, dict.fromkeys(STUDIES, 'coldloop'))}\n\n![p](p.png)\n\n{deviations(judged, {})}"
    )
    page = as_page("t & t", markdown, tmp_path)
    assert 'src="data:image/png;base64,' in page
    assert 'src="p.png"' not in page
    assert "<title>t &amp; t</title>" in page
    assert '<td class="not-reproduced">not reproduced</td>' in page
    assert page.count("<tr>") == len(judged) + 1


def test_the_points_are_whole() -> None:
    comparison = paper.solver_comparison()
    assert {solver: len(points["J_BF"]) for solver, points in comparison.items()} == {"ode": 18, "qpoases": 18}
    assert [len(points["tau_u_s"]) for points in paper.updating_period().values()] == [9] * 6
