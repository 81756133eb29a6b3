"""Makes the plant of a process other than the cold box, from what its model file says of it."""

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from coldloop.errors import ModelFileError
from coldloop.kernels.first_use import kernels_of
from coldloop.process.lti_model import load as load_model
from coldloop.process.model_file import ModelHeader
from coldloop_plant.own.disturbances import Disturbances
from coldloop_plant.own.linear import LinearPlant
from coldloop_plant.own.python_class import HiddenPythonPlant, PythonPlant, equations_of
from coldloop_plant.own.transfer_functions import TransferFunctionPlant, lags_of
from coldloop_plant.program import HeatLoad, MeasurementNoise, PlantProgram
from coldloop_plant.rack.rack import MakePlant

NoiseOfSeed = Callable[[int], MeasurementNoise | None]

PYTHON: Final = "python"
"""Kinds of plants: `ModelHeader.plant`."""
LINEAR: Final = "linear"
TRANSFER_FUNCTIONS: Final = "transfer-functions"
FMU: Final = "fmu"


def check_files(header: ModelHeader) -> None:
    """Check that the files that a model was made from are there.

    Raises:
        ModelFileError: Its FMU is another file than it was made from.
    """
    if header.plant == FMU:
        _fmu_of(header)


def _fmu_of(header: ModelHeader) -> Path:
    """Return the FMU that a model was made from: where it was then, or beside the model file."""
    source = Path(header.plant_parameters["file"])
    for place in (source, header.file.parent / source.name):
        if place.is_file() and file_digest(place) == header.parameters_digest:
            return place
    raise ModelFileError(
        f"{header.file}: made from another {source} than is there or beside it; make it again, `coldloop process`"
    )


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file that a plant is made from, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def own_plant_maker(header: ModelHeader, noise_of_seed: NoiseOfSeed) -> MakePlant:
    """Return what makes the plant at its operating point.

    Args:
        header: Of the model file.
        noise_of_seed: Returns the noise of the sensors.

    Raises:
        ModelFileError: The plant cannot be made.
    """
    process = header.declared
    disturbances = Disturbances.of(header.plant_parameters.get("disturbances", ()))
    w0 = (header.w0, *header.x0[len(header.x0) - len(disturbances.courses) :])
    if header.plant == FMU:
        return _fmu_plant_maker(header, noise_of_seed, disturbances, w0)
    if header.plant == PYTHON:
        parameters = header.plant_parameters
        made_now = partial(equations_of, parameters["source"], parameters["class"], parameters["file"])
        made_now()  # a source that does not run is refused before a session begins
        kind = partial(HiddenPythonPlant, rest=parameters["rest"]) if "rest" in parameters else PythonPlant

        def make(load: HeatLoad, seed: int) -> PlantProgram:
            return kind(  # each session has an instance of its own, for a class may have a memory
                made_now(), x0=header.x0, u0=header.u0, load=load, disturbances=disturbances, noise=noise_of_seed(seed),
                process=process,
            )  # fmt: skip

    elif header.plant == TRANSFER_FUNCTIONS:
        lags = lags_of(header.plant_parameters["lags"])

        def make(load: HeatLoad, seed: int) -> PlantProgram:
            with kernels_of(f"the {process.name}", about_s=3):
                return TransferFunctionPlant(
                    lags, y0=header.y0, u0=header.u0, w0=w0, load=load, disturbances=disturbances,
                    noise=noise_of_seed(seed), process=process,
                )  # fmt: skip

    else:
        model = load_model(header.file)

        def make(load: HeatLoad, seed: int) -> PlantProgram:
            with kernels_of(f"the {process.name}", about_s=3):
                return LinearPlant(model, load, noise_of_seed(seed), disturbances)

    return make


def _fmu_plant_maker(
    header: ModelHeader, noise_of_seed: NoiseOfSeed, disturbances: Disturbances, w0: tuple[float, ...]
) -> MakePlant:
    from coldloop_plant.own.fmu import FmuPlant, Wiring, fmu_maker  # noqa: PLC0415 few plants are FMUs
    from coldloop_plant.own.fmu_file import Fmu  # noqa: PLC0415

    fmu = Fmu(_fmu_of(header))
    at_rest = fmu_maker(fmu, Wiring(**header.plant_parameters["wiring"]), header.u0, w0, header.declared.tick_s)

    def make(load: HeatLoad, seed: int) -> PlantProgram:
        return FmuPlant(
            at_rest(), keeps_state=fmu.keeps_state, u0=header.u0, load=load, disturbances=disturbances,
            noise=noise_of_seed(seed), process=header.declared,
        )  # fmt: skip

    return make
