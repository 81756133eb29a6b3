"""Parts in which helium expands: valves, the turbine with its inlet valve, and the return that its exhaust joins.

Control valves have a linear characteristic; gas is choked where the pressure falls far enough.

In operation the turbine's nozzle is choked and the pressure behind it does not count. Near a standstill it does: the
flow follows the pressure ratio, never uphill (`throttled_flow`), and windage takes what little work the gas does. The
return is two flow resistances in series, with the exhaust joining between them.
"""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant import helium as properties
from coldloop_plant.helium import GAS_CONSTANT, Helium
from coldloop_plant.numeric import at_least, at_most


class Valve(NamedTuple):
    """A control valve."""

    flow_area: float  # Effective area when fully open, m2


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

    lag: float  # Time constant, s; 0.5 or more, for a step of 0.25 s
    fastest: float  # Largest speed, %/s


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

    set_pressure: float  # Pa
    span: float  # Rise above it at which the valve is fully open, Pa
    valve: Valve  # Flow at that opening


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


LAMINAR = 2.5e4  # Pa s/kg, half of the slope of the pressure drop at rest; an exhaust of 22 g/s makes as much


class ReturnLine(NamedTuple):
    """The way of the vapour from the bath to the compressor."""

    cold_resistance: float  # From the bath to the mixing point, Pa s2/kg2
    warm_resistance: float  # From the mixing point to the compressor, Pa s2/kg2


@inlined
def return_flow(
    line: ReturnLine, P_bath: float, P_suction: float, joining_flow: float, thinness: float
) -> tuple[float, float]:
    """Return the mass flow of the vapour (kg/s) and the pressure at the mixing point (Pa).

    The flow m_v solves P_bath - P_suction = r_c m_v^2 + r_w (m_v + m_t)^2; nothing flows back into the bath. Where no
    exhaust joins, a laminar part keeps the flow's slope finite near rest. `thinness` is by how much the
    vapour is thinner than saturated vapour: its pressure drop grows in proportion. That of a dry bath is, by more than
    1; what carries liquid along is denser.
    """
    total = thinness * line.cold_resistance + line.warm_resistance
    half_slope = at_least(line.warm_resistance * joining_flow, LAMINAR) + (thinness - 1.0) * LAMINAR
    rest = at_least(P_bath - P_suction - line.warm_resistance * joining_flow * joining_flow, 0.0)
    vapour_flow = at_least(np.sqrt(half_slope * half_slope + total * rest) - half_slope, 0.0) / total
    sum_flow = vapour_flow + joining_flow
    return vapour_flow, P_suction + line.warm_resistance * sum_flow * sum_flow


BISECTIONS = 40
SHUT = 1e-12  # m2, of a valve that passes less than 2e-5 g/s
SMALL_FLOW, SMALL_PRESSURE = 1e-9, 1.0  # kg/s and Pa, of difference quotients


class Turbine(NamedTuple):
    """A turbine and its inlet valve."""

    inlet_valve: Valve  # The valve that throttles the gas before the nozzle
    nozzle: float  # Kt of the choked nozzle, m = Kt P / sqrt(T), in kg sqrt(K)/(s Pa)
    efficiency: float  # Isentropic efficiency, 0 to 1
    speed_coefficient: float  # Shaft speed over the square root of the isentropic enthalpy drop, Hz/sqrt(J/kg)
    windage_flow: float  # Flow (kg/s) below which windage takes the work: in proportion less of it reaches the brake


class Back(NamedTuple):
    """Conditions behind the turbine, which the exhaust meets."""

    line: ReturnLine
    P_bath: float  # Pa
    P_suction: float  # Pa
    thinness: float  # Thinness of the vapour, see `return_flow`


class Expansion(NamedTuple):
    """Exhaust of the turbine and its shaft speed."""

    h_out: float  # Enthalpy of the exhaust, J/kg
    speed: float  # Shaft speed, Hz


@inlined
def turbine_flow(turbine: Turbine, opening: float, P_supply: float, T_in: float, density: float) -> tuple[float, float]:
    """Return the mass flow (kg/s) and the pressure between valve and nozzle (Pa).

    The flow m solves valve and choked nozzle together: m^2 + b m - c P_supply = 0, with c = 2 rho (K u)^2 and
    b = c sqrt(T)/Kt. `density` (kg/m3) is that of the supply, at `P_supply` (Pa) and `T_in` (K); `opening` in %.
    A valve that leaves less than the critical share of the supply pressure is choked and passes no more.
    """
    area = effective_area(turbine.inlet_valve, opening)
    root = np.sqrt(T_in) / turbine.nozzle
    c = 2.0 * density * area * area
    b = c * root
    flow = 0.5 * (np.sqrt(b * b + 4.0 * c * P_supply) - b)
    if (flow * root).real < CRITICAL_RATIO * P_supply.real:
        flow = np.sqrt((1.0 - CRITICAL_RATIO) * c * P_supply)
    return flow, flow * root


