"""The scorecard cannot flatter: what is asked is in one file with its history, and verdicts follow from it."""

import json
import math
import re
import subprocess
import tomllib
from datetime import date, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from coldloop import __version__
from coldloop_rig.plc_sizing.intervals import crossing
from coldloop_studies.drawing import published_comparison, published_periods
from coldloop_studies.reproduction import (
    EXPLANATIONS,
    FROM_POINTS,
    PLACEHOLDER,
    STUDIES,
    TOLERANCES,
    Claim,
    ClaimKind,
    ClaimVerdict,
    Judged,
    Revision,
    as_json,
    as_page,
    circumstances,
    claims,
    counted,
    counts,
    deviations,
    explained,
    findings,
    judge,
    lead,
    paper_settings,
    paper_values,
    revisions,
    scorecard_table,
    verdict,
    verdict_counts,
    withdrawn,
)
from coldloop_studies.solver_comparison import measures
from coldloop_studies.study import StudyOptions
from coldloop_studies.trajectories import response

ROOT = Path(__file__).parents[2]
FIRST = Path(__file__).with_name("tolerances-before-the-first-report.toml")
"""The file as it was set before any run."""

CLAIM = Claim(
    study="s", value="v", figure="f", says="it is so", of_paper="2", why="w", reproduced=(1.0, 3.0), partly=(0.0, 9.0)
)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((3.0,), ClaimVerdict.REPRODUCED),  # a single value is judged as it is
        ((9.0,), ClaimVerdict.PARTLY),
        ((9.1,), ClaimVerdict.NOT_REPRODUCED),
        ((3.0, 3.0), ClaimVerdict.REPRODUCED),  # an interval of no width
        ((9.0, 9.0), ClaimVerdict.PARTLY),
        ((2.0, 2.1, 2.2), ClaimVerdict.REPRODUCED),  # 1.86 to 2.36
        ((1.9,) * 9 + (3.1,), ClaimVerdict.REPRODUCED),  # one draw of ten is outside, the interval is not
        ((1.0, 3.0), ClaimVerdict.PARTLY),  # both draws are inside, the interval is not, the mean is
        ((4.0, 4.1, 4.2), ClaimVerdict.PARTLY),  # the interval is within the wider range
        ((4.0, 9.0, 14.0), ClaimVerdict.NOT_REPRODUCED),
        ((math.nan,), ClaimVerdict.NOT_REPRODUCED),
        ((2.0, 2.0, math.nan), ClaimVerdict.NOT_REPRODUCED),
        ((math.inf,), ClaimVerdict.NOT_REPRODUCED),
        ((), ClaimVerdict.NOT_RUN),
    ],
)
def test_a_verdict_is_that_of_the_interval_of_the_mean(values: tuple[float, ...], expected: ClaimVerdict) -> None:
    assert verdict(CLAIM, values) is expected


def test_a_value_that_can_be_negative_has_no_interval_of_logarithms() -> None:
    """Of 0.001, 0.001 and 0.007 Student's interval begins below 0, and that of logarithms does not."""
    near_zero = CLAIM.model_copy(update={"reproduced": (0.0, 1.0), "partly": (0.0, 1.0)})
    values = (0.001, 0.001, 0.007)
    assert verdict(near_zero, values) is ClaimVerdict.REPRODUCED
    assert verdict(near_zero.model_copy(update={"signed": True}), values) is ClaimVerdict.PARTLY


def test_without_data_in_the_paper_there_is_no_verdict() -> None:
    assert verdict(CLAIM.model_copy(update={"reproduced": None}), (2.0,)) is ClaimVerdict.NO_DATA


# -- the file and its history -----------------------------------------------------------------------------------------


def asked(claim: dict[str, Any]) -> tuple[object, ...]:
    """Return what makes a claim easier or harder, as plain data."""
    return tuple(str(claim.get(name)) for name in ("study", "kind", "of_paper", "reproduced", "partly"))


def claimed(text: str) -> dict[str, dict[str, Any]]:
    return {one["value"]: one for one in tomllib.loads(text)["claim"]}


