"""The maker of the refrigerator's file: `python -m coldloop_plant.refrigerator.model FILE`.

With `--config` or `--set plant.station.weights.lp_bar=0.02` its gains are of these weights.
"""

import argparse
from pathlib import Path

import numpy as np

from coldloop.config import load_configuration
from coldloop.service.command_line import add_configuration_options
from coldloop.service.start import SECTIONS
from coldloop_plant.cold_box.equilibrium import find_equilibrium
from coldloop_plant.cold_box.plant_file import OPERATING_INPUTS, OPERATING_LEVEL
from coldloop_plant.helium.properties import load_helium
from coldloop_plant.refrigerator.equilibrium import Rest, find_refrigerator_equilibrium
from coldloop_plant.refrigerator.file import RefrigeratorFile, refrigerator_digest
from coldloop_plant.refrigerator.linearisation import jacobian
from coldloop_plant.refrigerator.physics import Refrigerator, check_refrigerator
from coldloop_plant.refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_plant.refrigerator.station_design import line_model, lq_gains
from coldloop_plant.refrigerator.station_settings import LqWeights
from coldloop_plant.settings import PlantSettings


def rest_of(plant: Refrigerator = REFERENCE_REFRIGERATOR) -> Rest:
    """Return the operating point of a refrigerator.

    Raises:
        coldloop_plant.components.parameters.ParameterError: A parameter is out of range.
        coldloop_plant.cold_box.equilibrium.NoEquilibriumError: It does not come to rest.
    """
    check_refrigerator(plant)
    helium = load_helium()
    cold = find_equilibrium(np.array(OPERATING_INPUTS), OPERATING_LEVEL, plant.box, helium)
    return find_refrigerator_equilibrium(cold, plant, helium)


def make_refrigerator_file(
    plant: Refrigerator = REFERENCE_REFRIGERATOR, weights: LqWeights | None = None, rest: Rest | None = None
) -> RefrigeratorFile:
    """Return operating point and gains of a refrigerator at a rest, by default that of `rest_of`, which may raise."""
    weights, rest = weights or LqWeights(), rest or rest_of(plant)
    helium = load_helium()
    lines = line_model(jacobian(rest.x, rest.u, rest.v, rest.d, plant, helium))
    first, second = lq_gains(lines, plant.station.actuator.lag, weights).tolist()
    return RefrigeratorFile(
        parameters_digest=refrigerator_digest(plant, helium),
        x0=tuple(rest.x.tolist()),
        u0=tuple(rest.u.tolist()),
        v0=tuple(rest.v.tolist()),
        w0=float(rest.d[0]),
        gains=(tuple(first), tuple(second)),
        weights=weights,
    )


def main() -> None:
    """Write the file that the command line asks for."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description="Make the file of the refrigerator.")
    add_configuration_options(parser)
    parser.add_argument("file", type=Path, help="what to write")
    options = parser.parse_args()
    station = load_configuration(
        PlantSettings, file=options.config, assignments=options.assignments, others=SECTIONS
    ).settings.plant.station
    make_refrigerator_file(weights=station.weights).save(options.file)


if __name__ == "__main__":
    main()
