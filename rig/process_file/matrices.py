"""A plant given as matrices: a file of them, or a state space that a Python file makes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.parsing import parsed_json
from plant.own.maker import LINEAR
from plant.own.python_class import made_by
from rig.process_file.declaration import ProcessFile
from rig.process_file.linear_model import Linearised, given_outputs, operating_point
from rig.process_file.source import source_of

Array = NDArray[np.float64]

NAMES: Final = "ABCDFG"
REMEDY: Final = "write it with numpy.savez(A=..., ...), or as JSON"


def from_matrices(file: ProcessFile, folder: Path, given: str) -> Linearised:
    """Return the model whose matrices are given: dx/dt = A x + B u + F w, y = C x + D u + G w.

    Args:
        file: The process file.
        folder: Where it is.
        given: An NPZ or JSON file there, or `file.py:NAME`, a state space.

    Raises:
        ColdloopError: It cannot be read, or does not fit the signals.
    """
    M = _of_state_space(file, folder, given) if ":" in given else _of_file(folder / given)
    missing = {"A", "B", "C"} - set(M)
    if missing:
        raise UsageError(f"{given}: no {' and '.join(sorted(missing))}; it needs A, B and C")
    n, m, p = len(np.atleast_2d(M["A"])), len(file.inputs), len(file.outputs)
    k = 1 + len(file.disturbances)
    shapes = {"A": (n, n), "B": (n, m), "F": (n, k), "C": (p, n), "D": (p, m), "G": (p, k)}
    full: dict[str, Any] = {name: M.get(name, np.zeros(shape)) for name, shape in shapes.items()}
    for name, shape in shapes.items():
        if full[name].ndim < len(shape) and full[name].size == np.prod(shape):  # a number, or a list that is a row
            full[name] = full[name].reshape(shape)
        if full[name].shape != shape:
            raise UsageError(
                f"{given}: {name} has shape {full[name].shape}, and not {shape} for {n} states, {m} inputs, {p} outputs"
                + (f", {k} disturbances" if k > 1 else "")
            )
    u, w = operating_point(file)
    return Linearised(
        **full, x0=np.zeros(n), u0=u, w0=w, y0=given_outputs(file), states={f"x{i}": "" for i in range(1, n + 1)},
        kind=LINEAR, parameters={}, digest="", error=0.0,
    )  # fmt: skip


def _of_file(path: Path) -> dict[str, Array]:
    try:
        if path.suffix == ".json":
            stored: Mapping[str, Any] = dict(parsed_json(path.read_bytes()))
        else:
            with np.load(path, allow_pickle=False) as archive:
                stored = dict(archive)
        return {name: np.array(stored[name], dtype=np.float64) for name in NAMES if name in stored}
    except (OSError, ValueError, TypeError, EOFError, RecursionError, MemoryError) as error:
        raise UsageError(f"{path}: not a readable NPZ or JSON file of matrices ({error}); {REMEDY}") from error


def _of_state_space(file: ProcessFile, folder: Path, given: str) -> dict[str, Array]:
    """Return the matrices of an object with A, B, C, D in continuous time, as python-control and SciPy have them.

    Its inputs are those of the file, then the load, if there is one, and the other disturbances.
    """
    space = made_by(*source_of(folder, given), given)
    try:
        M = {name: np.atleast_2d(np.array(getattr(space, name), dtype=np.float64)) for name in "ABCD"}
    except (AttributeError, TypeError, ValueError) as error:
        raise UsageError(f"{given}: no state space with A, B, C and D ({error})") from error
    if getattr(space, "dt", None) not in (None, 0):
        raise UsageError(f"{given}: has a sampling time of {space.dt} s; give it in continuous time")
    m, outside = len(file.inputs), len(file.outside)
    if M["B"].shape[1] != m + outside:
        raise UsageError(
            f"{given}: has {M['B'].shape[1]} inputs, not {m + outside}: {m} inputs, then load and other disturbances"
        )
    none = 0 if file.load else 1  # the first column is the load's
    for whole, rest in (("B", "F"), ("D", "G")):
        M[rest] = np.pad(M[whole][:, m:], ((0, 0), (none, 0)))
        M[whole] = M[whole][:, :m]
    return M
