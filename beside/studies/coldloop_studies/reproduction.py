"""All studies by name, and the reproduction of the paper: claims with tolerance and verdict, and the report."""

import base64
import html
import math
import platform
import re
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, Self

import numpy as np
from markdown_it import MarkdownIt
from pydantic import BaseModel, BeforeValidator, ConfigDict, model_validator

from coldloop import __version__
from coldloop.text import parsed_toml, whole_text
from coldloop_rig.plc_sizing import operations, plc
from coldloop_rig.plc_sizing.intervals import Interval, geometric_mean, interval_of_mean
from coldloop_rig.results.run_folder import write_json, writing
from coldloop_rig.text_tables import markdown_table
from coldloop_studies.any_process import COMPARE, PERIODS
from coldloop_studies.controllers import CLASSICAL, CONTEST, ROBUSTNESS
from coldloop_studies.drawing import published_comparison, published_periods
from coldloop_studies.execution import Workers, conduct, section
from coldloop_studies.penalties import PENALTIES
from coldloop_studies.reference_plc import CHOLESKY, SINGLE_PRECISION, SLOW_DOWN, SPEED
from coldloop_studies.refrigerator import COUPLING, DISTURBANCES
from coldloop_studies.settings import settings_of
from coldloop_studies.solver_comparison import SOLVER_COMPARISON, measures
from coldloop_studies.study import USUAL_DRAWS, StudyOptions, StudyResult
from coldloop_studies.trajectories import BUS, COURSES, TRADE_OFF
from coldloop_studies.updating_period import UPDATING_PERIOD, is_inside

STUDIES: Final = {study.name: study for study in (
    CHOLESKY, *COURSES[:2], SOLVER_COMPARISON, COURSES[2], UPDATING_PERIOD, *BUS, TRADE_OFF, CLASSICAL,
    SINGLE_PRECISION, COUPLING, DISTURBANCES,
)}  # fmt: skip
"""Studies of the report, in the order of the paper."""
APART: Final = {study.name: study for study in (ROBUSTNESS, CONTEST, PENALTIES, PERIODS, COMPARE)}
"""Studies that are too long for the report."""

TOLERANCES: Final = Path(__file__).with_name("tolerances.toml")
FROM_POINTS: Final = "points"


def _limits(value: object) -> object:
    """Read "-" as no limit."""
    if not isinstance(value, list) or len(value) != 2:
        return value
    return tuple(
        limit if limit != "-" else open_end for limit, open_end in zip(value, (-math.inf, math.inf), strict=True)
    )


Range = Annotated[tuple[float, float], BeforeValidator(_limits)]


class ClaimVerdict(StrEnum):
    """Result of a claim."""

    REPRODUCED = "reproduced"
    PARTLY = "partly"
    NOT_REPRODUCED = "not reproduced"
    NO_DATA = "no data in the paper"
    NOT_RUN = "not run"


class ClaimKind(StrEnum):
    """Kind of a claim, which decides whether its verdict counts."""

    CLAIM = "claim"
    """The paper's."""
    AIM = "aim"
    """This project's own."""
    CHECK = "check"
    """Arithmetic, or fitted to the paper's own numbers: it holds unless something is broken, and does not count."""
    VARIANT = "variant"
    """A milder form of a claim; it does not count."""


COUNTED: Final = (ClaimKind.CLAIM, ClaimKind.AIM)


