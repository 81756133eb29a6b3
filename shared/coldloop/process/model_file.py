"""The model file: a JSON document that carries its own SHA-256 digest.

Needs the standard library only, so that the control PLC can check which model it runs without numpy.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field, TypeAdapter, ValidationError

from coldloop.errors import ModelFileError
from coldloop.process.cold_box import COLD_BOX as THE_COLD_BOX
from coldloop.process.declaration import Process
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
    def declared(self) -> Process:
        """The process that the plant is (KeyError, TypeError, ValueError: the file says something else there)."""
        return Process.model_validate(self.process) if self.process else THE_COLD_BOX

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


def declared_process(document: Mapping[str, Any], path: Path) -> Process:
    """Return the process of a document that `read_document` has verified: the cold box if it declares none.

    Raises:
        ModelFileError: What it declares is no process.
    """
    return process_in(document.get("process", {}), f"{path}: process", PROCESS_REMEDY)


def process_in(declared: Mapping[str, Any], where: str, remedy: str) -> Process:
    """Return the process that is declared, the cold box if none is; `where` and `remedy` are for the message.

    Raises:
        ModelFileError: It is none that this version makes.
    """
    if not declared:
        return THE_COLD_BOX
    if "decision_instants" in declared:
        raise ModelFileError(f"{where}: of version 0.3 or earlier, which declared it in another form; {remedy}")
    try:
        return Process.model_validate(declared)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        said = "is unknown" if first["type"] == "extra_forbidden" else first["msg"].removeprefix("Value error, ")
        raise ModelFileError(f"{where}: {place} {said}; {remedy}") from None


def header_of(document: dict[str, Any], path: Path) -> ModelHeader:
    """Return the header part of a document that `read_document` has verified; `path` is for the message."""
    try:
        header = TypeAdapter(ModelHeader).validate_python({**document, "file": path})
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
