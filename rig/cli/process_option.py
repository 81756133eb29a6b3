"""The option --process: what it names is what this interpreter, and the services it starts, are loaded with."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

from coldloop.errors import UsageError
from coldloop.kernels.cache_folder import find_cache_folder
from coldloop.parsing import parsed_json
from coldloop.process.declaration import VARIABLE, Process
from coldloop.text_file import held_file, read_bytes
from rig.interpreter import PYTHON

OPTION: Final = "--process"
TRUST: Final = "--trust"
READING: Final = ("report", "compare", "plot", "page", "export", "identify")
"""Commands that take names, units and bands of a process from the folder of a run, and execute nothing in it."""
LOADED: Final = "coldloop.process.loaded"
"""The module that reads it, once."""


def load_named_process(arguments: Sequence[str]) -> list[str]:
    """Load the process that the arguments name, before any module asks for it; return the arguments without it.

    Raises:
        UsageError: There is no file, or it cannot be made into a model file: what was said then is on standard error.
    """
    left, named = _split(arguments)
    if named is None and not os.environ.get(VARIABLE) and LOADED not in sys.modules:
        named = _of_run(left)
    if named is not None:
        path = Path(named)
        if not path.is_file():
            raise UsageError(f"{OPTION} {named}: no such file; name a process file or a model file")
        model = str((_made(path) if path.suffix == ".toml" else path).resolve())
        if LOADED in sys.modules and os.environ.get(VARIABLE) != model:
            raise UsageError(f"{OPTION} {named}: this interpreter is loaded with another process; begin a new one")
        os.environ[VARIABLE] = model
    return left


def _of_run(arguments: Sequence[str]) -> str | None:
    """Return the model file in the first folder of a run that a command only reads, or trusts; None for a cold box."""
    if not arguments or not (arguments[0] in READING or (arguments[0] == "rerun" and TRUST in arguments)):
        return None
    named = [each for before, each in pairwise(arguments) if before != "--out"]
    places = [Path(each).parent if Path(each).name == "manifest.json" else Path(each) for each in named]
    model = next(((place, "inputs/model.json") for place in places if (place / "manifest.json").is_file()), None)
    try:
        Process.of(parsed_json(read_bytes(held_file(*model, "restore it"), "restore it"))["process"] if model else {})
    except (UsageError, ValueError, TypeError, KeyError):  # the command itself says what is wrong
        return None
    return str(Path(*model)) if model else None


def _split(arguments: Sequence[str]) -> tuple[list[str], str | None]:
    left, named, rest = [], None, iter(arguments)
    for argument in rest:
        if argument == OPTION:
            named = next(rest, None)
            if named is None:
                raise UsageError(f"{OPTION}: name a process file or a model file")
        elif argument.startswith(f"{OPTION}="):
            named = argument.removeprefix(f"{OPTION}=")
        else:
            left.append(argument)
    return left, named


def _made(path: Path) -> Path:
    """Return the model file of a process file, made by a process of its own: this one is loaded with no process yet."""
    place = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]
    out = find_cache_folder("processes") / f"{path.stem}-{place}.json"
    environment = {name: value for name, value in os.environ.items() if name != VARIABLE}
    made = subprocess.run(  # noqa: S603 our own program
        [*PYTHON, "-m", "rig", "process", str(path), "--out", str(out)], env=environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    if made.returncode:
        last = made.stderr.strip().rpartition("\n")[2].removeprefix("coldloop: ")
        raise UsageError(last or f"{path}: cannot be made into a model file")
    warnings = (line for line in made.stdout.splitlines() if line.startswith("warning"))
    sys.stderr.writelines(f"coldloop: {path}: {line}\n" for line in warnings)
    return out
