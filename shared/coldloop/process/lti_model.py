"""The linear model of the plant, all that the optimiser knows of it, and its file, loaded like a PLC download."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

from coldloop.errors import ModelFileError
from coldloop.process import cold_box, declaration
from coldloop.text import parsed_json, read_bytes, whole_text

FORMAT = 1
REMEDY = "make a new one with `python -m coldloop_plant.cold_box.model FILE`"
PROCESS_REMEDY: Final = "make one with `coldloop process FILE --out MODEL`"
VECTORS = ("x0", "u0", "y0")
COLD_BOX = "cold-box"
"""The plant of a model file that names none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelDescription:
    """Description of a model in its file, without operating point and matrices."""

    parameters_digest: str
    """SHA-256 of the plant's parameters and property tables that the model was made from, in hexadecimal."""
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    load_name: str
    load_unit: str
    w0: float
    """Load at the operating point, in `load_unit`."""
    plant: str = COLD_BOX
    """Plant that the model was made of."""
    note: str = ""
    """Source of the model, if not the plant's equations."""
    plant_parameters: Annotated[dict[str, Any], Field(min_length=1)] = field(default_factory=dict)
    """The plant's parameters by section, as in a plant file; none are those of the reference plant."""
    process: dict[str, Any] = field(default_factory=dict)
    """`coldloop.process.declaration.Process` as plain data; none is the cold box."""
    plant_rest: Annotated[dict[str, Any], Field(min_length=1)] = field(default_factory=dict)
    """A refrigerator's operating point, and the gains of its pressure controller; none are those that are shipped."""
    declaration_digest: str = ""
    """SHA-256 of the process file that it was made from, and of the files that this names; empty: of none."""

    @property
    def declared(self) -> declaration.Process:
        """The process that the plant is (KeyError, TypeError, ValueError: the file says something else there)."""
        return declaration.Process.model_validate(self.process) if self.process else cold_box.COLD_BOX

    def short_digest_of(self, digest: str) -> int:
        """Return the first 32 bits of the declaration's digest, or of the model's own where it has none."""
        return int((self.declaration_digest or digest)[:8], 16)


@dataclass(frozen=True, kw_only=True)
class ModelHeader(ModelDescription):
    """Header of a model file, without its matrices."""

    digest: str
    """SHA-256 of the content, in hexadecimal."""
    x0: tuple[float, ...]
    """State at the operating point, in `state_units`."""
    u0: tuple[float, ...]
    """Inputs at the operating point, in `input_units`."""
    y0: tuple[float, ...]
    """Outputs at the operating point, in `output_units`."""
    file: Path = Path()
    """File that it was read from."""

    @property
    def short_digest(self) -> int:
        """Short digest, which services compare."""
        return self.short_digest_of(self.digest)


def read_header(path: Path) -> ModelHeader:
    """Return the header of a model file after verifying the whole file.

    Raises:
        ModelFileError: the file is missing, unreadable, of another version, damaged or inconsistent.
    """
    return header_of(read_document(path), path)


def declared_process(document: Mapping[str, Any], path: Path) -> declaration.Process:
    """Return the process of a document that `read_document` has verified: the cold box if it declares none.

    Raises:
        ModelFileError: What it declares is no process.
    """
    return process_in(document.get("process", {}), f"{path}: process", PROCESS_REMEDY)


def process_in(declared: Mapping[str, Any], where: str, remedy: str) -> declaration.Process:
    """Return the process that is declared, the cold box if none is; `where` and `remedy` are for the message.

    Raises:
        ModelFileError: It is none that this version makes.
    """
    if not declared:
        return cold_box.COLD_BOX
    if "decision_instants" in declared:
        raise ModelFileError(f"{where}: of version 0.3 or earlier, which declared it in another form; {remedy}")
    try:
        return declaration.Process.model_validate(declared)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        said = "is unknown" if first["type"] == "extra_forbidden" else first["msg"].removeprefix("Value error, ")
        raise ModelFileError(f"{where}: {place} {said}; {remedy}") from None


_HEADER: Final = TypeAdapter(ModelHeader)


