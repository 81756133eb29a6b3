"""The process that the programs of this interpreter are loaded with, once and for all, as a PLC with its project.

The environment names its model file: `COLDLOOP_PROCESS`. Registers, problem, kernels and page follow from it. Without
it the process is the cold box.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from coldloop.errors import ModelFileError
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.declaration import VARIABLE, Process
from coldloop.process.model_file import read_document

REMEDY: Final = "make one with `coldloop process FILE --out MODEL`, or unset the variable"


def process_of(path: Path) -> Process:
    """Return the process of a model file.

    Raises:
        ModelFileError: The file cannot be read, or says nothing of a process.
    """
    document = read_document(path, REMEDY)
    if "process" not in document:
        raise ModelFileError(f"{path}: the model file of a cold box, which declares no process; {REMEDY}")
    try:
        return Process.of({"disturbances": _disturbances(document)} | document["process"])
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"{path}: process: {error}; {REMEDY}") from error


def _disturbances(document: Mapping[str, Any]) -> list[str]:
    """Return which outputs measure a disturbance by a model file of version 0.3: those of states that nothing moves."""
    rows = zip(document["state_names"], document["A"], document["B"], document["F"], strict=True)
    holding = {name for name, A, B, F in rows if not any((*A, *B, F))}
    return [name for name in document["output_names"] if name in holding]


def _loaded() -> Process:
    if FILE is None:
        return COLD_BOX
    try:
        return process_of(FILE)
    except ModelFileError as error:
        sys.stderr.write(f"{VARIABLE}: {error}\n")
        raise SystemExit(2) from None


FILE: Final = Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None
"""The model file of the process; None is the cold box."""
PROCESS: Final = _loaded()
"""The process."""
