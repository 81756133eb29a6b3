"""The command `exergy`."""

import argparse
import sys
from typing import Final

from coldloop.service import add_configuration_options
from coldloop_rig.cli.commands.options import Command, configuration

SAID: Final = {"exergy": "where a refrigerator loses the exergy that it is given"}
GROUP: Final = {"exergy": "a plant and its controller"}  # Group in which `coldloop --help` lists the command


def _declare(parser: argparse.ArgumentParser) -> None:
    add_configuration_options(parser)
    parser.add_argument("--plant", type="read", metavar="FILE", help="plant file (TOML) of another refrigerator")


def execute_exergy(options: argparse.Namespace) -> int:
    """Specific power of a refrigerator at rest, and where the exergy that it is given is lost."""
    from coldloop.errors import UsageError
    from coldloop_plant import equilibrium, helium
    from coldloop_refrigerator import model, plant_file
    from coldloop_refrigerator.exergy import exergy_balance

    settings = configuration(options).settings
    file = plant_file.read_refrigerator(options.plant, settings.limits)
    try:
        rest, _ = model.refrigerator_operating_point(file, helium.load_helium(), settings.plant.station.weights)
    except equilibrium.NoEquilibriumError as error:
        raise UsageError(f"{options.plant or 'the reference refrigerator'}: {error}") from None
    balance = exergy_balance(rest, file.refrigerator, helium.load_helium())
    of_all, of_electricity = (100.0 * balance.useful / each for each in (balance.put_in, balance.electricity))
    lines = [
        f"cold power {balance.cold_power:.1f} W at {balance.T_bath:.3f} K, load and heater",
        f"specific power {balance.specific_power:.0f} W/W of electricity; Carnot {balance.ideal_power:.1f} W/W",
        f"Carnot fraction {of_electricity:.2f} % by the electricity, {of_all:.2f} % with the nitrogen's exergy",
        "",
        f"{'exergy':26} {'kW':>9} {'%':>8}",
    ]
    rows = {
        "electricity": balance.electricity,
        "liquid nitrogen": balance.nitrogen,
        "": 0.0,
        **dict(sorted(balance.destroyed.items(), key=lambda row: -row[1])),
        "useful: of the cold power": balance.useful,
        "sum": balance.useful + sum(balance.destroyed.values()),
    }
    for name, exergy in rows.items():
        kilowatts, share = (round(each, 3) + 0.0 for each in (1e-3 * exergy, 100.0 * exergy / balance.put_in))  # no -0
        lines.append(f"{name:26} {kilowatts:9.3f} {share:8.2f}" if name else "")
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


COMMANDS: Final = {"exergy": Command(_declare, execute_exergy)}
