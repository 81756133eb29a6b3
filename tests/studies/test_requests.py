from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import ConfigurationError
from coldloop_studies.request import Outcome, perform
from coldloop_studies.settings import settings_of
from coldloop_studies.study import NOISE, StudyOptions, draw_of, loads

if TYPE_CHECKING:
    from tests.studies.conftest import Requests


def test_a_run_is_a_function_of_its_request(requests: "Requests") -> None:
    one, other = requests(2)
    assert perform(one) == perform(one)
    assert Outcome.from_json(perform(one)).trace_sha256 != Outcome.from_json(perform(other)).trace_sha256


def test_an_outcome_survives_its_file(requests: "Requests") -> None:
    outcome = Outcome.from_json(perform(replace(requests(1)[0], trace_ticks=4)))
    assert Outcome.from_json(outcome.to_json()) == outcome
    assert len(outcome.series("load")) == 120 / 4
    assert len(outcome.column("tick")) == len(outcome.column("iterations")) > 0


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"indicators": 3}'])
def test_what_is_no_outcome_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r".*"):
        Outcome.from_json(text)


def test_every_part_of_a_request_makes_another_digest(requests: "Requests") -> None:
    request = requests(1)[0]
    others = [
        replace(request, ticks=121), replace(request, watts=(1.0, *request.watts[1:])), replace(request, draw=2),
        replace(request, assignments=("optimizer_plc.program.solver=osqp",)), replace(request, networked=True),
    ]  # fmt: skip
    assert len({request.digest, *(other.digest for other in others)}) == 6


def test_the_environment_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLDLOOP__OPTIMIZER_PLC__PROGRAM__SOLVER", "osqp")
    assert settings_of(("plant.seed=77",)).optimizer_plc.program.solver == "ode"


def test_a_wrong_key_is_one_line() -> None:
    with pytest.raises(ConfigurationError, match="no such key"):
        settings_of(("plant.lod=a",))


def test_named_loads_are_drawn_anew_for_each_seed_and_files_get_noise(tmp_path: "object") -> None:
    file = f"{tmp_path}/own.csv"
    with open(file, "w", encoding="utf-8") as out:  # noqa: PTH123 a name as users give it
        out.write("time_s,load_w\n0,385\n60,420\n")
    first, second = loads(StudyOptions(seeds=2), "c")
    assert (first.name, second.name) == ("c", "c@2")
    assert first.profile != second.profile
    own = loads(StudyOptions(seeds=2, loads=(file,)))
    assert own[0].profile == own[1].profile
    assert own[0].settings == NOISE
    assert loads(StudyOptions(seeds=1, loads=(file,)))[0].settings == ()


def test_a_quick_study_has_one_draw_of_ten_minutes() -> None:
    options = StudyOptions(seeds=5, quick=True)
    assert [load.ticks for load in loads(options, "8h")] == [2400]
    assert draw_of("8h", 1, StudyOptions(ticks=10, quick=True)).ticks == 10
