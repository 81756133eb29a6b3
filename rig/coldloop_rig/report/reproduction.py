"""Every study of the paper, one report, and a scorecard."""

import platform
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from coldloop import __version__
from coldloop.parsing import parsed_toml
from coldloop.whole_file import whole_text
from coldloop_rig.report.document import as_page, deviations, findings, revisions, scorecard_table, verdict_counts
from coldloop_rig.report.scorecard import COUNTED, TOLERANCES, Judged, as_json, counted, counts, judge, withdrawn
from coldloop_rig.results.folders import write_json, writing
from coldloop_rig.studies import STUDIES
from coldloop_rig.studies.execution import Workers
from coldloop_rig.studies.results import conduct, section
from coldloop_rig.studies.study import USUAL_DRAWS, StudyOptions, StudyResult

EXPLANATIONS = TOLERANCES.with_name("explanations.toml")
SLIPS = TOLERANCES.with_name("slips.md")
TITLE = "Coldloop: the paper, figure by figure"
QUICK = "**A quick run: ten minutes a run and one draw. Its verdicts say that it works, not more.**"
READING = (
    "Tolerances were set before the runs (`rig/coldloop_rig/report/tolerances.toml`): {changed} of these {counted} "
    "claims and aims were added or changed after a report, and {withdrawn} were withdrawn, which is listed below with "
    "date and reason. The paper's numbers are computed from the points of its figures by the same formulas as ours. "
    "Ours are the mean over the draws, its 95 % interval (`rig/coldloop_rig/studies/intervals.py`), and the range of "
    "the draws. A claim is reproduced if this interval is within the tolerance, or its only value; until 2026-11-23 "
    "all draws had to be. Weights, loads and operating point are this project's own, for the paper leaves them open: "
    "costs are compared as ratios. The load of the solver comparison was chosen after the tolerances, by a few hours "
    "of several families, so that throttled qpOASES predicts violations as large as in the paper (c1) and converged "
    "qpOASES pays more for violation than for deviation: what depends on that is marked as calibrated. Checks "
    "(arithmetic, or fitted to the paper's own numbers) and variants (milder forms of a claim) are in a table of their "
    "own and do not count."
)


def reproduce(options: StudyOptions, workers: Workers, out: Path) -> tuple[str, int]:
    """Do all studies and write the report; return what to print, and in how many runs updates had no answer.

    Raises:
        ColdloopError: A study failed, or the report cannot be written.
    """
    began = time.monotonic()
    results = {name: conduct(study, options, workers, out) for name, study in STUDIES.items()}
    judged = judge(_values(results))
    minutes = (time.monotonic() - began) / 60
    text = report(options, results, judged, f"{minutes:.0f} min with {workers.count} workers")
    with writing(out):
        write_json(
            out / "scorecard.json",
            {"coldloop": __version__, "seeds": options.seeds, "quick": options.quick, "counts": counts(judged),
             "claims": as_json(judged)},
        )  # fmt: skip
        whole_text(out / "report.md", text)
        whole_text(out / "report.html", as_page(TITLE, text, out))
    text = f"{verdict_counts(judged)}; {minutes:.1f} min\nreport in {out / 'report.html'}\n"
    return text, sum(result.failed_runs for result in results.values())


def _values(results: Mapping[str, StudyResult]) -> dict[str, list[float]]:
    return {name: values for result in results.values() for name, values in result.values.items()}


def circumstances(options: StudyOptions, effort: str) -> str:
    """Return the generated line below the title."""
    return (
        f"Coldloop {__version__}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}; "
        f"{_draws(options)}; {effort}, what was kept from before included."
    )


def _draws(options: StudyOptions) -> str:
    if options.quick or options.seeds:
        return f"{len(options.draws)} draw(s) of each load"
    return f"{USUAL_DRAWS} draws of each load, where a study has no other number"


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
