"""Makes the plant of a process other than the cold box, from what its model file says of it."""

from collections.abc import Callable
from typing import Final

from coldloop.errors import ModelFileError
from coldloop.process.lti_model import load as load_model
from coldloop.process.model_file import ModelHeader
from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from plant.own.linear import LinearPlant
from plant.own.python_class import PythonPlant, equations_of
from plant.own.transfer_functions import TransferFunctionPlant, lags_of
from plant.program import HeatLoad, MeasurementNoise, PlantProgram
from plant.rack.rack import MakePlant

NoiseOfSeed = Callable[[int], MeasurementNoise | None]

PYTHON: Final = "python"
"""Kinds of plants: `ModelHeader.plant`."""
LINEAR: Final = "linear"
TRANSFER_FUNCTIONS: Final = "transfer-functions"


def check_signals(header: ModelHeader) -> None:
    """Check that a model file is of the process that this program is loaded with.

    Raises:
        ModelFileError: It is not.
    """
    if (header.state_names, header.input_names, header.output_names) != (STATE_NAMES, INPUT_NAMES, OUTPUT_NAMES):
        raise ModelFileError(
            f"{header.file}: a model of another process than COLDLOOP_PROCESS names; name the same for both"
        )


def own_plant_maker(header: ModelHeader, noise_of_seed: NoiseOfSeed) -> MakePlant:
    """Return what makes the plant at its operating point.

    Args:
        header: Of the model file.
        noise_of_seed: Returns the noise of the sensors.

    Raises:
        ModelFileError: The plant cannot be made.
    """
    if header.plant == PYTHON:
        parameters = header.plant_parameters
        equations = equations_of(parameters["source"], parameters["class"], parameters["file"])

        def make(load: HeatLoad, seed: int) -> PlantProgram:
            return PythonPlant(equations, x0=header.x0, u0=header.u0, load=load, noise=noise_of_seed(seed))

    elif header.plant == TRANSFER_FUNCTIONS:
        lags = lags_of(header.plant_parameters["lags"])

        def make(load: HeatLoad, seed: int) -> PlantProgram:
            return TransferFunctionPlant(
                lags, y0=header.y0, u0=header.u0, w0=header.w0, load=load, noise=noise_of_seed(seed)
            )

    else:
        model = load_model(header.file)

        def make(load: HeatLoad, seed: int) -> PlantProgram:
            return LinearPlant(model, load, noise_of_seed(seed))

    return make
