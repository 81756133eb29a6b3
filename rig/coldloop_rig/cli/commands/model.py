"""`coldloop model`: the plant at its operating point, and its linear model as both PLCs run it."""

import argparse
import sys

from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands.options import configuration


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--plant", type="read", metavar="FILE", help="plant file (TOML): parameters of another plant")
    parser.add_argument("--out", type="write", metavar="FILE", help="write the model file, for model.file")


def execute(options: argparse.Namespace) -> int:
    """Solve, linearise, print; write the model file when there is --out; reject an invalid configured model."""
    from coldloop.errors import UsageError
    from coldloop.process.lti_model import load
    from coldloop.whole_file import require_regular_file
    from coldloop_plant.cold_box.plant_file import PlantFile
    from coldloop_plant.equilibrium import NoEquilibriumError
    from coldloop_plant.refrigerator.plant_file import RefrigeratorPlantFile, read_plant_file
    from coldloop_plant.settings import PlantKind
    from coldloop_rig.cli.model_listing import describe_model, held_line

    if options.out is not None:
        require_regular_file(options.out)
    settings = configuration(options).settings
    in_use = settings.model.file
    whole = settings.plant.kind is PlantKind.REFRIGERATOR
    if options.plant is not None:
        plant = read_plant_file(options.plant, settings.limits, whole=whole)
    else:
        plant = RefrigeratorPlantFile() if whole else PlantFile()
    if options.out is not None and options.plant is not None and options.out.resolve() == options.plant.resolve():
        raise UsageError(f"{options.out}: is the plant file; name another one with --out")
    try:
        model, text, box = describe_model(in_use, plant, settings.optimizer_plc.program.design, settings.plant.station)
    except NoEquilibriumError as error:
        raise UsageError(f"{options.plant or 'the reference plant'}: {error}") from None
    sys.stdout.write(text)
    if options.out is not None:
        try:
            model.save(options.out)
        except OSError as error:
            raise UsageError(f"{options.out}: {error.strerror}; name a file that can be written with --out") from None
        sys.stdout.write(f"written to {options.out}\n")
    sys.stdout.flush()
    if options.plant is not None:  # a long search
        sys.stdout.write(
            held_line(box, plant.operating_point.level_pct, settings.optimizer_plc.program.design, settings.limits)
        )
    load(in_use)
    return 0