@kernel
def throttled_flow(
    turbine: Turbine, opening: float, P_supply: float, T_in: float, density: float, back: Back
) -> tuple[float, float, float, float]:
    """Return the flow through a turbine whose nozzle is not choked, and what it makes of the pressures.

    The flow lies between none and what the valve passes when it is choked; it raises the pressure behind the nozzle and
    lowers that before it. Where the nozzle passes all that a choked valve does, the pressure between them is as low as
    it needs for that. Bisection, and a last step of Newton's method that carries derivatives.

    Returns:
        m (kg/s), the pressure between valve and nozzle (Pa), the vapour's flow (kg/s), the mixing pressure (Pa).
    """
    area = effective_area(turbine.inlet_valve, opening)
    none = 0.0 * (P_supply + T_in + density + back.P_bath + back.P_suction + area)
    c = 2.0 * density * area * area + none
    if area.real < SHUT:
        m_v, P_mix = return_flow(back.line, back.P_bath, back.P_suction, none, back.thinness)
        return none, P_mix + none, m_v + none, P_mix + none
    choked = np.sqrt((1.0 - CRITICAL_RATIO) * c * P_supply)
    excess, _, m_v, P_mix = _flow_excess(turbine, c, choked, P_supply, T_in, back)
    if excess.real < 0.0:
        P_between = _nozzle_inlet(turbine, choked, P_mix, CRITICAL_RATIO * P_supply, T_in)
        return choked, P_between, m_v + none, P_mix + none
    low, high = 0.0, choked.real
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        excess, _, _, _ = _flow_excess(turbine, c, middle + none, P_supply, T_in, back)
        if excess.real > 0.0:
            high = middle
        else:
            low = middle
    flow = 0.5 * (low + high) + none
    excess, _, _, _ = _flow_excess(turbine, c, flow, P_supply, T_in, back)
    further, _, _, _ = _flow_excess(turbine, c, flow + SMALL_FLOW, P_supply, T_in, back)
    flow -= excess * SMALL_FLOW / at_least(further.real - excess.real, 1e-3 * SMALL_FLOW)
    flow = at_most(at_least(flow, 0.0), choked)
    _, P_between, m_v, P_mix = _flow_excess(turbine, c, flow, P_supply, T_in, back)
    return flow, P_between + none, m_v + none, P_mix + none


@kernel
def _flow_excess(
    turbine: Turbine, c: float, flow: float, P_supply: float, T_in: float, back: Back
) -> tuple[float, float, float, float]:
    """Return by how much a flow is more than what the nozzle passes (kg/s), and what `throttled_flow` returns."""
    P_between = at_least(P_supply - flow * flow / c, 0.0)
    m_v, P_mix = return_flow(back.line, back.P_bath, back.P_suction, flow, back.thinness)
    return flow - _nozzle_flow(turbine, P_between, P_mix, T_in), P_between, m_v, P_mix


@inlined
def _nozzle_flow(turbine: Turbine, P_in: float, P_out: float, T_in: float) -> float:
    """Return what the nozzle passes between two pressures (kg/s)."""
    ratio = at_most(P_out / at_least(P_in, 1.0), 1.0)
    flow: float = turbine.nozzle * P_in / np.sqrt(T_in) * expansion(ratio) / CHOKED
    return flow


@kernel
def _nozzle_inlet(turbine: Turbine, flow: float, P_out: float, highest: float, T_in: float) -> float:
    """Return the pressure (Pa, `highest` or less) with which the nozzle passes a flow (kg/s)."""
    low, high = P_out.real, highest.real
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _nozzle_flow(turbine, middle + 0.0 * P_out, P_out, T_in).real > flow.real:
            high = middle
        else:
            low = middle
    P_in = 0.5 * (low + high) + 0.0 * (flow + P_out + highest + T_in)
    passed = _nozzle_flow(turbine, P_in, P_out, T_in)
    further = _nozzle_flow(turbine, P_in + SMALL_PRESSURE, P_out, T_in)
    return P_in + (flow - passed) * SMALL_PRESSURE / at_least(further.real - passed.real, 1e-12)


@inlined
def expand(turbine: Turbine, flow: float, h_in: float, P_in: float, P_out: float, helium: Helium) -> Expansion:
    """Return exhaust and speed for gas at `h_in` (J/kg) that expands from `P_in` to `P_out` (Pa), `flow` in kg/s.

    A turbine whose valve shuts does no work: the drop never falls below zero. With little flow the wheel turns slowly.
    """
    h_isentropic = properties.enthalpy_after_isentropic_expansion(
        P_out, properties.entropy_before_expansion(P_in, h_in, helium), helium
    )
    drop = at_least(h_in - h_isentropic, 0.0)
    share = at_most(flow / turbine.windage_flow, 1.0)
    return Expansion(h_in - turbine.efficiency * share * drop, turbine.speed_coefficient * np.sqrt(share * drop))
