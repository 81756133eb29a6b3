"""The model file and its plant: the file's parameters, or the reference plant; one of neither is refused at once."""

from functools import cache
from pathlib import Path

from pydantic import ValidationError

from coldloop.config import explained
from coldloop.errors import ModelFileError
from coldloop.process.lti_model import LtiModel
from coldloop.process.model_file import COLD_BOX, ModelHeader, read_header
from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from plant.cold_box.model import parameters_digest
from plant.cold_box.physics import REFERENCE, ColdBox
from plant.cold_box.plant_file import LISTING, BoxParameters
from plant.helium.properties import load_helium


def own_header(file: Path) -> ModelHeader:
    """Return the header of a model file whose plant can be made: a cold box alone, or the refrigerator.

    Raises:
        ModelFileError: The file cannot be read, its parameters cannot be used, or the model was made from others.
    """
    header = read_header(file)
    if header.process:
        from plant.own.maker import check_signals  # noqa: PLC0415 a cold box starts without it

        check_signals(header)
        return header
    names = (header.state_names[: len(STATE_NAMES)], header.input_names, header.output_names)
    own = _own_parameters_digest(header.plant, box_of(header, str(file)))
    if header.parameters_digest != own or names != (STATE_NAMES, INPUT_NAMES, OUTPUT_NAMES):
        raise ModelFileError(f"{file}: a model of another plant; make one with `coldloop model --out FILE`")
    return header


def box_of(model: ModelHeader | LtiModel, where: str = "model.file") -> ColdBox:
    """Return the cold box that a model file describes, the reference plant if it describes none; `where` names it.

    Raises:
        ModelFileError: A parameter is unknown or out of range, or the plant is no cold box alone.
    """
    if not model.plant_parameters:
        return REFERENCE
    if model.plant != COLD_BOX:
        raise ModelFileError(f"{where}: plant_parameters of a {model.plant}; only a cold box alone can have its own")
    try:
        return BoxParameters.model_validate(model.plant_parameters).box
    except ValidationError as error:
        wrong = explained(error, {}, BoxParameters, LISTING)
        raise ModelFileError(f"{where}: plant_parameters: {wrong}; make it with `coldloop model --plant`") from None


@cache
def _own_parameters_digest(plant: str, box: ColdBox) -> str:
    if plant == COLD_BOX:
        return parameters_digest(box, load_helium())
    from plant.refrigerator.file import refrigerator_digest  # noqa: PLC0415
    from plant.refrigerator.physics import REFERENCE_REFRIGERATOR  # noqa: PLC0415 a cold box alone starts without it

    return refrigerator_digest(REFERENCE_REFRIGERATOR, load_helium())
