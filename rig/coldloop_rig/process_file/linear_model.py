"""The linear model of a plant at its operating point, before it is a model file: from matrices, equations, lags."""

import warnings
from collections.abc import Mapping
from io import BytesIO
from math import factorial
from pathlib import Path
from typing import Any, Final, NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError, foreign
from coldloop.process.declaration import Process
from coldloop.process.sections import Lag, PlantSource
from coldloop.text import MOST_BYTES, parsed_json, read_bytes
from coldloop_plant import own_plants as plants
from coldloop_plant.equilibrium import Linear, central_differences
from coldloop_rig.process_file.reading import source_of

Array = NDArray[np.float64]

STEP: Final = 1e-5
"""Step of differences, over the size of the variable."""
AT_REST: Final = 1e-8  # largest change of a state in a sampling period, over its size, that still counts as rest
REMEDY: Final = "write it with numpy.savez(A=..., ...), or as JSON"


class Record(NamedTuple):
    """Record of inputs and outputs at N equidistant times: each row's inputs hold until the next one."""

    period_s: float
    inputs: Array
    """Shape (N, m)."""
    outputs: Array
    """Shape (N, p)."""
    operating: Array
    """Inputs at the operating point, shape (m,); what integrates does not move there."""
    input_names: tuple[str, ...]
    where: str
    """Names it in messages."""
    pieces: tuple[slice, ...] = (slice(None),)
    """Rows without a gap between them, in order."""


class Identified(NamedTuple):
    """dx/dt = A x + B u, y = C x + constant, with u in deviations from the operating point."""

    A: Array
    """Shape (n, n), per second."""
    B: Array
    """Shape (n, m)."""
    C: Array
    """Shape (p, n)."""
    constant: Array
    """Outputs at rest at the operating point, if the plant rests: shape (p,)."""
    rests: bool
    """Whether all modes decay, within the length of the record."""
    fit: Array
    """Share of each output's variation on the data held back that is explained, 1 is all: 1 - rms error / deviation."""


class Linearised(NamedTuple):
    """dx/dt = A x + B u + F w, y = C x + D u + G w in deviations from (x0, u0, w0, y0); time in seconds.

    F and G have a column for the load and one for each other disturbance, which `with_disturbances` makes states.
    """

    A: Array
    B: Array
    F: Array
    C: Array
    D: Array
    G: Array
    x0: Array
    u0: Array
    w0: Array
    y0: Array
    states: dict[str, str]
    """Name and unit of each."""
    kind: str
    """Kind of the plant."""
    parameters: dict[str, Any]
    """Parameters from which the plant is made, in the model file."""
    digest: str
    """Digest of the plant's source."""
    error: float
    """Error of the derivatives: difference from those with steps twice as wide, over the largest of each column."""
    notes: tuple[str, ...] = ()
    """Notes on how the model was found, one line each."""
    record: tuple[Record, Identified] | None = None
    """Record from which it was identified, and the result; None if it was not identified."""


def operating_point(file: Process) -> tuple[Array, Array]:
    """Return the inputs at the operating point, and load (0 without) and other disturbances there, shape (1 + k,)."""
    w = [file.load.at, *(one.at for one in file.disturbances)]
    return np.array([one.at for one in file.inputs]), np.array(w)


def with_disturbances(file: Process, found: Linearised) -> Linearised:
    """Return the model with the disturbances other than the load as states, which hold, and outputs if measured."""
    n, k = len(found.A), len(file.disturbances)
    F, G = (each if file.has_load else np.hstack([0.0 * each[:, :1], each[:, 1:]]) for each in (found.F, found.G))
    shown = np.eye(k)[[one.noise is not None for one in file.disturbances]]
    zeros = np.zeros
    return found._replace(
        A=np.block([[found.A, F[:, 1:]], [zeros((k, n + k))]]),
        B=np.vstack([found.B, zeros((k, found.B.shape[1]))]),
        F=np.vstack([F[:, :1], zeros((k, 1))]),
        C=np.block([[found.C, G[:, 1:]], [zeros((len(shown), n)), shown]]),
        D=np.vstack([found.D, zeros((len(shown), found.D.shape[1]))]),
        G=np.vstack([G[:, :1], zeros((len(shown), 1))]),
        x0=np.append(found.x0, found.w0[1:]),
        w0=found.w0[:1],
        y0=np.append(found.y0, shown @ found.w0[1:]),
        states=found.states | {one.name: one.unit for one in file.disturbances},
    )