class Revision(BaseModel):
    """Revision after a report: date and reason of an addition, change or withdrawal; an original claim has neither."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    value: str
    changed: date | None = None
    because: str = ""

    @model_validator(mode="after")
    def _dated_with_a_reason(self) -> Self:
        if (self.changed is None) != (not self.because):
            raise ValueError(f"{self.value}: a change has a date (`changed`) and a reason (`because`)")
        return self


class Claim(Revision):
    """A claim of the paper, an aim of this project, a check or a variant."""

    study: str
    kind: ClaimKind = ClaimKind.CLAIM
    figure: str
    says: str
    of_paper: str
    why: str
    reproduced: Range | None = None
    partly: Range | None = None
    calibrated: str = ""
    """Choices that were made with this value in view; empty if there were none."""
    signed: bool = False
    """Whether a value of a draw can be negative."""

    def mean(self, values: Sequence[float]) -> Interval:
        """Return the mean over the draws that have a value, with its interval."""
        return interval_of_mean(values, above=-math.inf if self.signed else 0.0)


class Judged(NamedTuple):
    """A claim with what was found."""

    claim: Claim
    values: tuple[float, ...]
    """One a draw; empty where the study gave none."""
    of_paper: float | None
    """Value of the paper, from the points of its figures; None where it has none."""
    verdict: ClaimVerdict


@cache
def _document() -> dict[str, Any]:
    return parsed_toml(TOLERANCES.read_text(encoding="utf-8"))


@cache
def claims() -> tuple[Claim, ...]:
    """Return all claims, in the order of the paper."""
    return tuple(Claim.model_validate(one) for one in _document()["claim"])


@cache
def withdrawn() -> tuple[Revision, ...]:
    """Return what was claimed in an earlier report."""
    return tuple(Revision.model_validate(one) for one in _document()["withdrawn"])


def judge(values: Mapping[str, Sequence[float]]) -> list[Judged]:
    """Return every claim, judged by the values that the studies gave."""
    found = []
    for claim in claims():
        given = tuple(values.get(claim.value, ()))
        of_paper = paper_values().get(claim.value) if claim.of_paper == FROM_POINTS else None
        found.append(Judged(claim, given, of_paper, verdict(claim, given)))
    return found


def verdict(claim: Claim, values: tuple[float, ...]) -> ClaimVerdict:
    """Return the verdict on a claim, given one value a draw, by the 95 % interval of their mean.

    A single value is judged as it is. A claim that has no value in some draw has no mean, and is not reproduced.
    """
    if not values:
        return ClaimVerdict.NOT_RUN
    if claim.reproduced is None or claim.partly is None:
        return ClaimVerdict.NO_DATA
    if not all(map(math.isfinite, values)):
        return ClaimVerdict.NOT_REPRODUCED
    mean, *interval = claim.mean(values)
    ends = interval if len(values) > 1 else values
    if _within(claim.reproduced, *ends):
        return ClaimVerdict.REPRODUCED
    if _within(claim.reproduced, mean) or _within(claim.partly, *ends):
        return ClaimVerdict.PARTLY
    return ClaimVerdict.NOT_REPRODUCED


def _within(limits: tuple[float, float], *values: float) -> bool:
    return all(limits[0] <= value <= limits[1] for value in values)


@cache
def paper_values() -> Mapping[str, float]:
    """Return what the points of the paper's figures give, by the formulas that ours are computed with."""
    comparison = published_comparison()
    powers = comparison["ode"]["normalized_power"]
    values = measures(powers, comparison)
    closed = {solver: points["J_BF"] for solver, points in comparison.items()}
    one = int(np.argmin(np.abs(powers - 1.0)))
    values["limited: J_BF"] = float(closed["qpoases"][one] / closed["qpoases"][-1])
    values["trajectories: J_BF"] = float(closed["ode"][one] / closed["qpoases"][-1])
    values["trajectories: J_BF of qpOASES over ODE"] = float(closed["qpoases"][one] / closed["ode"][one])
    size, plc_s, laptop_s = plc.cholesky_times()
    speed = np.array([operations.dense_cholesky(n).flops for n in size.tolist()]) / plc_s / 1e6
    values[SPEED] = float(speed[size >= 50].mean())
    values[SLOW_DOWN] = float((plc_s / laptop_s)[size >= 40].mean())
    hours = list(published_periods().values())
    fixed = np.array([hour["cost_fixed_pct"] for hour in hours])
    adaptive = np.array([hour["cost_adaptive_pct"][0] for hour in hours])
    best = fixed.min(axis=1)
    ends = np.maximum(fixed[:, 0], fixed[:, -1])
    literal = "Algorithm 1, hours"
    inside = float(np.mean([is_inside(hour) for hour in fixed]))
    return {
        **values,
        "interior optimum from 1 to 5 s, share of hours": inside,
        "interior optimum from 1 to 5 s, share of hours, as printed": inside,
        "worst end over best from 1 to 5 s, smallest of hours": float((ends / best).min()),
        f"better than the mean fixed period, share: {literal}": float((adaptive < fixed.mean(axis=1)).mean()),
        f"best of all, share: {literal}": float((adaptive < best).mean()),
        f"within 2 % of the best fixed period, share: {literal}": float((adaptive <= 1.02 * best).mean()),
        f"cost over that of the best fixed period, geometric mean: {literal}": geometric_mean(adaptive / best),
    }


