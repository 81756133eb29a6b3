"""A plant given as matrices: a file of them, or a state space that a Python file makes."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.foreign import foreign
from coldloop.parsing import parsed_json
from coldloop.process.declaration import Process
from coldloop.text_file import MOST_BYTES, read_bytes
from coldloop_plant.own.maker import LINEAR
from coldloop_plant.own.python_class import made_by
from coldloop_rig.process_file.linear_model import Linearised, given_outputs, operating_point
from coldloop_rig.process_file.source import source_of

Array = NDArray[np.float64]

NAMES: Final = "ABCDFG"
REMEDY: Final = "write it with numpy.savez(A=..., ...), or as JSON"


def from_matrices(file: Process, folder: Path, given: str) -> Linearised:
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
    n, m, p = len(np.atleast_1d(M["A"])), len(file.inputs), len(file.outputs)
    k = 1 + len(file.disturbances)
    shapes = {"A": (n, n), "B": (n, m), "F": (n, k), "C": (p, n), "D": (p, m), "G": (p, k)}
    full: dict[str, Any] = {name: M.get(name, np.zeros(shape)) for name, shape in shapes.items()}
    for name, shape in shapes.items():
        if full[name].ndim < 2 and full[name].size == max(shape) and min(shape) == 1:
            full[name] = full[name].reshape(shape)  # tools write a number for 1 x 1, and a list for a row or a column
        if full[name].shape != shape:
            raise UsageError(
                f"{given}: {name} has shape {full[name].shape}, and not {shape} for {n} states, {m} inputs, {p} outputs"
                + (f", {k} disturbances" if k > 1 else "")
            )
        if not np.isfinite(full[name]).all():
            raise UsageError(f"{given}: {name} holds a number that is not finite, NaN or infinity; {REMEDY}")
    u, w = operating_point(file)
    return Linearised(
        **full, x0=np.zeros(n), u0=u, w0=w, y0=given_outputs(file), states={f"x{i}": "" for i in range(1, n + 1)},
        kind=LINEAR, parameters={}, digest="", error=0.0,
    )  # fmt: skip


def _of_file(path: Path) -> dict[str, Array]:
    try:
        content = read_bytes(path, REMEDY)
        if path.suffix == ".json":
            stored: Mapping[str, Any] = dict(parsed_json(content))
        else:
            with np.load(BytesIO(content), allow_pickle=False) as archive:
                if sum(each.file_size for each in archive.zip.infolist()) > MOST_BYTES:
                    raise ValueError(f"more than {MOST_BYTES} bytes")  # noqa: TRY301 told as the others
                stored = dict(archive)
        return {name: np.array(stored[name], dtype=np.float64) for name in NAMES if name in stored}
    except (OSError, ValueError, TypeError, EOFError, RecursionError, MemoryError, BadZipFile) as error:
        raise UsageError(f"{path}: not a readable NPZ or JSON file of matrices ({error}); {REMEDY}") from error


def _of_state_space(file: Process, folder: Path, given: str) -> dict[str, Array]:
    """Return the matrices of an object with A, B, C, D in continuous time, as python-control and SciPy have them.

    Its inputs are those of the file, then the load, if there is one, and the other disturbances.
    """
    space = made_by(*source_of(folder, given), given)
    if getattr(space, "dt", None) not in (None, 0):
        raise UsageError(f"{given}: has a sampling time of {space.dt} s; give it in continuous time")
    with foreign(
        f"{given}: no state space with A, B, C and D",
        "make one with control.ss(...), or SciPy's to_ss()",
        kind=UsageError,
    ):
        if not hasattr(space, "A") and (hasattr(space, "num") or hasattr(space, "to_tf")):
            M = realised(space if hasattr(space, "num") else space.to_tf())
        else:
            M = {name: np.atleast_2d(np.array(getattr(space, name), dtype=np.float64)) for name in "ABCD"}
    m, outside = len(file.inputs), len(file.outside)
    if M["B"].shape[1] != m + outside:
        raise UsageError(
            f"{given}: has {M['B'].shape[1]} inputs, not {m + outside}: {m} inputs, then load and other disturbances"
        )
    none = 0 if file.has_load else 1  # the first column is the load's
    for whole, rest in (("B", "F"), ("D", "G")):
        M[rest] = np.pad(M[whole][:, m:], ((0, 0), (none, 0)))
        M[whole] = M[whole][:, :m]
    return M


def realised(transfer: Any) -> dict[str, Array]:  # noqa: ANN401 of python-control or SciPy
    """Return the matrices of transfer functions, with numerators and denominators as python-control or SciPy has them.

    Inputs that act on an output with the same denominator share states: the observable companion form shows all of
    them in that output (Kailath, Linear Systems, section 2.1).

    Raises:
        ValueError: One is not proper.
    """
    from scipy.linalg import block_diag  # noqa: PLC0415 only what needs it loads it

    num, den = transfer.num, transfer.den
    if np.isscalar(den[0]):  # SciPy: one input, one denominator
        num = [[row] for row in np.atleast_2d(num)]
        den = [[den]] * len(num)
    p, m = len(num), len(num[0])
    D, blocks = np.zeros((p, m)), dict[tuple[int, tuple[float, ...]], Array]()
    for i, j in np.ndindex(p, m):
        below, above = (np.trim_zeros(np.asarray(one[i][j], dtype=np.float64), "f") for one in (den, num))
        if len(above) > len(below):
            raise ValueError(f"that of output {i + 1} by input {j + 1} is not proper")
        a, b = below[1:] / below[0], np.pad(above, (len(below) - len(above), 0)) / below[0]
        D[i, j] = b[0]
        blocks.setdefault((i, tuple(a.tolist())), np.zeros((len(a), m)))[:, j] = b[1:] - a * b[0]
    seen = {key: B for key, B in blocks.items() if B.any()}
    A = [np.eye(len(a), k=1) - np.outer(a, np.eye(1, len(a))) for _, a in seen]
    C = [np.outer(np.eye(p)[i], np.eye(1, len(a))) for i, a in seen]
    B = np.vstack([np.zeros((0, m)), *seen.values()])
    return {"A": block_diag(*A)[: len(B), : len(B)], "B": B, "C": np.hstack([np.zeros((p, 0)), *C]), "D": D}
