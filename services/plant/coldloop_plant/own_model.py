"""The model file and its plant: the file's parameters, or the reference plant; one of neither is refused at once."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pydantic import ValidationError

from coldloop.config import explained
from coldloop.errors import ModelFileError
from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from coldloop.process.lti_model import LtiModel
from coldloop.process.model_file import COLD_BOX, ModelHeader, read_header
from coldloop_plant.cold_box.model import parameters_digest
from coldloop_plant.cold_box.physics import ColdBox
from coldloop_plant.cold_box.plant_file import LISTING, BoxParameters
from coldloop_plant.helium.properties import load_helium

if TYPE_CHECKING:
    from coldloop_plant.refrigerator.physics import Refrigerator

P = TypeVar("P", bound=BoxParameters)


def own_header(file: Path) -> ModelHeader:
    """Return the header of a model file whose plant can be made: a cold box alone, or the refrigerator.

    Raises:
        ModelFileError: The file cannot be read, its parameters cannot be used, or the model was made from others.
    """
    header = read_header(file)
    if header.process:
        from coldloop_plant.own.maker import check_files  # noqa: PLC0415 a cold box starts without it

        check_files(header)
        return header
    names = (header.state_names[: len(STATE_NAMES)], header.input_names, header.output_names)
    if header.plant == COLD_BOX:
        own = _box_digest(box_of(header, str(file)))
    else:
        own = _refrigerator_digest(refrigerator_in(header, str(file)))
    if header.parameters_digest != own or names != (STATE_NAMES, INPUT_NAMES, OUTPUT_NAMES):
        raise ModelFileError(f"{file}: a model of another plant; make one with `coldloop model --out FILE`")
    return header


def box_of(model: ModelHeader | LtiModel, where: str = "model.file") -> ColdBox:
    """Return the cold box that a model file describes, the reference plant if it describes none; `where` names it.

    Raises:
        ModelFileError: A parameter is unknown or out of range.
    """
    if model.plant == COLD_BOX:
        return _parameters(model, BoxParameters, where).box
    return refrigerator_in(model, where).box


def refrigerator_in(model: ModelHeader | LtiModel, where: str = "model.file") -> "Refrigerator":
    """Return the refrigerator that a model file describes, likewise."""
    from coldloop_plant.refrigerator.plant_file import RefrigeratorParameters  # noqa: PLC0415 a cold box starts without it

    return _parameters(model, RefrigeratorParameters, where).refrigerator


def _parameters(model: ModelHeader | LtiModel, kind: type[P], where: str) -> P:
    try:
        return kind.model_validate(model.plant_parameters)
    except ValidationError as error:
        wrong = explained(error, {}, kind, LISTING)
        raise ModelFileError(f"{where}: plant_parameters: {wrong}; make it with `coldloop model --plant`") from None


@cache
def _box_digest(box: ColdBox) -> str:
    return parameters_digest(box, load_helium())


@cache
def _refrigerator_digest(plant: "Refrigerator") -> str:
    from coldloop_plant.refrigerator.file import refrigerator_digest  # noqa: PLC0415

    return refrigerator_digest(plant, load_helium())
