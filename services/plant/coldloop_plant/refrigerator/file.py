"""The refrigerator's file: its operating point and the gains of its LQ controller, made off line.

`python -m coldloop_plant.refrigerator.model FILE` makes it. Like the model file it is JSON with its own digest, so that
every run, on any machine, begins with the same bits.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from coldloop.errors import ModelFileError
from coldloop.process.model_file import FORMAT, read_document, write_document
from coldloop_plant.cold_box.model import parameters_digest
from coldloop_plant.helium.properties import Helium, load_helium
from coldloop_plant.refrigerator.physics import COMMAND_NAMES, STATE_NAMES, Refrigerator
from coldloop_plant.refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_plant.refrigerator.station_control import StationReference
from coldloop_plant.refrigerator.station_settings import LqWeights

KIND: Final = "refrigerator"
SHIPPED = Path(__file__).with_name("refrigerator.json")
EQUATIONS: Final = b"M_HP is the mass in the line and in the passes"
"""What the equations changed about the states, part of the digest: a file from before has another mass."""
REMEDY = "make a new one with `python -m coldloop_plant.refrigerator.model FILE`"


@dataclass(frozen=True, kw_only=True)
class RefrigeratorFile:
    """The operating point of a refrigerator, and its pressure controller's gains."""

    parameters_digest: str
    """SHA-256 of the parameters and tables that it was made from."""
    x0: tuple[float, ...]
    """Shape (48,)."""
    u0: tuple[float, ...]
    """Inputs of the cold box, shape (3,)."""
    v0: tuple[float, ...]
    """Openings of the warm valves, shape (4,)."""
    w0: float
    """Heat load, W."""
    gains: tuple[tuple[float, ...], tuple[float, ...]]
    """K of the LQ controller, shape (2, 6)."""
    weights: LqWeights
    """What they were designed with."""

    @property
    def reference(self) -> StationReference:
        """What the station's controller needs of it."""
        bypass, _, _, feed = self.v0
        return StationReference(self.gains, bypass, feed)

    @property
    def document(self) -> dict[str, Any]:
        """As plain data: what a model file of the refrigerator carries as its `plant_rest`."""
        return {
            "state_names": list(STATE_NAMES), "command_names": list(COMMAND_NAMES),
            "weights": self.weights.model_dump(), "parameters_digest": self.parameters_digest, "w0": self.w0,
            "x0": list(self.x0), "u0": list(self.u0), "v0": list(self.v0), "gains": [list(row) for row in self.gains],
        }  # fmt: skip

    def save(self, path: Path) -> None:
        """Write the file (OSError if it cannot be written)."""
        write_document(path, {"format": FORMAT, "plant": KIND, **self.document})


def read_refrigerator_file(path: Path, plant: Refrigerator = REFERENCE_REFRIGERATOR) -> RefrigeratorFile:
    """Return what a file holds that was made for this very refrigerator.

    Raises:
        ModelFileError: The file cannot be read, is damaged, or was made from another plant.
    """
    document = read_document(path, REMEDY)
    if document.get("plant") != KIND:
        raise ModelFileError(f"{path}: not the file of a refrigerator; {REMEDY}")
    return rest_in(document, plant, str(path))


def rest_in(document: dict[str, Any], plant: Refrigerator, path: str) -> RefrigeratorFile:
    """Return what `RefrigeratorFile.document` has made of this very refrigerator; `path` is for the message.

    Raises:
        ModelFileError: It is incomplete, or was made from another plant.
    """
    try:
        first, second = (tuple(float(gain) for gain in row) for row in document["gains"])
        file = RefrigeratorFile(
            parameters_digest=str(document["parameters_digest"]),
            x0=tuple(float(value) for value in document["x0"]),
            u0=tuple(float(value) for value in document["u0"]),
            v0=tuple(float(value) for value in document["v0"]),
            w0=float(document["w0"]),
            gains=(first, second),
            weights=LqWeights.model_validate(document["weights"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"{path}: {error!r} in the refrigerator's file; {REMEDY}") from error
    names = document.get("state_names"), document.get("command_names")
    sizes = len(file.x0), len(file.u0), len(file.v0), len(first), len(second)
    if names != (list(STATE_NAMES), list(COMMAND_NAMES)) or sizes != (len(STATE_NAMES), 3, len(COMMAND_NAMES), 6, 6):
        raise ModelFileError(f"{path}: made for a refrigerator with other states; {REMEDY}")
    if file.parameters_digest != refrigerator_digest(plant, load_helium()):
        raise ModelFileError(f"{path}: made for a refrigerator with other parameters; {REMEDY}")
    return file


def refrigerator_digest(plant: Refrigerator, helium: Helium) -> str:
    """Return the SHA-256 over all parameters, tables and what the states mean, in hexadecimal."""
    digest = hashlib.sha256(parameters_digest(plant.box, helium).encode())
    digest.update(helium.departure.nodes.astype("<f8").tobytes())
    digest.update(repr((plant.precooler, plant.station)).encode())
    digest.update(EQUATIONS)
    return digest.hexdigest()
