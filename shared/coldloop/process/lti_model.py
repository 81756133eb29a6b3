"""The linear model of the plant, all that the optimiser knows of it: made off line, loaded like a PLC download."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ModelFileError
from coldloop.process import model_file
from coldloop.process.model_file import REMEDY, VECTORS

RealArray: TypeAlias = NDArray[np.float64]
UNNAMED: dict[str, Any] = {
    "plant": model_file.COLD_BOX, "note": "", "declaration_digest": "",
    "plant_parameters": {}, "plant_rest": {}, "process": {},
}  # fmt: skip
"""Values of the keys that a model file leaves out."""
MATRICES = ("A", "B", "F", "C", "D", "G", "A_tick", "B_tick", "F_tick")
HALVINGS = 20
LARGEST_DIFFERENCE = 1e-6
"""Between A_tick and what A says of a tick; another tick differs by more."""


@dataclass(frozen=True, kw_only=True)
class DiscreteModel:
    """x[k+1] = A x[k] + B u[k] + F w[k], in deviations from the operating point."""

    A: RealArray
    """Shape (n, n)."""
    B: RealArray
    """Shape (n, m)."""
    F: RealArray
    """Shape (n,)."""
    period_s: float
    """Sampling period, s."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LtiModel(model_file.ModelDescription):
    """dx/dt = A x + B u + F w, y = C x + D u + G w, in deviations from the operating point (x0, u0, w0, y0).

    n states, m inputs, p outputs, one load; physical units throughout, time in seconds. The arrays are read-only.

    Raises:
        ValueError: shapes do not agree, or a number is not finite.
    """

    A: RealArray
    """Shape (n, n)."""
    B: RealArray
    """Shape (n, m)."""
    F: RealArray
    """Shape (n,)."""
    C: RealArray
    """Shape (p, n)."""
    D: RealArray
    """Shape (p, m)."""
    G: RealArray
    """Shape (p,)."""
    A_tick: RealArray
    """Shape (n, n): the transition over one tick, inputs and load held. PLCs compose longer periods from it."""
    B_tick: RealArray
    """Shape (n, m)."""
    F_tick: RealArray
    """Shape (n,)."""
    x0: RealArray
    """Shape (n,)."""
    u0: RealArray
    """Shape (m,)."""
    y0: RealArray
    """Shape (p,)."""

    def __post_init__(self) -> None:
        n, m, p = len(self.state_names), len(self.input_names), len(self.output_names)
        if (len(self.state_units), len(self.input_units), len(self.output_units)) != (n, m, p):
            raise ValueError("names and units differ in number")
        shapes = {"A": (n, n), "B": (n, m), "F": (n,), "C": (p, n), "D": (p, m), "G": (p,)}
        shapes |= {"A_tick": (n, n), "B_tick": (n, m), "F_tick": (n,), "x0": (n,), "u0": (m,), "y0": (p,)}
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, not {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} is not finite")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not np.isfinite(self.w0):
            raise ValueError("w0 is not finite")

    @property
    def moved(self) -> NDArray[np.intp]:
        """The states that move by themselves, by inputs or by the load; others are disturbances, and what these do."""
        found = np.arange(len(self.A))
        while True:
            moves = np.hstack([self.A[np.ix_(found, found)], self.B[found], self.F[found, None]]).any(axis=1)
            if moves.all():
                return found
            found = found[moves]

    @property
    def digest(self) -> str:
        """SHA-256 of the content, in hexadecimal: of each bit of the matrices."""
        return model_file.digest_of(self._document())

    @property
    def short_digest(self) -> int:
        """Short digest, which services compare."""
        return self.short_digest_of(self.digest)

    def save(self, path: Path) -> None:
        """Write the model as JSON with its digest; the file appears whole or not at all (OSError if it cannot)."""
        model_file.write_document(path, self._document())

    def discretised(self, period_s: float) -> DiscreteModel:
        """Return `discretise` of it: sampled every `period_s` (s), inputs and load held in between."""
        return discretise(self.A, self.B, self.F, period_s)

    def _document(self) -> dict[str, Any]:
        document: dict[str, Any] = {"format": model_file.FORMAT}
        for name in (each.name for each in fields(self)):
            value = getattr(self, name)
            if name in UNNAMED and value == UNNAMED[name]:
                continue  # so is any file that names none
            if isinstance(value, np.ndarray):
                document[name] = value.tolist()
            else:
                document[name] = list(value) if isinstance(value, tuple) else value
        return document


def discretise(A: RealArray, B: RealArray, F: RealArray, period_s: float) -> DiscreteModel:
    """Return dx/dt = A x + B u + F w sampled every `period_s` (s, positive), inputs and load held in between.

    Raises:
        ValueError: the period is not positive and finite.
    """
    from scipy.linalg import expm  # noqa: PLC0415 - only who discretises needs scipy

    if not (np.isfinite(period_s) and period_s > 0.0):
        raise ValueError(f"a sampling period must be positive, not {period_s} s")
    n, m = B.shape
    augmented = np.zeros((n + m + 1, n + m + 1))
    augmented[:n] = np.hstack([A, B, F[:, np.newaxis]]) * period_s
    held = expm(augmented)
    return DiscreteModel(A=held[:n, :n], B=held[:n, n : n + m], F=held[:n, n + m], period_s=period_s)


def load(path: Path) -> LtiModel:
    """Read a model file.

    Raises:
        ModelFileError: the file is missing, not JSON, of another version, damaged, not finite or of wrong shape.
    """
    document = model_file.read_document(path)
    header = model_file.header_of(document, path)
    described = {name: value for name, value in vars(header).items() if name not in ("digest", "file", *VECTORS)}
    try:
        arrays: dict[str, Any] = {name: np.array(document[name], dtype=np.float64) for name in (*MATRICES, *VECTORS)}
        model = LtiModel(**described, **arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"{path}: {error} in the model file; {REMEDY}") from error
    process = model_file.declared_process(document, path)
    if len(model.state_names) < len(process.states):
        found, needed = len(model.state_names), len(process.states)
        raise ModelFileError(f"{path}: {found} states in the model file, a {process.name} has {needed}; {REMEDY}")
    part = model.A * (process.tick_s / 2**HALVINGS)  # squared as often, exp of a millionth of a tick is that of a tick
    tick = np.linalg.matrix_power(np.eye(len(part)) + part + part @ part / 2.0, 2**HALVINGS)
    if not model.process and not np.abs(tick - model.A_tick).max() < LARGEST_DIFFERENCE:
        raise ModelFileError(f"{path}: A_tick is not that of A over a tick of {process.tick_s:g} s; {REMEDY}")
    return model
