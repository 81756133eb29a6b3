"""The files of a study: a table of all runs, its figures, and its section of the report."""

import csv
import io
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from coldloop import __version__
from coldloop.whole_file import whole_text
from coldloop_rig.figures.run_plot import save_figure
from coldloop_rig.results.folders import installed_version, write_json, writing
from coldloop_rig.studies.execution import Workers, checked_requests, perform_all
from coldloop_rig.studies.outside_parts import outside_digests
from coldloop_rig.studies.request import LIBRARIES, RunRequest, programs_digest
from coldloop_rig.studies.settings import settings_of
from coldloop_rig.studies.store import Store
from coldloop_rig.studies.study import RUNS, Study, StudyOptions, StudyResult
from coldloop_rig.text_tables import markdown_table


def conduct(study: Study, options: StudyOptions, workers: Workers, folder: Path) -> StudyResult:
    """Do what is missing of a study and write its files to `folder / study.name`.

    Raises:
        ColdloopError: A run failed, or a file cannot be written.
    """
    requests = checked_requests(study, options, folder)
    outcomes = perform_all(requests, Store(folder / RUNS), workers, study.name)
    result = study.evaluate(options, outcomes)
    result.failed_runs = sum(outcome.failed_updates > 0 for outcome in outcomes.values())
    with writing(folder / study.name):
        _write(study, result, folder / study.name)
        write_json(folder / study.name / "manifest.json", _manifest(study, options, requests))
    return result


def _manifest(study: Study, options: StudyOptions, requests: Sequence[RunRequest]) -> dict[str, Any]:
    """Return what the study was: versions, options, and its runs, each with the name of its file in `runs`."""
    outside: dict[str, str] = {}
    for assignments in {request.assignments for request in requests}:
        outside |= outside_digests(settings_of(assignments).optimizer_plc.program.outside)
    runs = [
        {
            "load": request.load, "draw": request.draw, "duration_s": request.ticks * options.process.tick_s,
            "updating_period_s": request.updating_period_s or "adaptive", "settings": request.assignments,
            "outcome": f"{request.digest}.json",
        }
        for request in requests
    ]  # fmt: skip
    return {
        "study": study.name, "coldloop": __version__, "python": platform.python_version(),
        "dependencies": {name: installed_version(name) for name in LIBRARIES}, "programs": programs_digest(),
        "outside": outside, "options": asdict(options), "runs": runs,
    }  # fmt: skip


def _write(study: Study, result: StudyResult, folder: Path) -> None:
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(result.columns)
    writer.writerows(result.rows)
    whole_text(folder / "results.csv", table.getvalue())
    for name, figure in result.figures.items():
        save_figure(figure, folder / figure_file(name))
        save_figure(figure, (folder / figure_file(name)).with_suffix(".pdf"))
    whole_text(folder / "section.md", f"# {study.title}\n\n{section(result)}")


def figure_file(name: str) -> str:
    """Return the file name of a figure; LaTeX takes `%` for a comment."""
    return re.sub(r"[^\w.-]+", "-", name) + ".png"


LONGEST_TABLE = 24
"""Rows that a section shows; the file has them all."""


def section(result: StudyResult, folder: str = "") -> str:
    """Return figures, remarks and, if it is shown, the table as Markdown; figures are looked for in `folder`."""
    parts = [f"![{name}]({folder}{figure_file(name)})" for name in result.figures]
    parts += result.remarks
    if result.rows and (result.always_shown or len(result.rows) <= LONGEST_TABLE):
        parts.append(markdown_table(result.columns, result.rows))
    return "\n\n".join(parts) + "\n"
