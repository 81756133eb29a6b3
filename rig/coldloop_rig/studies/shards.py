"""Parts of a study that are done apart, such as by the jobs of an array, and put together afterwards.

Shard i of n has every n-th run of the study, from the i-th on. Its folder gets a record of what it is a part of, so
that shards of different options or versions are not mistaken for parts of one study.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from coldloop.errors import StudyError, UsageError
from coldloop.parsing import parsed_json
from coldloop_rig.results.folders import prepare_folder, write_json, writing
from coldloop_rig.studies.execution import Workers, checked_requests, perform_all
from coldloop_rig.studies.request import RunRequest, programs_digest
from coldloop_rig.studies.store import Store
from coldloop_rig.studies.study import RUNS, Study, StudyOptions

RECORDS: Final = "shard-*-of-*.json"


@dataclass(frozen=True)
class Shard:
    """One of several parts of a study."""

    number: int
    """From 1 on."""
    of: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the shard that is written as `2/7`.

        Raises:
            UsageError: It is none.
        """
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
    """What a shard is a part of."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    study: str
    shard: int
    of: int
    options: dict[str, Any]
    """Of the study."""
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
    """Do what is missing of a shard; return how many runs it has.

    Raises:
        ColdloopError: A run failed, or a file cannot be written.
    """
    requests = checked_requests(study, options, folder)
    record = ShardRecord.of_study(study, options, shard)
    path = folder / study.name / f"shard-{shard.number}-of-{shard.of}.json"
    with writing(path):
        write_json(path, record.model_dump())
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
    records = [(path, _read(path)) for source in sources for path in _records(study, source)]
    for path, record in records:
        _compare(path, record, ShardRecord.of_study(study, options, Shard(record.shard, record.of)))
    cuts = {record.of: path for path, record in records}
    if len(cuts) > 1:
        (of, path), (other, other_path) = list(cuts.items())[:2]
        raise UsageError(f"{other_path}: one of {other} shards, while {path} is one of {of}; merge shards of one set")
    return next(iter(cuts))


def _records(study: Study, source: Path) -> list[Path]:
    found = sorted((source / study.name).glob(RECORDS))
    if not found:
        raise UsageError(f"{source}: no shard of study {study.name}; name the --out folders of the shards")
    return found


def _read(path: Path) -> ShardRecord:
    try:
        return ShardRecord.model_validate_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; do this shard again") from None
    except (ValidationError, ValueError):
        raise UsageError(f"{path}: not the record of a shard; do this shard again") from None


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