def undated(before: dict[str, dict[str, Any]], after: dict[str, dict[str, Any]], day: date) -> list[str]:
    """Return which claims were added or changed from one version to another without a date from that day on."""
    new = [value for value, claim in after.items() if value not in before or asked(claim) != asked(before[value])]
    return [value for value in new if after[value].get("changed", date.min) < day]


def test_what_was_added_or_changed_since_before_the_first_report_has_its_date_and_reason() -> None:
    before, now = claimed(FIRST.read_text("utf-8")), claimed(TOLERANCES.read_text("utf-8"))
    aims = [value for value, claim in now.items() if claim.get("kind") == "aim"]
    assert all(before[value]["of_paper"] == "not in the paper" for value in aims), (
        "an aim was called one from the start"
    )
    unchanged_aims = [v for v in aims if asked({**now[v], "kind": None}) == asked(before[v])]
    assert set(undated(before, now, date(2026, 11, 21))) == set(unchanged_aims)
    assert set(before) - set(now) <= {one.value for one in withdrawn()}
    assert all(one.changed and one.because for one in withdrawn())
    assert not {one.value for one in withdrawn()} & set(now), "what is withdrawn is not claimed"


def test_the_history_shows_a_change_that_has_no_date() -> None:
    one = {"study": "s", "value": "v", "of_paper": "2", "reproduced": [1, 2], "partly": [0, 3]}
    day = date(2026, 12, 1)
    assert undated({"v": one}, {"v": one}, day) == []
    assert undated({"v": one}, {"v": {**one, "reproduced": [1, 2.5]}}, day) == ["v"]
    assert undated({"v": one}, {"v": {**one, "kind": "variant"}}, day) == ["v"]
    assert undated({"v": one}, {"v": {**one, "partly": [0, 4], "changed": date(2026, 11, 30)}}, day) == ["v"], (
        "an older change"
    )
    assert undated({"v": one}, {"v": {**one, "partly": [0, 4], "changed": day}}, day) == []
    assert undated({}, {"v": one}, day) == ["v"]


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


@pytest.mark.usefixtures("programs")
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="an unpacked source distribution has no history")
def test_each_change_in_the_history_of_the_file_was_dated_when_it_was_made() -> None:
    """From the version before the first report on; a clone without its whole history shows what it has."""
    place = "beside/studies/coldloop_studies/tolerances.toml"
    log = git("log", "--follow", "--format=%H %as", "--name-only", "--", place).split()
    versions = [
        (git("show", f"{commit}:{path}"), day) for commit, day, path in zip(log[::3], log[1::3], log[2::3], strict=True)
    ][::-1]
    shallow = git("rev-parse", "--is-shallow-repository").strip() == "true"
    assert shallow or FIRST.read_text("utf-8") in [text for text, _ in versions], "the first version is what it was"
    versions.append((TOLERANCES.read_text("utf-8"), versions[-1][1]))
    for (before, _), (after, day) in pairwise(versions):
        if date.fromisoformat(day) > date(2026, 11, 21):  # from then on, changes are dated
            bad = set(undated(claimed(before), claimed(after), date.fromisoformat(day) - timedelta(days=1)))
            assert bad <= UNDATED_AIMS | BEFORE_DATES, (day, bad)


UNDATED_AIMS = {claim.value for claim in claims() if claim.kind is ClaimKind.AIM}
"""They were aims from the start, and are called so by another key since."""
BEFORE_DATES = {
    "tau_u 0 to 30 s after a load step over that in quiet, by time, Algorithm 1",
    "adaptive-2h: tau_u 0 to 30 s after a load step over that in quiet, by time, adaptive",
}
"""Added on the day that dates came in, a version before them; they have theirs now."""


@pytest.mark.parametrize("one", [{"changed": date(2026, 1, 1)}, {"because": "why not"}])
def test_a_date_without_a_reason_or_a_reason_without_a_date_is_refused(one: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=r"v: a change has a date \(`changed`\) and a reason \(`because`\)"):
        Claim.model_validate({**CLAIM.model_dump(), **one})


