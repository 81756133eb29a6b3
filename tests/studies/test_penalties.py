"""What the study of penalties makes of its runs, against cases done by hand; and a small one of it, whole."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from coldloop.errors import StudyError
from coldloop.process.load_profile import LoadProfile
from coldloop_studies.penalties import (
    FIRST,
    OWN,
    PENALTIES,
    PRESETS,
    VARIANTS,
    Paired,
    PenaltyVariant,
    end_over_best,
    misfit,
    paired,
    paired_sums,
    powers_of,
    share_inside,
)
from coldloop_studies.request import Outcome, RunRequest
from coldloop_studies.settings import settings_of
from coldloop_studies.solver_comparison import paired_loads
from coldloop_studies.study import Load, StudyOptions, first_and_fresh
from coldloop_studies.updating_period import is_inside
from tests.studies.conftest import NOTHING

if TYPE_CHECKING:
    from tests.studies.conftest import Conducted

QUICK = StudyOptions(quick=True)
TUNED, AS_PRINTED = PRESETS["tuned"], PRESETS["as-printed"]


def test_each_variant_changes_what_its_preset_has() -> None:
    """What a preset has itself is no change of it: the same settings are not run twice."""
    settings = [settings_of(variant.assignments).optimizer_plc.program for variant in VARIANTS]
    documents = [one.model_dump_json() for one in settings]
    assert len(set(documents)) == len(VARIANTS)
    assert sum(not variant.change for variant in VARIANTS) == len(OWN)
    assert [len(own) for own in OWN.values()] == [7, 7]


def of(total: float, lowest: float, c1: float = 0.0) -> Outcome:
    columns = {"j_dev": [total / 4], "j_cst": [3 * total / 4], "lowest": [lowest]}
    return Outcome("", NOTHING._replace(J_dev=total / 4, J_cst=3 * total / 4, c1=c1), "", 0, columns, {})


def found(totals: dict[tuple[PenaltyVariant | None, float], float]) -> Paired:
    """Give a quick study whose one draw has the lowest cost 10."""
    (load,) = paired_loads(QUICK)
    outcomes: dict[RunRequest, Outcome] = {}
    for variant in (None, TUNED, AS_PRINTED):
        for power in powers_of(variant, QUICK):
            outcomes[paired(load, variant, power)] = of(totals.get((variant, power), 10.0), 10.0)
    return paired_sums(QUICK, outcomes)


def test_totals_are_compared_with_the_lowest_and_parts_with_converged_qpoases() -> None:
    one = found({(TUNED, 1.0): 15.0, (None, 25.0): 12.0})
    assert one.over_lowest(TUNED, 1.0, [0]) == 1.5
    assert one.over_converged("J_dev", TUNED, 1.0, None).value == pytest.approx(15.0 / 12.0)


def test_curves_cross_where_qpoases_comes_down_to_a_preset() -> None:
    """Both logarithms are straight between 1 and 10: ln 4 above at 1, ln 4 below at 10, so they cross at sqrt 10."""
    one = found({(None, 0.2): 400.0, (None, 1.0): 80.0, (TUNED, 0.2): 20.0, (TUNED, 1.0): 20.0, (TUNED, 10.0): 40.0})
    assert one.crossing(None, TUNED).value == pytest.approx(math.sqrt(10.0))


def test_a_profile_below_the_optimum_ends_the_study() -> None:
    with pytest.raises(StudyError, match=r"as-printed at P = 1, load 8h: problem 0 costs 9\.99, less than the optimum"):
        found({(AS_PRINTED, 1.0): 9.99})


def test_the_misfit_of_twice_and_half_is_that_of_a_factor_of_two() -> None:
    assert misfit(np.array([2.0, 3.0]), np.array([1.0, 6.0])) == pytest.approx(math.log(2.0))
    assert misfit(np.array([2.0, 3.0]), np.array([2.0, 3.0])) == 0.0


def test_a_best_period_at_an_end_is_not_inside() -> None:
    table = np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 4.0], [4.0, 2.0, 1.0], [8.0, 1.0, 2.0]])
    assert [is_inside(row) for row in table] == [False, True, False, True]
    assert share_inside(table).value == 0.5
    assert end_over_best(table, 0).value == pytest.approx((1.0 * 1.5 * 4.0 * 8.0) ** 0.25)
    assert end_over_best(table, -1).value == pytest.approx((3.0 * 2.0 * 1.0 * 2.0) ** 0.25)


def test_hours_that_rules_were_tuned_on_are_not_fresh() -> None:
    loads = [Load(f"a@{draw}", draw, LoadProfile((0,), (1.0,)), 60) for draw in (1, 2, 11)]
    assert {title: [one.draw for one in some] for title, some in first_and_fresh(loads, FIRST).items()} == {
        "hours of the first draw": [1],
        "fresh hours": [2],
    }


@pytest.mark.usefixtures("compiles")
def test_the_whole_study_of_half_a_minute_has_a_row_for_each_run(
    conducted: "Conducted", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLDLOOP__PLANT__SEED", "7")  # the environment does not count
    options = StudyOptions(quick=True, ticks=120)
    study = PENALTIES
    result = conducted(study, options)
    assert len(result.rows) == len(study.requests(options))
    text = (tmp_path / "penalties" / "section.md").read_text()
    for expected in (
        "costs less than the lowest cost",
        "**as-printed** and one change",
        "Best of the fixed",
    ):
        assert expected in text
    assert (tmp_path / "penalties" / "total-cost.png").stat().st_size > 10_000
