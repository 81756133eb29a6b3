"""Interpreters that run configurations, one for each core: the cold box's, and those of other processes."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from coldloop.config import PREFIX
from tests.harness.traces.configurations import COLD_BOX, CONFIGURATIONS
from tests.harness.traces.record import Found, RecordError

ROOT: Final = Path(__file__).parents[3]
ONE_PROCESSOR: Final = {"OPENBLAS_CORETYPE": "Nehalem", "OPENBLAS_NUM_THREADS": "1"}
"""Lets OpenBLAS compute as on any x86-64: models of process files are made with LAPACK, whose last bits depend on the
kind of processor. The cold box needs none of it."""


def printed(names: Sequence[str], more: Mapping[str, str]) -> Found:
    """Return what an interpreter finds that runs these configurations, with more variables.

    Raises:
        RecordError: It failed.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith(PREFIX)} | more
    command = [sys.executable, "-m", "tests.harness.traces.runs", *names]
    done = subprocess.run(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise RecordError(f"an interpreter for {', '.join(names)} has failed, as it says above")
    found: Found = json.loads(done.stdout)
    return found


def found_now(names: Sequence[str]) -> Found:
    """Run configurations; return what they left behind, together.

    Raises:
        RecordError: An interpreter failed.
    """
    cores = os.cpu_count() or 1
    own = [name for name in names if CONFIGURATIONS[name].process == COLD_BOX]
    others = [name for name in names if name not in own]
    jobs = [(some[core::cores], more) for some, more in ((own, {}), (others, ONE_PROCESSOR)) for core in range(cores)]
    with ThreadPoolExecutor(cores) as pool:
        together, *parts = pool.map(printed, *zip(*(job for job in jobs if job[0]), strict=True))
    for part in parts:
        together["configurations"].update(part["configurations"])
        together["names"].update(part["names"])
    return together