def counted(judged: Sequence[Judged]) -> list[Judged]:
    """Return those whose verdicts count."""
    return [j for j in judged if j.claim.kind in COUNTED]


def counts(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """Return how often each verdict was given, to claims of the paper and to aims of this project; nothing else counts.

    Calibrated claims are among them, and counted once more by themselves.
    """
    some = counted(judged)
    groups = {
        "claims of the paper": [j for j in some if j.claim.kind is ClaimKind.CLAIM],
        "among them calibrated": [j for j in some if j.claim.kind is ClaimKind.CLAIM and j.claim.calibrated],
        "aims of this project": [j for j in some if j.claim.kind is ClaimKind.AIM],
    }
    return {
        name: {one.value: sum(j.verdict is one for j in group) for one in ClaimVerdict}
        for name, group in groups.items()
    }


def as_json(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """Return the scorecard as plain data."""
    return [
        {
            **j.claim.model_dump(mode="json", exclude={"reproduced", "partly"}),
            **{name: limits and [limit if math.isfinite(limit) else None for limit in limits]
               for name, limits in (("reproduced", j.claim.reproduced), ("partly", j.claim.partly))},
            "paper": j.of_paper,
            "values": [value if math.isfinite(value) else None for value in j.values],
            "verdict": j.verdict,
        }
        for j in judged
    ]  # fmt: skip


STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2733; max-width: 76rem; margin: 2rem auto; padding: 0 1.5rem; }
h1, h2, h3 { line-height: 1.2; } h2 { margin-top: 3rem; border-bottom: 1px solid #d5dce3; padding-bottom: .3rem; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; display: block; overflow-x: auto; }
th, td { border: 1px solid #d5dce3; padding: .3rem .5rem; text-align: left; vertical-align: top; }
th { background: #eef2f5; } img { max-width: 100%; } code { font-size: 12px; background: #f3f5f7; padding: 0 .2em; }
td.reproduced { background: #e3f1e6; } td.partly { background: #fdf3d8; } td.not-reproduced { background: #f9e0dc; }
td.no-data-in-the-paper { background: #eef2f5; }
"""


def verdict_counts(judged: Sequence[Judged]) -> str:
    """Return how often each verdict was given, in words."""
    return "; ".join(
        f"{group}: " + ", ".join(f"{number} {verdict}" for verdict, number in numbers.items() if number)
        for group, numbers in counts(judged).items()
    )


def scorecard_table(judged: Sequence[Judged], commands: Mapping[str, str]) -> str:
    """Return a row for each claim; `commands` says how each study is repeated."""
    header = ("figure", "claim", "paper's value", "ours", "tolerance and why", "verdict", "command")
    rows = []
    for j in judged:
        mark = f"<br>**calibrated**: {j.claim.calibrated}" if j.claim.calibrated else ""
        said = f"{j.claim.says}<br>*{j.claim.value}*{mark}"
        command = f"`{commands[j.claim.study]}`"
        rows.append((j.claim.figure, said, _of_paper(j), _ours(j), _tolerance(j.claim), j.verdict, command))
    return markdown_table(header, rows)


def findings(judged: Sequence[Judged]) -> str:
    """Return our values by verdict, with the paper's where they are computed from its points."""
    found: dict[ClaimVerdict, list[str]] = {verdict: [] for verdict in ClaimVerdict}
    for j in judged:
        paper = "" if j.of_paper is None else f" (paper {_of_paper(j)})"
        found[j.verdict].append(f"*{j.claim.value}* {j.claim.mean(j.values).brief()}{paper}")
    return "\n".join(f"- **{verdict}**: {'; '.join(some)}" for verdict, some in found.items() if some)


PLACEHOLDER: Final = re.compile(r"\{([^{}]+)\}")
"""The name of a value in an explanation: its number is put there from the results."""


def explained(text: str, values: Mapping[str, Sequence[float]]) -> str:
    """Return an explanation with the means of the values that it names; what was not run is said to be so."""

    def mean(found: re.Match[str]) -> str:
        there = [value for value in values.get(found[1], ()) if math.isfinite(value)]
        return _number(sum(there) / len(there)) if there else "(not run)"

    return PLACEHOLDER.sub(mean, text)


def deviations(judged: Sequence[Judged], explanations: Mapping[str, str], values: Mapping[str, Sequence[float]]) -> str:
    """Return what does not reproduce among what counts, each with what is known of why and the numbers for it."""
    lines = []
    for j in counted(judged):
        if j.verdict in (ClaimVerdict.PARTLY, ClaimVerdict.NOT_REPRODUCED):
            why = explained(explanations.get(j.claim.value, "Not explained yet."), values)
            lines.append(f"- **{j.verdict}: {j.claim.value}** ({j.claim.figure}): ours {_ours(j)}, "
                         f"paper {_of_paper(j)}. {why}")  # fmt: skip
    return "\n".join(lines) or "Everything that has data in the paper is reproduced."


def revisions(some: Sequence[Revision]) -> str:
    """Return what was added, changed or withdrawn after a report, by date and reason."""
    by_reason: dict[tuple[str, str], list[str]] = {}
    for one in some:
        if one.changed is not None:
            by_reason.setdefault((one.changed.isoformat(), one.because), []).append(f"*{one.value}*")
    return "\n".join(f"- {day}, {because}: {'; '.join(values)}" for (day, because), values in by_reason.items())


def _of_paper(judged: Judged) -> str:
    return judged.claim.of_paper if judged.of_paper is None else _number(judged.of_paper)


def _ours(judged: Judged) -> str:
    """Return the mean over the draws with its interval, their range and their number."""
    claim, values, *_ = judged
    there = [value for value in values if math.isfinite(value)]
    if not there:
        return "none"
    if len(values) == 1:
        return _number(there[0])
    spread = f" ({_number(min(there))} to {_number(max(there))} in {len(there)} draws)"
    missing = f", none in {len(values) - len(there)}" if len(there) < len(values) else ""
    return claim.mean(there).brief() + spread + missing


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1e5 else f"{value:.3e}"


def _tolerance(claim: Claim) -> str:
    if claim.reproduced is None:
        return claim.why
    low, high = claim.reproduced
    if math.isinf(low):
        wanted = f"at most {_number(high)}"
    elif math.isinf(high):
        wanted = f"at least {_number(low)}"
    else:
        wanted = f"{_number(low)} to {_number(high)}"
    return f"{wanted}: {claim.why}"


def as_page(title: str, markdown: str, folder: Path) -> str:
    """Return a report as one HTML page; its pictures are looked for in `folder`."""
    body = MarkdownIt("commonmark", {"html": True}).enable("table").render(markdown)

    def embedded(picture: re.Match[str]) -> str:
        content = base64.b64encode((folder / picture[1]).read_bytes()).decode()
        return f'<img src="data:image/png;base64,{content}"'

    body = re.sub(r'<img src="([^"]+)"', embedded, body)
    for verdict in ClaimVerdict:
        body = body.replace(f"<td>{verdict}</td>", f'<td class="{verdict.replace(" ", "-")}">{verdict}</td>')
    head = (
        f'<meta charset="utf-8"><title>{html.escape(title)}</title><meta name="viewport" content="width=device-width">'
    )
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n{body}</body></html>\n'


EXPLANATIONS = TOLERANCES.with_name("explanations.toml")
SLIPS = TOLERANCES.with_name("slips.md")
TITLE = "Coldloop: the paper, figure by figure"
QUICK = "**A quick run: ten minutes a run and one draw. Its verdicts say that it works, not more.**"
READING = (
    "Tolerances were set before the runs (`beside/studies/coldloop_studies/tolerances.toml`): {changed} of these "
    "{counted} claims and aims were added or changed after a report, and {withdrawn} were withdrawn, which is listed "
    "below with date and reason. The paper's numbers are computed from the points of its figures by the same formulas "
    "as ours. Ours are the mean over the draws, its 95 % interval (`rig/coldloop_rig/plc_sizing/intervals.py`), and "
    "the range of the draws. A claim is reproduced if this interval is within the tolerance, or its only value; until "
    "2026-11-23 all draws had to be. Weights, loads and operating point are this project's own, for the paper leaves "
    "them open: costs are compared as ratios. The load of the solver comparison was chosen after the tolerances, by a "
    "few hours of several families, so that throttled qpOASES predicts violations as large as in the paper (c1) and "
    "converged qpOASES pays more for violation than for deviation: what depends on that is marked as calibrated. "
    "Checks (arithmetic, or fitted to the paper's own numbers) and variants (milder forms of a claim) are in a table "
    "of their own and do not count."
)


def reproduce(options: StudyOptions, workers: Workers, out: Path) -> tuple[str, int]:
    """Do all studies and write the report; return what to print, and in how many runs updates had no answer.

    Raises ColdloopError if a study failed, or the report cannot be written.
    """
    began = time.monotonic()
    results = {name: conduct(study, options, workers, out) for name, study in STUDIES.items()}
    judged = judge(_values(results))
    minutes = (time.monotonic() - began) / 60
    text = report(options, results, judged, f"{minutes:.0f} min with {workers.count} workers")
    with writing(out):
        write_json(
            out / "scorecard.json",
            {"coldloop": __version__, "seeds": options.seeds, "quick": options.quick, "settings": paper_settings(),
             "counts": counts(judged), "claims": as_json(judged)},
        )  # fmt: skip
        whole_text(out / "report.md", text)
        whole_text(out / "report.html", as_page(TITLE, text, out))
    text = f"{verdict_counts(judged)}; {minutes:.1f} min\nreport in {out / 'report.html'}\n"
    return text, sum(result.failed_runs for result in results.values())


def paper_settings() -> dict[str, Any]:
    """Return limits and program of the optimiser as the studies begin from them: the report holds for these."""
    settings = settings_of(())
    return {
        "limits": settings.limits.model_dump(mode="json"),
        "optimizer_plc.program": settings.optimizer_plc.program.model_dump(mode="json"),
    }


def _values(results: Mapping[str, StudyResult]) -> dict[str, list[float]]:
    return {name: values for result in results.values() for name, values in result.values.items()}


def circumstances(options: StudyOptions, effort: str) -> str:
    """Return the generated line below the title."""
    draws = f"{USUAL_DRAWS} draws of each load, where a study has no other number"
    if options.quick or options.seeds:
        draws = f"{len(options.draws)} draw(s) of each load"
    return (
        f"Coldloop {__version__}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}; "
        f"{draws}; {effort}, what was kept from before included."
    )


def lead(judged: Sequence[Judged]) -> str:
    """Return the verdicts, the findings, and how to read them."""
    some = counted(judged)
    changed = sum(j.claim.changed is not None for j in some)
    reading = READING.format(changed=changed, counted=len(some), withdrawn=len(withdrawn()))
    return f"**{verdict_counts(judged)}.**\n\n{findings(some)}\n\n{reading}"


def report(options: StudyOptions, results: Mapping[str, StudyResult], judged: Sequence[Judged], effort: str) -> str:
    """Return the report as Markdown."""
    scale = " --quick" if options.quick else f" --draws {options.seeds}" if options.seeds else ""
    commands = {name: f"coldloop study {name}{scale}" for name in STUDIES}
    explanations = parsed_toml(EXPLANATIONS.read_text(encoding="utf-8"))
    parts = [
        f"# {TITLE}",
        circumstances(options, effort),
        QUICK if options.quick else "",
        lead(judged),
        "## Scorecard",
        scorecard_table(counted(judged), commands),
        "## What does not reproduce, and why",
        deviations(judged, explanations, _values(results)),
        "## Checks and variants, which do not count",
        scorecard_table([j for j in judged if j.claim.kind not in COUNTED], commands),
        "## Added or changed after a report",
        revisions([j.claim for j in judged]),
        f"Withdrawn:\n\n{revisions(withdrawn())}",
        "## Slips in the paper, and how we read them",
        SLIPS.read_text(encoding="utf-8"),
    ]
    for name, result in results.items():
        parts += [f"## {STUDIES[name].title}", f"`{commands[name]}`", section(result, f"{name}/")]
    return "\n\n".join(parts) + "\n"
