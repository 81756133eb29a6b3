"""Valves of warm helium: compressible flow, choked where the pressure falls far enough; and relief valves."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from plant.components.parameters import require
from plant.components.valve import Valve, effective_area
from plant.helium.properties import GAS_CONSTANT
from plant.numeric import at_least, at_most

GAMMA = 5.0 / 3.0  # of helium
CRITICAL_RATIO = (2.0 / (GAMMA + 1.0)) ** (GAMMA / (GAMMA - 1.0))  # 0.487
CHOKED = np.sqrt(GAMMA) * (2.0 / (GAMMA + 1.0)) ** ((GAMMA + 1.0) / (2.0 * (GAMMA - 1.0)))  # 0.726


class ReliefValve(NamedTuple):
    """A valve that opens in proportion above its set pressure and blows out of the circuit."""

    set_pressure: float
    """Pa."""
    span: float
    """Rise above it at which the valve is fully open, Pa."""
    valve: Valve
    """Flow at that opening."""


@kernel
def gas_valve_flow(valve: Valve, opening: float, P_in: float, P_out: float, T: float) -> float:
    """Return m = A u P phi(r) / sqrt(R T) (kg/s), r = P_out/P_in; no flow against the pressure.

    phi is that of isentropic flow of a perfect gas, constant below the critical ratio. `opening` in %, 0 to 100; P in
    Pa; `T` (K) where the gas enters.
    """
    ratio = at_most(P_out / at_least(P_in, 1.0), 1.0)
    if ratio.real <= CRITICAL_RATIO:
        phi = CHOKED + 0.0 * ratio
    else:
        work = ratio ** (2.0 / GAMMA) - ratio ** ((GAMMA + 1.0) / GAMMA)
        phi = np.sqrt(2.0 * GAMMA / (GAMMA - 1.0) * at_least(work, 0.0))
    flow: float = effective_area(valve, opening) * P_in * phi / np.sqrt(GAS_CONSTANT * T)
    return flow


@kernel
def relief_flow(relief: ReliefValve, P: float, T: float) -> float:
    """Return what a relief valve blows off (kg/s) at `P` (Pa) and `T` (K), into the atmosphere."""
    opening = 100.0 * at_least(P - relief.set_pressure, 0.0) / relief.span
    return gas_valve_flow(relief.valve, opening, P, 1e5, T)


def check_gas_valve(name: str, valve: Valve) -> None:
    """Refuse parameters that no valve has (`ParameterError`)."""
    require(name, "flow_area", valve.flow_area, 0.0, 1.0)


def check_relief_valve(name: str, relief: ReliefValve) -> None:
    """Refuse parameters that no relief valve has (`ParameterError`)."""
    require(name, "set_pressure", relief.set_pressure, 1e5, 1e8)
    require(name, "span", relief.span, 0.0, 1e7)
    check_gas_valve(f"{name}.valve", relief.valve)