def given_outputs(file: Process) -> Array:
    """Return the outputs at the operating point, which the file gives. Raises UsageError: it does not."""
    missing = next((one.name for one in file.outputs if one.at is None), None)
    if missing is not None:
        raise UsageError(f"outputs: {missing} needs at, its value at the operating point: this plant has no equations")
    return np.array([one.at for one in file.outputs], dtype=np.float64)


def from_matrices(file: Process, folder: Path, given: str) -> Linearised:
    """Return the model whose matrices are given: dx/dt = A x + B u + F w, y = C x + D u + G w.

    `given` is an NPZ or JSON file in the folder, or `file.py:NAME`, a state space. Raises ColdloopError: it cannot be
    read, or does not fit the signals.
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
        kind=plants.LINEAR, parameters={}, digest="", error=0.0,
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
        return {name: np.array(stored[name], dtype=np.float64) for name in Linear._fields if name in stored}
    except (OSError, ValueError, TypeError, EOFError, RecursionError, MemoryError, BadZipFile) as error:
        raise UsageError(f"{path}: not a readable NPZ or JSON file of matrices ({error}); {REMEDY}") from error


def _of_state_space(file: Process, folder: Path, given: str) -> dict[str, Array]:
    """Return the matrices of an object with A, B, C, D in continuous time, as python-control and SciPy have them.

    Its inputs are those of the file, then the load, if there is one, and the other disturbances.
    """
    space = plants.made_by(*source_of(folder, given), given)
    if getattr(space, "dt", None) not in (None, 0):
        raise UsageError(f"{given}: has a sampling time of {space.dt} s; give it in continuous time")
    remedy = "make one with control.ss(...), or SciPy's to_ss()"
    with foreign(f"{given}: no state space with A, B, C and D", remedy, kind=UsageError):
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


def realised(transfer: Any) -> dict[str, Array]:  # noqa: ANN401 types of python-control or SciPy
    """Return the matrices of transfer functions, with numerators and denominators as python-control or SciPy has them.

    Inputs that act on an output with the same denominator share states: the observable companion form shows all of them
    in that output (Kailath, Linear Systems, section 2.1). Raises ValueError: one is not proper.
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


def from_equations(file: Process, place: str, source: str, name: str) -> Linearised:
    """Return the model of a class where it rests, by central differences. Raises ColdloopError: it does not rest."""
    equations = plants.equations_of(source, name, place)
    u, w = operating_point(file)
    n, m, p = len(equations.states), len(u), len(file.outputs)
    x = _rest(equations, u, w, place, file.tick_s * file.ticks_per_sample) if n else np.zeros(0)

    def evaluate(z: Array) -> Array:
        point = z[:n], z[n : n + m], plants.outside(z[n + m :])
        rates = plants.evaluated(equations.derivatives, *point, size=n, where=place)
        return np.append(rates, plants.evaluated(equations.outputs, *point, size=p, where=place))

    at = np.array([*x, *u, *w])
    y = evaluate(at)[n:]
    spans = [file.load.span if file.has_load else (0.0, 4.0), *(one.span for one in file.disturbances)]
    steps = [(high - low) / 4 for low, high in [*((one.low, one.high) for one in file.inputs), *spans]]
    fine, coarse = central_differences(evaluate, at, STEP * np.array([*_sizes(x, equations), *steps]))
    apart = [
        np.abs(one - other).max(axis=0) / np.maximum(np.abs(one).max(axis=0), 1e-300)
        for one, other in ((fine[:n], coarse[:n]), (fine[n:], coarse[n:]))
        if len(one)
    ]
    parameters = {"file": place.partition(":")[0], "class": name, "source": source}
    return Linearised(
        *Linear.of(fine, n, m), x, u, w, y, dict(equations.states), plants.PYTHON, parameters, "", float(np.max(apart)),
    )  # fmt: skip


def _sizes(x: Array, equations: plants.Equations) -> Array:
    """Return how large states are: their values at rest, or at the guess, or 1 where both are 0."""
    size = np.maximum(np.abs(x), np.abs(np.array(equations.guess, dtype=np.float64)))
    return np.where(size > 0.0, size, 1.0)