def header_of(document: dict[str, Any], path: Path) -> ModelHeader:
    """Return the header part of a document that `read_document` has verified; `path` is for the message."""
    try:
        header = _HEADER.validate_python({**document, "file": path})
    except ValidationError as error:
        first = error.errors()[0]
        raise ModelFileError(f"{path}: {first['loc'][0]}: {first['msg']} in the model file; {REMEDY}") from None
    for kind, values in (("state", header.x0), ("input", header.u0), ("output", header.y0)):
        names, units = getattr(header, f"{kind}_names"), getattr(header, f"{kind}_units")
        if not len(names) == len(units) == len(values):
            raise ModelFileError(f"{path}: {kind} names, units and values differ in number; {REMEDY}")
    return header


def read_document(path: Path, remedy: str = REMEDY) -> dict[str, Any]:
    """Return the content of a model file whose format and digest are right; `remedy` ends the message if not.

    Raises:
        ModelFileError: the file is missing, unreadable, not JSON, not finite, of another version or damaged.
    """
    try:
        if not path.exists():
            raise ModelFileError(f"{path}: no such model file; {remedy}")
        if path.suffix == ".toml":
            raise ModelFileError(f"{path}: a process file; `coldloop process FILE --out MODEL` makes its model file")
        document = parsed_json(read_bytes(path, remedy, ModelFileError))
    except (OSError, ValueError) as error:
        raise ModelFileError(f"{path}: not a readable model file ({error}); {remedy}") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ModelFileError(f"{path}: not a model file of format {FORMAT}; {remedy}")
    try:
        found = digest_of(document)
    except ValueError as error:  # a number such as 1e999 reads as infinite
        raise ModelFileError(f"{path}: a number that is not finite; {remedy}") from error
    if document.get("digest") != found:
        raise ModelFileError(f"{path}: digest mismatch, the file was changed after it was made; {remedy}")
    return document


def write_document(path: Path, document: dict[str, Any]) -> None:
    """Write a document with its digest; the file appears whole or not at all.

    Raises:
        ValueError: a number is not finite.
        OSError: the file cannot be written.
    """
    text = json.dumps({**document, "digest": digest_of(document)}, sort_keys=True, indent=1, allow_nan=False)
    whole_text(path, text + "\n", synced=True)
    path.chmod(0o644)  # the services that load it may be other users


def digest_of(document: dict[str, Any]) -> str:
    """Return the SHA-256 of a document without its `digest`: sorted keys, shortest exact floats, no spaces."""
    content = {name: value for name, value in document.items() if name != "digest"}
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


RealArray: TypeAlias = NDArray[np.float64]
UNNAMED: dict[str, Any] = {
    "plant": COLD_BOX, "note": "", "declaration_digest": "",
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
class LtiModel(ModelDescription):
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
        return digest_of(self._document())

    @property
    def short_digest(self) -> int:
        """Short digest, which services compare."""
        return self.short_digest_of(self.digest)

    def save(self, path: Path) -> None:
        """Write the model as JSON with its digest; the file appears whole or not at all (OSError if it cannot)."""
        write_document(path, self._document())

    def discretised(self, period_s: float) -> DiscreteModel:
        """Return `discretise` of it: sampled every `period_s` (s), inputs and load held in between."""
        return discretise(self.A, self.B, self.F, period_s)

    def _document(self) -> dict[str, Any]:
        document: dict[str, Any] = {"format": FORMAT}
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
    document = read_document(path)
    header = header_of(document, path)
    described = {name: value for name, value in vars(header).items() if name not in ("digest", "file", *VECTORS)}
    try:
        arrays: dict[str, Any] = {name: np.array(document[name], dtype=np.float64) for name in (*MATRICES, *VECTORS)}
        model = LtiModel(**described, **arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"{path}: {error} in the model file; {REMEDY}") from error
    process = declared_process(document, path)
    if len(model.state_names) < len(process.states):
        found, needed = len(model.state_names), len(process.states)
        raise ModelFileError(f"{path}: {found} states in the model file, a {process.name} has {needed}; {REMEDY}")
    part = model.A * (process.tick_s / 2**HALVINGS)  # squared as often, exp of a millionth of a tick is that of a tick
    tick = np.linalg.matrix_power(np.eye(len(part)) + part + part @ part / 2.0, 2**HALVINGS)
    if not model.process and not np.abs(tick - model.A_tick).max() < LARGEST_DIFFERENCE:
        raise ModelFileError(f"{path}: A_tick is not that of A over a tick of {process.tick_s:g} s; {REMEDY}")
    return model
