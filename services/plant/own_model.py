"""The model file of this very plant: one that was made from another plant is refused before anything moves."""

from functools import cache
from pathlib import Path

from coldloop.errors import ModelFileError
from coldloop.process.model_file import COLD_BOX, ModelHeader, read_header
from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from plant.cold_box.model import parameters_digest
from plant.cold_box.physics import REFERENCE
from plant.helium.properties import load_helium


def own_header(file: Path) -> ModelHeader:
    """Return the header of a model file of this very plant: of the cold box alone, or of the refrigerator around it.

    Raises:
        ModelFileError: The file cannot be read, or the model was made from another plant.
    """
    header = read_header(file)
    names = (header.state_names[: len(STATE_NAMES)], header.input_names, header.output_names)
    own = _own_parameters_digest(header.plant)
    if header.parameters_digest != own or names != (STATE_NAMES, INPUT_NAMES, OUTPUT_NAMES):
        raise ModelFileError(f"{file}: a model of another plant; make one with `coldloop model --out FILE`")
    return header


@cache
def _own_parameters_digest(plant: str) -> str:
    if plant == COLD_BOX:
        return parameters_digest(REFERENCE, load_helium())
    from plant.refrigerator.file import refrigerator_digest  # noqa: PLC0415
    from plant.refrigerator.physics import REFERENCE_REFRIGERATOR  # noqa: PLC0415 a cold box alone starts without it

    return refrigerator_digest(REFERENCE_REFRIGERATOR, load_helium())
