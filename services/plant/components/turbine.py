"""Expansion turbine: an inlet valve in series with a choked nozzle, and an expansion of fixed efficiency."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined
from plant.components.valve import Valve, effective_area
from plant.helium.properties import Helium, enthalpy_after_isentropic_expansion, entropy_before_expansion
from plant.numeric import at_least


class Turbine(NamedTuple):
    """A turbine and its inlet valve."""

    inlet_valve: Valve
    """The valve that throttles the gas before the nozzle."""
    nozzle: float
    """Kt of the choked nozzle, m = Kt P / sqrt(T), in kg sqrt(K)/(s Pa)."""
    efficiency: float
    """Isentropic efficiency, 0 to 1."""
    speed_coefficient: float
    """Shaft speed over the square root of the isentropic enthalpy drop, Hz/sqrt(J/kg)."""


class Expansion(NamedTuple):
    """What the turbine makes of the gas."""

    h_out: float
    """Enthalpy of the exhaust, J/kg."""
    speed: float
    """Shaft speed, Hz."""


@inlined
def turbine_flow(turbine: Turbine, opening: float, P_supply: float, T_in: float, density: float) -> tuple[float, float]:
    """Return the mass flow (kg/s) and the pressure between valve and nozzle (Pa).

    The flow m solves valve and nozzle together: m^2 + b m - c P_supply = 0, with c = 2 rho (K u)^2 and
    b = c sqrt(T)/Kt. `density` (kg/m3) is that of the supply, at `P_supply` (Pa) and `T_in` (K); `opening` in %.
    """
    area = effective_area(turbine.inlet_valve, opening)
    root = np.sqrt(T_in) / turbine.nozzle
    c = 2.0 * density * area * area
    b = c * root
    flow = 0.5 * (np.sqrt(b * b + 4.0 * c * P_supply) - b)
    return flow, flow * root


@inlined
def expand(turbine: Turbine, h_in: float, P_in: float, P_out: float, helium: Helium) -> Expansion:
    """Return exhaust and speed for gas at `h_in` (J/kg) that expands from `P_in` to `P_out` (Pa).

    A turbine whose valve shuts does no work: the drop never falls below zero.
    """
    h_isentropic = enthalpy_after_isentropic_expansion(P_out, entropy_before_expansion(P_in, h_in, helium), helium)
    drop = at_least(h_in - h_isentropic, 0.0)
    return Expansion(h_in - turbine.efficiency * drop, turbine.speed_coefficient * np.sqrt(drop))
