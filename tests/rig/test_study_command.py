"""`coldloop study`: from a load of one's own to a figure; what is asked for wrongly is one line."""

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop_studies.reproduction import APART, STUDIES

if TYPE_CHECKING:
    from tests.conftest import Coldloop

WANTED = {
    "cholesky", "unlimited", "limited", "solver-comparison", "trajectories", "updating-period", "plc-2h", "adaptive-2h",
    "trade-off", "classical",
}  # fmt: skip


@pytest.fixture
def own_load(tmp_path: Path) -> Path:
    file = tmp_path / "my_hours.csv"
    file.write_text("time_s,load_w\n0,385\n10,445\n25,330\n")
    return file


def test_every_study_is_listed_with_its_title(coldloop: "Coldloop") -> None:
    outcome = coldloop("study", "--list")
    assert outcome.code == 0
    assert set(STUDIES) >= WANTED
    for name, study in {**STUDIES, **APART}.items():
        assert f"{name} " in outcome.out
        assert study.title in outcome.out


@pytest.mark.usefixtures("processes")
def test_a_study_on_a_load_of_ones_own_leaves_table_figure_and_section(
    coldloop: "Coldloop", own_load: Path, tmp_path: Path
) -> None:
    asked = ("study", "limited", "--load", own_load, "--duration", "1min", "--seeds", "2", "--workers", "1")
    outcome = coldloop(*asked, "--out", tmp_path / "studies")
    assert outcome.code == 0, outcome.complaints
    folder = tmp_path / "studies" / "limited"
    rows = list(csv.DictReader((folder / "results.csv").read_text().splitlines()))
    assert len(rows) == 4, "two solvers, two draws of the noise"
    assert {row["load"] for row in rows} == {str(own_load), f"{own_load}#2"}
    assert rows[0]["J_BF"] != rows[2]["J_BF"], "the draws differ by their noise"
    assert (folder / "time-courses.png").read_bytes().startswith(b"\x89PNG")
    assert "![time courses](time-courses.png)" in (folder / "section.md").read_text()
    again = coldloop(*asked, "--out", tmp_path / "studies")
    assert again.out == outcome.out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("nonsense",), "unknown study"),
        (("limited", "--load", "missing.csv"), "missing.csv"),
        (("limited", "--seeds", "0"), "'0' is not a whole number of at least 1"),
        (("limited", "--duration", "soon"), "'soon' is not a duration"),
        (("limited", "--duration", "5s"), "5 s are too short"),
        (("limited", "--workers", "2", "--scheduler", "tcp://127.0.0.1:1"), "give one of them"),
        (("limited", "--quick", "--scheduler", "nowhere"), "--scheduler nowhere"),
    ],
)
def test_what_is_asked_for_wrongly_is_one_line(
    arguments: tuple[str, ...], part: str, coldloop: "Coldloop", tmp_path: Path
) -> None:
    outcome = coldloop("study", *arguments, "--out", tmp_path / "studies")
    assert outcome.code == 2
    assert len(outcome.complaints) == 1, outcome.complaints
    assert part in outcome.complaints[0]
