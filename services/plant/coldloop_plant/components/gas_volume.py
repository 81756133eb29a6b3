"""Gas volume: a line or a vessel of warm helium that has the temperature of its walls.

The lines and their oil separators, coolers and adsorbers are steel of a hundred times the gas's heat capacity, so the
gas stays at the walls' temperature while it is compressed and expanded. The mass is the state: what enters a circuit
of such volumes is then what they hold, to rounding.
"""

from typing import NamedTuple

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.parameters import require
from coldloop_plant.helium.properties import GAS_CONSTANT
from coldloop_plant.numeric import at_least

SECOND_VIRIAL = 2.953e-3  # m3/kg, of helium at 300 K (CoolProp; 2.963e-3 at 290 K, 2.942e-3 at 310 K)


class GasVolume(NamedTuple):
    """A volume of helium at ambient temperature."""

    volume: float
    """m3."""


@kernel
def gas_pressure(volume: GasVolume, mass: float, T: float) -> float:
    """Return P (Pa) of `mass` (kg) at `T` (K), from P V = M (R T + B P); an empty volume has none."""
    mass = at_least(mass, 0.0)
    return mass * GAS_CONSTANT * T / (volume.volume - SECOND_VIRIAL * mass)


@kernel
def gas_density(P: float, T: float) -> float:
    """Return rho (kg/m3) of warm helium at `P` (Pa) and `T` (K)."""
    return P / (GAS_CONSTANT * T + SECOND_VIRIAL * P)


@kernel
def gas_mass(volume: GasVolume, P: float, T: float) -> float:
    """Return the mass (kg) that a volume holds at `P` (Pa) and `T` (K)."""
    return volume.volume * gas_density(P, T)


def check_gas_volume(name: str, volume: GasVolume) -> None:
    """Refuse parameters that no volume has (`ParameterError`)."""
    require(name, "volume", volume.volume, 0.0, 1e4)