def _rest(equations: plants.Equations, u: Array, w: Array, place: str, sample_s: float) -> Array:
    """Return the state that does not move: in a sample by no more than `AT_REST` of its size."""
    from scipy.optimize import root  # noqa: PLC0415

    guess = np.array(equations.guess, dtype=np.float64)
    size = _sizes(guess, equations)

    def motion(scaled: Array) -> Array:
        point, where = (scaled * size, u, plants.outside(w)), f"{place}, near guess"
        return sample_s * plants.evaluated(equations.derivatives, *point, size=len(size), where=where) / size

    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = root(motion, guess / size, tol=1e-12)
        left = np.abs(motion(found.x)) / np.maximum(1.0, np.abs(found.x))
    if not np.all(left <= AT_REST):
        worst = list(equations.states)[int(np.argmax(np.where(np.isfinite(left), left, np.inf)))]
        raise UsageError(
            f"{place}: no state of rest with the inputs at their operating point: {worst} keeps moving; give other "
            "values of at, or a guess nearer to it"
        )
    return np.array(found.x * size, dtype=np.float64)


def from_lags(file: Process, plant: PlantSource) -> Linearised:
    """Return the lags side by side: a state each, and before it as many as its dead time is approximated with."""
    lags, m = plant.transfer_functions or (), len(file.inputs)
    sources = {one.name: i for i, one in enumerate(file.inputs)} | ({file.load.name: m} if file.has_load else {})
    sources |= {one.name: i for i, one in enumerate(file.disturbances, m + 1)}
    outputs = {one.name: i for i, one in enumerate(file.outputs)}
    for lag in lags:
        if lag.source not in sources or lag.output not in outputs:
            unknown = lag.source if lag.source not in sources else lag.output
            raise UsageError(f"plant.transfer_functions: {unknown} is no signal of this file")
    parts = [lag_model(lag) for lag in lags]
    n, k = sum(len(a) for a, _, _ in parts), 1 + len(file.disturbances)
    A, B, C = np.zeros((n, n)), np.zeros((n, m + k)), np.zeros((len(outputs), n))
    states: dict[str, str] = {}
    first = 0
    for lag, (a, b, c) in zip(lags, parts, strict=True):
        place = slice(first, first := first + len(a))
        A[place, place], B[place, sources[lag.source]], C[outputs[lag.output], place] = a, b, c
        unit = file.outputs[outputs[lag.output]].unit
        states |= {f"{lag.output}_{lag.source}_{i}": unit for i in range(1, len(a) + 1)}
    u, w = operating_point(file)
    return Linearised(
        A, B[:, :m], B[:, m:], C, np.zeros((len(outputs), m)), np.zeros((len(outputs), k)), np.zeros(n), u, w,
        given_outputs(file), states, plants.TRANSFER_FUNCTIONS, {"lags": [lag.model_dump() for lag in lags]}, "", 0.0,
    )  # fmt: skip


def lag_model(lag: Lag) -> tuple[Array, Array, Array]:
    """Return A (k, k), b (k,), c (k,) of one lag, its dead time by a Pade approximation, its state last.

    The diagonal approximation of exp(-delay s) is in companion form, scaled by time (Golub and Van Loan, Matrix
    Computations, section 9.3).
    """
    rate = 1.0 / lag.time_constant_s
    if lag.delay_s == 0.0:
        return np.array([[-rate]]), np.array([lag.gain * rate]), np.ones(1)
    k = 2  # order of the approximation in the prediction model; the simulated plant has dead times exactly
    share = np.array([
        factorial(2 * k - j) * factorial(k) / (factorial(2 * k) * factorial(j) * factorial(k - j)) for j in range(k + 1)
    ])  # fmt: skip
    below = share / share[k]  # rising powers of s times the delay
    above = below * (-1.0) ** np.arange(k + 1)
    a, c, gain = np.eye(k, k=1), above[:k] - above[k] * below[:k], lag.gain * rate
    a[-1] = -below[:k]
    A = np.zeros((k + 1, k + 1))
    A[:k, :k], A[k, :k], A[k, k] = a / lag.delay_s, gain * c, -rate
    b = np.array([*np.zeros(k - 1), 1.0]) / lag.delay_s
    return A, np.array([*b, gain * above[k]]), np.array([*np.zeros(k), 1.0])
