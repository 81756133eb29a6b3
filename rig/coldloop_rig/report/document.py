"""The report as Markdown and as one HTML page that holds its pictures."""

import base64
import html
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from markdown_it import MarkdownIt

from coldloop_rig.report.scorecard import Claim, ClaimVerdict, Judged, Revision, counted, counts
from coldloop_rig.text_tables import markdown_table

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
    rows = [
        (j.claim.figure, f"{j.claim.says}<br>*{j.claim.value}*{_marks(j.claim)}", _of_paper(j), _ours(j),
         _tolerance(j.claim), j.verdict, f"`{commands[j.claim.study]}`")
        for j in judged
    ]  # fmt: skip
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
    return PLACEHOLDER.sub(lambda found: _mean(values.get(found[1], ())), text)


def _mean(values: Sequence[float]) -> str:
    there = [value for value in values if math.isfinite(value)]
    return _number(sum(there) / len(there)) if there else "(not run)"


def deviations(judged: Sequence[Judged], explanations: Mapping[str, str], values: Mapping[str, Sequence[float]]) -> str:
    """Return what does not reproduce among what counts, each with what is known of why and the numbers for it."""
    lines = []
    for j in counted(judged):
        if j.verdict in (ClaimVerdict.PARTLY, ClaimVerdict.NOT_REPRODUCED):
            why = explained(explanations.get(j.claim.value, "Not explained yet."), values)
            lines.append(f"- **{j.verdict}: {j.claim.value}** ({j.claim.figure}): ours {_ours(j)}, "
                         f"paper {_of_paper(j)}. {why}")  # fmt: skip
    return "\n".join(lines) or "Everything that has data in the paper is reproduced."


def _marks(claim: Claim) -> str:
    """Return what a reader must know of a claim before its verdict."""
    return f"<br>**calibrated**: {claim.calibrated}" if claim.calibrated else ""


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
    body = re.sub(r'<img src="([^"]+)"', lambda match: f'<img src="{_embedded(folder / match[1])}"', body)
    for verdict in ClaimVerdict:
        body = body.replace(f"<td>{verdict}</td>", f'<td class="{verdict.replace(" ", "-")}">{verdict}</td>')
    head = (
        f'<meta charset="utf-8"><title>{html.escape(title)}</title><meta name="viewport" content="width=device-width">'
    )
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n{body}</body></html>\n'


def _embedded(picture: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}"
