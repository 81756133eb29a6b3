"""Writes the C99 for a process, and problems of it.

`problems` has vectors and guess of each, `answers` what the kernels make of them, in words of 4 bytes, lowest first.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coldloop_export.c_files import OdeExport
from coldloop_export.golden import PER_PROBLEM, GoldenVector, paper_settings, record

GIVEN = (*PER_PROBLEM, "guess")


def words(arrays: Iterable[NDArray[np.float32]]) -> bytes:
    return b"".join(np.asarray(each, "<i4" if each.dtype.kind == "i" else "<f4").tobytes() for each in arrays)


def given(vector: GoldenVector) -> bytes:
    return words([*(getattr(vector.problem, name) for name in PER_PROBLEM), vector.guess])


def found(vector: GoldenVector) -> bytes:
    return words(map(np.asarray, vector.answer[:4]))


def write(model: Path, folder: Path, ticks: int, loads: Iterable[str]) -> int:
    """Write sources and files of the problems of a run of each load; return how many there are."""
    runs = [record(paper_settings(model), ticks, load) for load in loads]
    first = runs[0].vectors[0]
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in OdeExport(runs[0].method, [first]).files().items():
        (folder / name).write_text(text, encoding="ascii")
    vectors = [each for run in runs for each in run.vectors]
    (folder / "problems").write_bytes(b"".join(map(given, vectors)))
    (folder / "answers").write_bytes(b"".join(map(found, vectors)))
    return len(vectors)
