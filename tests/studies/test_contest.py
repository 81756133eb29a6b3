"""What the study of solvers in the closed loop makes of its runs, against a case done by hand."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop_studies.controllers import CONTEST, REFERENCE, SOLVERS, WAYS
from coldloop_studies.request import Outcome, RunRequest
from coldloop_studies.settings import settings_of
from coldloop_studies.study import StudyOptions
from tests.studies.conftest import NOTHING

if TYPE_CHECKING:
    from tests.studies.conftest import Conducted

STUDY = CONTEST


def outcome(closed: float, opened: float) -> Outcome:
    return Outcome("", NOTHING._replace(J_open_mean=opened, J_BF=closed), "", 0, {}, {})


def test_costs_are_ratios_to_the_ode_based_solver_under_algorithm_1_hour_by_hour() -> None:
    """The interior point at 5 s costs 2 and 8 times the reference in the hours a and c: 4 in the mean, 8 at worst."""
    options = StudyOptions(ticks=60, loads=("a", "c"), seeds=1)

    def cost(request: RunRequest) -> Outcome:
        program = settings_of(request.assignments).optimizer_plc.program
        if (program.solver, request.updating_period_s) == ("interior-point", 5.0):
            return outcome(20.0 if request.load == "a" else 80.0, 5.0)
        return outcome(10.0, 5.0)

    result = STUDY.evaluate(options, {request: cost(request) for request in STUDY.requests(options)})
    assert result.values["J_BF over ODE, Algorithm 1, hours: interior point, fixed 5 s"] == [pytest.approx(4.0)]
    assert result.values["mean open-loop cost over ODE, Algorithm 1, hours: interior point, fixed 5 s"] == [1.0]
    assert result.values["J_BF over ODE, Algorithm 1, hours: hybrid, fixed 5 s"] == [1.0]
    table = next(text for text in result.remarks if text.startswith("**hours, J_BF**"))
    same = "1.000 [1.000, 1.000] (1.00)"
    cells = [same if solver != "interior point" else "4.000 [0.001, 26730.603] (8.00)" for solver in SOLVERS]
    assert f"| fixed 5 s | {' | '.join(cells)} |" in table
    assert len(result.rows) == 2 * len(SOLVERS) * len(WAYS)


def test_hours_that_constants_were_chosen_on_are_not_judged() -> None:
    drawn = {request.draw for request in STUDY.requests(StudyOptions(ticks=60, loads=("a",), seeds=12))}
    assert drawn == set(range(1, 11))


def test_the_reference_is_among_the_ways() -> None:
    assert REFERENCE[0] in SOLVERS
    assert REFERENCE[1] in {way.label for way in WAYS}


@pytest.mark.usefixtures("programs")
def test_the_study_is_conducted(conducted: "Conducted", tmp_path: Path) -> None:
    result = conducted(STUDY, StudyOptions(ticks=240, loads=("e",), seeds=1))
    assert len(result.rows) == len(SOLVERS) * len(WAYS)
    assert (tmp_path / "contest" / "section.md").is_file()