def test_what_cannot_fail_or_is_a_milder_form_does_not_count() -> None:
    apart = {claim.value for claim in claims() if claim.kind in (ClaimKind.CHECK, ClaimKind.VARIANT)}
    assert {claim.value for claim in claims() if claim.study == "cholesky"} <= apart
    assert {"plc-2h: same trace, 5 s", "adaptive-2h: same trace, adaptive"} <= apart
    milder = {claim.value for claim in claims() if claim.kind is ClaimKind.VARIANT}
    assert milder == {
        "crossing in J_BF within 2 %", "interior optimum from 0.5 to 5 s, share of hours",
        "interior optimum from 1 to 5 s, share of hours, as printed",
        "worst end over best from 0.5 to 5 s, smallest of hours",
    }  # fmt: skip
    judged = judge({claim.value: [1.0] for claim in claims()})
    assert {j.claim.value for j in judged} - {j.claim.value for j in counted(judged)} == apart
    by_group = counts(judged)
    assert sum(by_group["claims of the paper"].values()) == sum(claim.kind is ClaimKind.CLAIM for claim in claims())
    assert sum(by_group["among them calibrated"].values()) == 3


def test_where_a_value_can_be_too_good_the_tolerance_has_two_sides() -> None:
    one_sided = {
        claim.value for claim in claims()
        if claim.kind is ClaimKind.CLAIM and claim.reproduced and any(map(math.isinf, claim.reproduced))
    }  # fmt: skip
    assert one_sided == {
        "unlimited: iterations", "qpOASES from P = 10 on, largest distance from converged",
        "qpOASES, largest rise of total cost with P", "interior optimum from 1 to 5 s, share of hours",
        "worst end over best from 1 to 5 s, smallest of hours",
        "better than the mean fixed period, share: Algorithm 1, hours",
        "tau_u 0 to 30 s after a load step over that in quiet, by time, Algorithm 1",
        "plc-2h: time outside the bands, 5 s",
        "adaptive-2h: tau_u 0 to 30 s after a load step over that in quiet, by time, adaptive",
        "share of load steps after which E > D at 1 s: ODE less qpOASES",
        "share of load steps after which E > D at 5 s less that at 1 s: qpOASES",
    }, "shares that end at 1, distances that end at 0, and directions without a size in the paper"  # fmt: skip


# -- explanations and header ------------------------------------------------------------------------------------------


def test_explanations_have_their_numbers_from_the_results() -> None:
    values = {"a, b: c": [1.0, 3.0], "d (s)": [math.nan, 0.12345], "e": [math.nan]}
    text = explained("{a, b: c} and {d (s)}, {e}, {f}", values)
    assert text == "2 and 0.123, (not run), (not run)"


def test_explanations_name_values_that_there_are_and_write_no_numbers() -> None:
    known = {claim.value for claim in claims()} | set(paper_values())
    known |= set(response([], "Algorithm 1")) | {f"adaptive-2h: {name}" for name in response([], "adaptive")}
    known |= {
        f"cost over that of the best fixed period, geometric mean: contraction rule, interrupt, {h}" for h in ("hours",)
    }
    for value, text in tomllib.loads(EXPLANATIONS.read_text("utf-8")).items():
        assert value in {claim.value for claim in claims()}, value
        assert set(PLACEHOLDER.findall(text)) <= known, value
        assert not re.search(r"\d+[.,]\d|\d ?%|per cent", PLACEHOLDER.sub("", text)), value


def test_the_line_below_the_title_is_the_programs() -> None:
    line = circumstances(StudyOptions(), "7 min with 2 workers")
    pattern = (
        r"Coldloop \S+, Python \S+, \d{4}-\d\d-\d\d; [^;]*draw[^;]*; \d+ min with \d+ workers, what was kept from "
        r"before included\."
    )
    assert re.fullmatch(pattern, line)
    kept = (ROOT / "docs" / "report" / "report.md").read_text("utf-8").splitlines()[2]
    assert re.fullmatch(pattern, kept), "the report that is kept has it too"


def test_the_report_that_is_kept_is_of_this_version_its_settings_and_its_tolerances() -> None:
    kept = json.loads((ROOT / "docs" / "report" / "scorecard.json").read_text("utf-8"))
    again = "make it anew: scripts/reproduce, then report.md, scorecard.json and the pictures into docs/report"
    title = (ROOT / "docs" / "report" / "report.md").read_text("utf-8").splitlines()[2]
    assert kept["coldloop"] == __version__, again
    assert title.startswith(f"Coldloop {__version__}, "), again
    assert kept["settings"] == json.loads(json.dumps(paper_settings())), again
    assert (kept["quick"], kept["seeds"]) == (False, None), again
    present = as_json(judge({}))
    asked = [{name: one.get(name) for name in Claim.model_fields} for one in kept["claims"]]
    assert asked == [{name: one.get(name) for name in Claim.model_fields} for one in present], again


