"""Interpreters that run configurations: one for each process, and for the cold box one for each core."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final

from coldloop.config import PREFIX
from coldloop.process.declaration import VARIABLE
from tests.harness.traces.configurations import COLD_BOX, CONFIGURATIONS
from tests.harness.traces.record import Found, RecordError

MODELS: Final = "models"
"""No process: the interpreter that makes the model files."""
ROOT: Final = Path(__file__).parents[3]
ONE_PROCESSOR: Final = {"OPENBLAS_CORETYPE": "Nehalem", "OPENBLAS_NUM_THREADS": "1"}
"""Lets OpenBLAS compute as on any x86-64: models of process files are made with LAPACK, whose last bits depend on the
kind of processor. The cold box needs none of it."""


class Interpreters:
    """As many at once as there are cores."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._cores = os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self._cores)

    def found(self, names: Sequence[str]) -> Iterator[Found]:
        """Run configurations; yield what each interpreter has found.

        Raises:
            RecordError: One of them failed.
        """
        by_process: dict[str, list[str]] = {}
        for name in names:
            by_process.setdefault(CONFIGURATIONS[name].process, []).append(name)
        cold_box = by_process.pop(COLD_BOX, [])
        try:
            models = self._submit("--models", str(self._folder), *by_process, process=MODELS) if by_process else None
            shares = [cold_box[core :: self._cores] for core in range(self._cores)]
            futures = [self._submit(*share) for share in shares if share]
            if models:
                models.result()
            futures += [self._submit(*some, process=process) for process, some in by_process.items()]
            yield from (json.loads(future.result()) for future in futures)
        finally:
            self._pool.shutdown(cancel_futures=True)

    def _submit(self, *words: str, process: str = COLD_BOX) -> "Future[str]":
        return self._pool.submit(self._printed, words, process)

    def _printed(self, words: Sequence[str], process: str) -> str:
        """Return what an interpreter prints that is loaded with a process."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith(PREFIX)}
        environment.pop(VARIABLE, None)
        if process != COLD_BOX:
            environment |= ONE_PROCESSOR
        if process not in (COLD_BOX, MODELS):
            environment[VARIABLE] = str(self._folder / process / "model.json")
        command = [sys.executable, "-m", "tests.harness.traces.runs", *words]
        done = subprocess.run(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            raise RecordError(f"an interpreter for the process {process} has failed, as it says above")
        return done.stdout


def found_now(names: Sequence[str]) -> Found:
    """Run configurations; return what they left behind, together.

    Raises:
        RecordError: An interpreter failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        parts = list(Interpreters(Path(folder)).found(names))
    together = parts[0]
    for part in parts[1:]:
        together["configurations"].update(part["configurations"])
        together["names"].update(part["names"])
    return together
