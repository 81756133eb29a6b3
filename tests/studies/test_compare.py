"""Variants of one's own: the judgement on a case done by hand, a short study, and files that are none."""

import csv
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import ColdloopError
from coldloop_optimizer_plc.computing_settings import OutsideSettings
from coldloop_studies.any_process import COMPARE
from coldloop_studies.settings import _digest, outside_digests
from coldloop_studies.study import StudyOptions, read_variants

if TYPE_CHECKING:
    from tests.studies.conftest import Conducted, MakeOutcome

T_1 = 12.7062
"""97.5 % of Student's t with one degree of freedom, from a table."""
FILE = """
[usual]
["fixed 2.5 s"]
optimizer_plc.program.updating_period_s = 2.5
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "variants.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_costs_are_compared_draw_by_draw(tmp_path: Path, made_up: "MakeOutcome") -> None:
    """Ratios of 2 and 2.42 have the geometric mean 2.2; their logarithms are ln 1.1 from its own, its deviation too."""
    options = StudyOptions(seeds=2, loads=("a",), variants=read_variants(written(tmp_path, FILE)))
    asked = COMPARE.requests(options)
    assert [(run.load, run.updating_period_s) for run in asked] == [("a", 0), ("a@2", 0), ("a", 2.5), ("a@2", 2.5)]
    shares = (0.0, 0.0, 1.0, 3.0)
    outcomes = {
        run: made_up(J_BF=cost, outside_band_pct={"L1": share, "T5": 0.0})
        for run, cost, share in zip(asked, (1.0, 10.0, 2.0, 24.2), shares, strict=True)
    }
    result = COMPARE.evaluate(options, outcomes)
    factor = math.exp(T_1 * math.log(1.1))
    over = f"2.200 [{2.2 / factor:.3f}, {2.2 * factor:.3f}]"
    assert f"| fixed 2.5 s | {over} | no difference is shown | 2 | 0 |" in result.remarks[0]
    assert list(result.values.values()) == [pytest.approx([2.0, 2.42])]
    assert [row[:2] + row[3:6] for row in result.rows][3] == ("fixed 2.5 s", "a@2", 24.2, pytest.approx(2.42), 3.0)


def test_a_short_comparison_leaves_table_figure_and_manifest(tmp_path: Path, conducted: "Conducted") -> None:
    variants = read_variants(written(tmp_path, FILE))
    conducted(COMPARE, StudyOptions(seeds=1, loads=("a",), ticks=240, variants=variants))
    folder = tmp_path / "compare"
    rows = list(csv.DictReader((folder / "results.csv").read_text().splitlines()))
    assert [(row["variant"], row["mean tau_u (s)"] == "2.5") for row in rows] == [
        ("usual", False),
        ("fixed 2.5 s", True),
    ]
    assert rows[0]["J_BF over the reference"] == "1.0"
    assert (folder / "variants-over-the-reference.png").read_bytes().startswith(b"\x89PNG")
    runs = json.loads((folder / "manifest.json").read_text())["runs"]
    assert [run["updating_period_s"] for run in runs] == ["adaptive", 2.5]
    assert all((tmp_path / "runs" / run["outcome"]).exists() for run in runs)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[a", "not TOML"),
        ("", "0 variants; write the table"),
        ("[a]\n", "1 variant; write the table"),
        ("solver = 'ode'\n[a]\n", "solver is not in the table of a variant"),
        ("[a]\n['b$']\n", "['b$']: name it with"),
        ("[a]\n[b]\n", "[b]: has the settings of [a]"),
        ("[a]\n[b.plant]\nload = 'c'\n", "[b]: plant.load: has no effect on this study: give it with --load"),
        ("[a]\n[b.session]\nfactor = 2\n", "[b]: session.factor: has no effect"),
        ("[a]\n[b.optimizer_plc.program]\nsolvr = 'ode'\n", "[b]: optimizer_plc.program.solvr: no such key"),
        ("[a]\n[b.optimizer_plc.program.outside]\nrule = 'none'\n", "no rule 'none' among the entry points"),
    ],
)
def test_a_file_that_is_none_is_one_line(text: str, part: str, tmp_path: Path) -> None:
    file = written(tmp_path, text)
    with pytest.raises(ColdloopError) as caught:
        read_variants(file)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_another_source_of_a_rule_is_another_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metadata = tmp_path / "mine-1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text("[coldloop.rules]\nmine = mine_of_a_test:Mine\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    found = []
    for constant in (1, 2):
        (tmp_path / "mine_of_a_test.py").write_text(f"class Mine:\n    q = {constant}\n", encoding="utf-8")
        _digest.cache_clear()
        found.append(outside_digests(OutsideSettings(rule="mine"))["rule mine"])
    assert found[0] != found[1]