def test_the_report_that_is_kept_has_the_verdicts_that_its_values_have() -> None:
    kept = json.loads((ROOT / "docs" / "report" / "scorecard.json").read_text("utf-8"))
    judged = []
    for one in kept["claims"]:
        ends = {name: ["-" if limit is None else limit for limit in one[name]] for name in RANGES if one[name]}
        fields = {name: one[name] for name in Claim.model_fields if name in one}
        claim = Claim.model_validate(fields | dict.fromkeys(RANGES) | ends)
        values = tuple(math.nan if value is None else value for value in one["values"])
        assert verdict(claim, values) == one["verdict"], claim.value
        judged.append(Judged(claim, values, one["paper"], ClaimVerdict(one["verdict"])))
    assert counts(judged) == kept["counts"]
    report = (ROOT / "docs" / "report" / "report.md").read_text("utf-8")
    assert f"**{verdict_counts(judged)}.**\n\n{findings(counted(judged))}\n\n" in report


RANGES = ("reproduced", "partly")


def test_the_lead_has_findings_and_the_number_of_changes() -> None:
    judged = judge({claim.value: [1.0, 1.0] for claim in claims() if claim.value != "limited: J_BF"})
    text = lead(judged)
    assert "\n- **reproduced**: *unlimited: furthest outside* 1 [1 to 1]; " in text
    assert "\n- **not run**: *limited: J_BF* none (paper 1.17)\n" in text
    some = counted(judged)
    changed = sum(j.claim.changed is not None for j in some)
    assert f"{changed} of these {len(some)} claims and aims were added or changed after a report" in text
    assert f" and {len(withdrawn())} were withdrawn" in text


# -- values of the paper ----------------------------------------------------------------------------------------------


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
        if claim.of_paper == FROM_POINTS
        and verdict(claim, (paper_values()[claim.value],)) is not ClaimVerdict.REPRODUCED
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
    by_group = counts(judged)
    total = sum(sum(by_group[group].values()) for group in ("claims of the paper", "aims of this project"))
    assert total == len(counted(judged)) < len(judged)
    text = json.dumps(as_json(judged), allow_nan=False)
    assert json.loads(text)[0]["verdict"] in set(ClaimVerdict)


def test_what_was_changed_after_a_report_is_listed_once_for_each_reason() -> None:
    day = date(2026, 11, 22)
    some = [Revision(value=value, changed=day, because=why) for value, why in (("a", "x"), ("b", "y"), ("c", "x"))]
    assert revisions([*some, Revision(value="as it was")]) == "- 2026-11-22, x: *a*; *c*\n- 2026-11-22, y: *b*"
    judged = judge({claim.value: [1.0] for claim in claims()})
    assert "changed 20" not in scorecard_table(judged, dict.fromkeys(STUDIES, "coldloop"))


def test_the_page_holds_its_pictures_and_colours_its_verdicts(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(b"\x89PNG")
    judged = judge({claim.value: [1.0] for claim in claims()})
    markdown = (
        f"{scorecard_table(judged, dict.fromkeys(STUDIES, 'coldloop'))}\n\n![p](p.png)\n\n{deviations(judged, {}, {})}"
    )
    page = as_page("t & t", markdown, tmp_path)
    assert 'src="data:image/png;base64,' in page
    assert 'src="p.png"' not in page
    assert "<title>t &amp; t</title>" in page
    assert '<td class="not-reproduced">not reproduced</td>' in page
    assert page.count("<tr>") == len(judged) + 1


def test_the_points_are_whole() -> None:
    comparison = published_comparison()
    assert {solver: len(points["J_BF"]) for solver, points in comparison.items()} == {"ode": 18, "qpoases": 18}
    assert [len(points["tau_u_s"]) for points in published_periods().values()] == [9] * 6
