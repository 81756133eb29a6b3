"""Valves: control valves with their drives, incompressible and compressible flow, relief valves.

A linear characteristic; gas is choked where the pressure falls far enough.
"""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant.helium.properties import GAS_CONSTANT
from coldloop_plant.numeric import at_least, at_most


class Valve(NamedTuple):
    """A control valve."""

    flow_area: float
    """Effective area when fully open, m2."""


@inlined
def effective_area(valve: Valve, opening: float) -> float:
    """Return the effective area (m2) at `opening` (%), which saturates at 0 and 100 %."""
    return valve.flow_area * at_most(at_least(opening, 0.0), 100.0) / 100.0


@inlined
def valve_mass_flow(valve: Valve, opening: float, density: float, P_in: float, P_out: float) -> float:
    """Return m = K u sqrt(2 rho (P_in - P_out)) in kg/s; no flow against the pressure."""
    mass_flux: float = np.sqrt(2.0 * density * at_least(P_in - P_out, 0.0))
    return effective_area(valve, opening) * mass_flux


class Actuator(NamedTuple):
    """A pneumatic drive with its positioner."""

    lag: float
    """Time constant, s; 0.5 or more, for a step of 0.25 s."""
    fastest: float
    """Largest speed, %/s."""


@kernel
def opening_rate(actuator: Actuator, opening: float, command: float) -> float:
    """Return how fast an opening (%) moves towards its command (%, held within 0 and 100), in %/s."""
    aim = at_most(at_least(command, 0.0), 100.0)
    return at_most(at_least((aim - opening) / actuator.lag, -actuator.fastest), actuator.fastest)


GAMMA = 5.0 / 3.0  # of helium
CRITICAL_RATIO = (2.0 / (GAMMA + 1.0)) ** (GAMMA / (GAMMA - 1.0))  # 0.487
DENSE_BELOW, GAS_ABOVE = 12.0, 24.0  # K: between them helium at 16 bar becomes a gas that is nearly perfect
LAMINAR_RATIO = 0.999  # above it the flow is linear in the pressure difference: its slope stays finite
CHOKED = np.sqrt(GAMMA) * (2.0 / (GAMMA + 1.0)) ** ((GAMMA + 1.0) / (2.0 * (GAMMA - 1.0)))  # 0.726


class ReliefValve(NamedTuple):
    """A valve that opens with the square of the rise above its set pressure and blows out of the circuit.

    So the flow's slope is 0 where it opens: there the return line is at its steepest when the compressors stand, and
    both together were too stiff for a step of 0.25 s.
    """

    set_pressure: float
    """Pa."""
    span: float
    """Rise above it at which the valve is fully open, Pa."""
    valve: Valve
    """Flow at that opening."""


@inlined
def expansion(ratio: float) -> float:
    """Return phi of isentropic flow of a perfect gas at a pressure ratio (0 to 1), constant below the critical one."""
    if ratio.real <= CRITICAL_RATIO:
        choked: float = CHOKED + 0.0 * ratio
        return choked
    held = at_most(ratio, LAMINAR_RATIO)
    work = held ** (2.0 / GAMMA) - held ** ((GAMMA + 1.0) / GAMMA)
    phi: float = np.sqrt(2.0 * GAMMA / (GAMMA - 1.0) * at_least(work, 0.0))
    if ratio.real > LAMINAR_RATIO:
        phi = phi * at_least(1.0 - ratio, 0.0) / (1.0 - LAMINAR_RATIO)
    return phi


@kernel
def gas_valve_flow(valve: Valve, opening: float, P_in: float, P_out: float, T: float) -> float:
    """Return m = A u P phi(r) / sqrt(R T) (kg/s), r = P_out/P_in; no flow against the pressure.

    phi is `expansion`. `opening` in %, 0 to 100; P in Pa; `T` (K) where the gas enters.
    """
    phi = expansion(at_most(P_out / at_least(P_in, 1.0), 1.0))
    flow: float = effective_area(valve, opening) * P_in * phi / np.sqrt(GAS_CONSTANT * T)
    return flow


@inlined
def cold_valve_flow(valve: Valve, opening: float, T: float, density: float, P_in: float, P_out: float) -> float:
    """Return m (kg/s) through a valve that passes dense helium in operation and gas while the plant is warm.

    Up to 12 K that of a liquid, from 24 K on m = A u phi(r) sqrt(rho P), choked, between them a smooth mean. `T` (K),
    `density` (kg/m3) and `P_in` (Pa) are those before the valve.
    """
    liquid = valve_mass_flow(valve, opening, density, P_in, P_out)
    warmer = (T - DENSE_BELOW) / (GAS_ABOVE - DENSE_BELOW)
    if warmer.real <= 0.0:
        return liquid
    warmer = at_most(warmer, 1.0)
    share = warmer * warmer * (3.0 - 2.0 * warmer)
    phi = expansion(at_most(P_out / at_least(P_in, 1.0), 1.0))
    gas: float = effective_area(valve, opening) * phi * np.sqrt(density * at_least(P_in, 0.0))
    return liquid + share * (gas - liquid)


@kernel
def relief_flow(relief: ReliefValve, P: float, T: float) -> float:
    """Return what a relief valve blows off (kg/s) at `P` (Pa) and `T` (K), into the atmosphere."""
    rise = at_least(P - relief.set_pressure, 0.0) / relief.span
    opening = 100.0 * rise * rise
    return gas_valve_flow(relief.valve, opening, P, 1e5, T)
