"""Phase separator: a bath of liquid helium and its vapour, in equilibrium at one pressure."""

from typing import NamedTuple

from coldloop.kernels.compiled import inlined
from plant.helium.properties import Helium, saturation, saturation_slopes
from plant.numeric import at_least, at_most


class PhaseSeparator(NamedTuple):
    """A vessel that holds boiling helium."""

    volume: float
    """m3."""


@inlined
def level(separator: PhaseSeparator, V_l: float) -> float:
    """Return the level (%, 0 to 100) of a liquid volume `V_l` (m3)."""
    return at_most(at_least(100.0 * V_l / separator.volume, 0.0), 100.0)


@inlined
def contents(separator: PhaseSeparator, P: float, V_l: float, helium: Helium) -> tuple[float, float]:
    """Return the mass (kg) and the internal energy (J) of the helium in the vessel."""
    sat = saturation(P, helium)
    V_v = separator.volume - V_l
    mass = sat.rho_l * V_l + sat.rho_v * V_v
    return mass, sat.rho_l * sat.h_l * V_l + sat.rho_v * sat.h_v * V_v - P * separator.volume


@inlined
def separate(
    separator: PhaseSeparator,
    P: float,
    V_l: float,
    inflow: float,
    h_in: float,
    vapour_outflow: float,
    heat: float,
    helium: Helium,
) -> tuple[float, float]:
    """Return dP/dt (Pa/s) and dV_l/dt (m3/s) from the balances of mass and of energy.

    `inflow` (kg/s) enters with `h_in` (J/kg), `vapour_outflow` (kg/s) leaves as saturated vapour, `heat` in W. A full
    vessel spills the surplus liquid; in an empty one the surplus heat is lost, as superheat that is not modelled.
    """
    sat, slope = saturation(P, helium), saturation_slopes(P, helium)
    V_v = separator.volume - V_l
    mass_P = slope.rho_l * V_l + slope.rho_v * V_v
    mass_V = sat.rho_l - sat.rho_v
    energy_P = (slope.rho_l * sat.h_l + sat.rho_l * slope.h_l) * V_l - separator.volume
    energy_P += (slope.rho_v * sat.h_v + sat.rho_v * slope.h_v) * V_v
    energy_V = sat.rho_l * sat.h_l - sat.rho_v * sat.h_v
    dM = inflow - vapour_outflow
    dU = inflow * h_in - vapour_outflow * sat.h_v + heat
    determinant = mass_P * energy_V - mass_V * energy_P
    dP = (dM * energy_V - mass_V * dU) / determinant
    dV = (mass_P * dU - energy_P * dM) / determinant
    if V_l.real <= 0.0 and dV.real < 0.0:
        return dM / mass_P, 0.0 * dV
    if V_v.real <= 0.0 and dV.real > 0.0:
        return (dU - sat.h_l * dM) / (energy_P - sat.h_l * mass_P), 0.0 * dV
    return dP, dV
