"""A study done: as a whole, with its table, figures and section of the report, or in shards, as by jobs of an array.

Shard i of n has every n-th run of the study, from the i-th on. Its folder gets a record of what it is a part of, so
that shards of different options or versions are not mistaken for parts of one study.
"""

import csv
import hashlib
import io
import json
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict

from coldloop import __version__
from coldloop.errors import StudyError, UsageError
from coldloop.parsing import parsed_json
from coldloop.text_file import whole_text
from coldloop_rig.figures.plot import save_figure
from coldloop_rig.results.folders import installed_version, prepare_folder, write_json, writing
from coldloop_rig.text_tables import markdown_table
from coldloop_studies.execution import Store, Workers, checked_requests, perform_all
from coldloop_studies.request import LIBRARIES, RunRequest, programs_digest
from coldloop_studies.settings import outside_digests, settings_of
from coldloop_studies.study import RUNS, Study, StudyOptions, StudyResult


def conduct(study: Study, options: StudyOptions, workers: Workers, folder: Path) -> StudyResult:
    """Do the missing runs of a study and write its files to `folder / study.name`.

    Raises:
        ColdloopError: A run failed, or a file cannot be written.
    """
    requests = checked_requests(study, options, folder)
    outcomes = perform_all(requests, Store(folder / RUNS), workers, study.name)
    result = study.evaluate(options, outcomes)
    result.failed_runs = sum(outcome.failed_updates > 0 for outcome in outcomes.values())
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
    manifest = {
        "study": study.name, "coldloop": __version__, "python": platform.python_version(),
        "dependencies": {name: installed_version(name) for name in LIBRARIES}, "programs": programs_digest(),
        "outside": outside, "options": asdict(options), "runs": runs,
    }  # fmt: skip
    with writing(folder / study.name):
        _write(study, result, folder / study.name)
        write_json(folder / study.name / "manifest.json", manifest)
    return result


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


def section(result: StudyResult, folder: str = "") -> str:
    """Return figures, remarks and a table of up to 24 rows as Markdown; figures are looked for in `folder`."""
    parts = [f"![{name}]({folder}{figure_file(name)})" for name in result.figures]
    parts += result.remarks
    if result.rows and (result.always_shown or len(result.rows) <= 24):
        parts.append(markdown_table(result.columns, result.rows))
    return "\n\n".join(parts) + "\n"


@dataclass(frozen=True)
class Shard:
    """One of several parts of a study."""

    number: int
    """Number of the shard, from 1 to `of`."""
    of: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the shard that is written as `2/7`. Raises UsageError if it is none."""
        number, _, of = text.partition("/")
        if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
            raise UsageError(f"--shard {text}: write i/n with i from 1 to n, such as 2/7")
        return cls(int(number), int(of))

    def __str__(self) -> str:
        """Write it as it is read."""
        return f"{self.number}/{self.of}"

    def part(self, requests: Sequence[RunRequest]) -> list[RunRequest]:
        """Return the runs of this shard."""
        return unique(requests)[self.number - 1 :: self.of]


class ShardRecord(BaseModel):
    """Study, options and programs that a shard is a part of."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    study: str
    shard: int
    of: int
    options: dict[str, Any]
    """Options of the study."""
    programs: str
    """Digest of the programs that do its runs."""
    runs: str
    """Digest of all runs of the study."""

    @classmethod
    def of_study(cls, study: Study, options: StudyOptions, shard: Shard) -> Self:
        """Return the record of a shard that is about to be done."""
        digests = [request.digest for request in unique(study.requests(options))]
        runs = hashlib.sha256("\n".join(digests).encode()).hexdigest()[:20]
        plain = parsed_json(json.dumps(asdict(options)))
        return cls(
            study=study.name, shard=shard.number, of=shard.of, options=plain, programs=programs_digest(), runs=runs
        )


def unique(requests: Sequence[RunRequest]) -> list[RunRequest]:
    """Return one request for each run, in their order: the same run may be asked for in several ways."""
    found: dict[str, RunRequest] = {}
    for request in requests:
        found.setdefault(request.digest, request)
    return list(found.values())


def conduct_shard(study: Study, options: StudyOptions, workers: Workers, folder: Path, shard: Shard) -> int:
    """Do the missing runs of a shard; return how many runs it has.

    Raises:
        ColdloopError: A run failed, or a file cannot be written.
    """
    requests = checked_requests(study, options, folder)
    path = folder / study.name / f"shard-{shard.number}-of-{shard.of}.json"
    with writing(path):
        write_json(path, ShardRecord.of_study(study, options, shard).model_dump())
    mine = shard.part(requests)
    perform_all(mine, Store(folder / RUNS), workers, f"{study.name} {shard}")
    return len(mine)


def merge(study: Study, options: StudyOptions, sources: Sequence[Path], folder: Path) -> None:
    """Gather the runs of all shards in one store.

    Raises:
        UsageError: A folder has no shard of this study with these options, done by these programs.
        StudyError: Runs are missing.
        ResultsError: A file cannot be written.
    """
    of = _common_number(study, options, sources)
    prepare_folder(folder / RUNS)
    target = Store(folder / RUNS)
    requests = unique(study.requests(options))
    missing = []
    for place, request in enumerate(requests):
        if target.find(request) is not None:
            continue
        found = (Store(source / RUNS).text(request) for source in sources)
        text = next((text for text in found if text is not None), None)
        if text is None:
            missing.append(f"{place % of + 1}/{of}")
        else:
            target.keep(request, text)
    if missing:
        shards = ", ".join(sorted(set(missing), key=lambda shard: int(shard.partition("/")[0])))
        raise StudyError(
            f"study {study.name}: {len(missing)} of {len(requests)} runs are missing or damaged, of shards {shards}; "
            "do these with --shard, then merge again"
        )


def _common_number(study: Study, options: StudyOptions, sources: Sequence[Path]) -> int:
    """Return in how many shards the study was cut; all records must agree, with each other and with what is asked."""
    cuts = {}
    for source in sources:
        paths = sorted((source / study.name).glob("shard-*-of-*.json"))
        if not paths:
            raise UsageError(f"{source}: no shard of study {study.name}; name the --out folders of the shards")
        for path in paths:
            try:
                record = ShardRecord.model_validate_json(path.read_text(encoding="utf-8"))
            except OSError as error:
                raise UsageError(f"{path}: {error.strerror}; do this shard again") from None
            except ValueError:
                raise UsageError(f"{path}: not the record of a shard; do this shard again") from None
            _compare(path, record, ShardRecord.of_study(study, options, Shard(record.shard, record.of)))
            cuts[record.of] = path
    if len(cuts) > 1:
        (of, path), (other, other_path) = list(cuts.items())[:2]
        raise UsageError(f"{other_path}: one of {other} shards, while {path} is one of {of}; merge shards of one set")
    return next(iter(cuts))


def _compare(path: Path, record: ShardRecord, wanted: ShardRecord) -> None:
    if record.programs != wanted.programs:
        raise UsageError(f"{path}: done by another version of Coldloop; do all shards and the merge with the same one")
    names = {**record.options, **wanted.options}
    different = [
        f"{name} {record.options.get(name)} there, {wanted.options.get(name)} here"
        for name in names if record.options.get(name) != wanted.options.get(name)
    ]  # fmt: skip
    if different or record.runs != wanted.runs:
        reason = "; ".join(different) or "load files differ"
        raise UsageError(f"{path}: of another configuration ({reason}); give all shards and the merge the same options")
