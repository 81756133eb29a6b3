"""Phase separator: a bath of liquid helium and its vapour, in equilibrium at one pressure.

Its second state is the liquid volume V_l. Two extensions make it whole:

* **dry**: below 0 it says how far the vapour is superheated, h = h_v - SUPERHEAT V_l/V, and the wall warms with it;
* **full**: above 97 % the vapour that leaves carries liquid along, at 100 % nothing but liquid leaves.

Mass and energy are functions of the two states everywhere, and the rates are those of their balances.
"""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant import helium as properties
from coldloop_plant.components.expansion import CHOKED
from coldloop_plant.helium import WARM_CP, Helium, Saturation, read_curve, saturation, saturation_slopes
from coldloop_plant.numeric import Array, at_least, at_most

SUPERHEAT = 5e4  # J/kg, of the vapour in a dry vessel at V_l = -V: mass and energy then bend little where it runs dry
CARRY_OVER = 0.97  # share of the vessel from which on the vapour carries liquid along
COLD_WALL = 4.0  # K, the wall's temperature where the vapour is saturated; it has next to no heat capacity there
LEAST_MASS, LEAST_ENERGY = 2e-12, 1e-7  # kg and J in a step: what is less is left alone
ROUNDING = 1e-14  # share of mass and energy to which `holding` solves: a hot wall has 1e7 J
MAX_NEWTON_STEPS = 30
JUST_DRY = 1e-16  # m3
LEAST_PRESSURE, CRITICAL_PRESSURE = 0.05e5, 2.28e5  # Pa


class PhaseSeparator(NamedTuple):
    """A vessel that holds boiling helium."""

    volume: float  # m3
    wall: float  # Aluminium of the vessel and what is in it, kg, that warms when the vessel is dry
    relief_pressure: float  # Pressure at which the relief valve to the recovery line begins to open, Pa
    relief_span: float  # Rise above it at which the valve is fully open, Pa
    relief_area: float  # Its flow area then, m2


class Content(NamedTuple):
    """Content of the vessel, and its derivatives with respect to P (Pa) and to V_l (m3)."""

    mass: float  # kg
    energy: float  # Internal energy of the helium, and what the wall holds above `COLD_WALL`, J
    M_P: float
    M_V: float
    U_P: float
    U_V: float


class Outflow(NamedTuple):
    """Flow that leaves at the top of the vessel."""

    T: float  # K
    h: float  # J/kg; below that of saturated vapour where it carries liquid along
    rho: float  # Density, kg/m3; of the mixture where it carries liquid along


@inlined
def level(separator: PhaseSeparator, V_l: float) -> float:
    """Return the level (%, 0 to 100) of a liquid volume `V_l` (m3)."""
    return at_most(at_least(100.0 * V_l / separator.volume, 0.0), 100.0)


@inlined
def content(separator: PhaseSeparator, P: float, V_l: float, helium: Helium) -> Content:
    """Return mass and energy in the vessel, with their derivatives."""
    if V_l.real < 0.0:
        return dry_content(separator, P, V_l, helium)
    sat, slope = saturation(P, helium), saturation_slopes(P, helium)
    V_v = separator.volume - V_l
    U_P = (slope.rho_l * sat.h_l + sat.rho_l * slope.h_l) * V_l - separator.volume
    U_P += (slope.rho_v * sat.h_v + sat.rho_v * slope.h_v) * V_v
    return Content(
        sat.rho_l * V_l + sat.rho_v * V_v,
        sat.rho_l * sat.h_l * V_l + sat.rho_v * sat.h_v * V_v - P * separator.volume,
        slope.rho_l * V_l + slope.rho_v * V_v,
        sat.rho_l - sat.rho_v,
        U_P,
        sat.rho_l * sat.h_l - sat.rho_v * sat.h_v,
    )


@kernel
def dry_content(separator: PhaseSeparator, P: float, V_l: float, helium: Helium) -> Content:
    """Return the same for a vessel that holds superheated vapour."""
    sat, slope = saturation(P, helium), saturation_slopes(P, helium)
    V, per_volume = separator.volume, SUPERHEAT / separator.volume
    excess = -per_volume * V_l
    h = sat.h_v + excess
    rho, rho_P, rho_h = properties.vapour_density(P, excess, sat, slope, helium)
    T_wall = COLD_WALL + excess / WARM_CP
    T = at_most(T_wall, properties.WARMEST_ISOBAR)  # above it the wall has the heat capacity that it has there
    table = helium.isobar
    i, t = properties.locate(np.log(T), table.start, table.step, table.before, table.nodes.shape[0])
    values, slopes = properties.hermite_weights(t), properties.hermite_slope_weights(t)
    capacity = read_curve(table.nodes, i, properties.ALUMINIUM_ENTHALPY, slopes) / (table.step * T)
    stored = read_curve(table.nodes, i, properties.ALUMINIUM_ENTHALPY, values) + capacity * (T_wall - T)
    stored, wall = separator.wall * stored, separator.wall * capacity / WARM_CP
    return Content(
        V * rho,
        V * (rho * h - P) + stored,
        V * rho_P,
        -per_volume * V * rho_h,
        V * (rho_P * h + rho * slope.h_v - 1.0),
        -per_volume * (V * (rho_h * h + rho) + wall),
    )


@inlined
def outflow(separator: PhaseSeparator, P: float, V_l: float, sat: Saturation, helium: Helium) -> Outflow:
    """Return what leaves a vessel at `P` (Pa), whose saturation properties are `sat`."""
    if V_l.real < 0.0:
        excess = -SUPERHEAT / separator.volume * V_l
        rho = dry_content(separator, P, V_l, helium).mass / separator.volume
        return Outflow(properties.vapour_temperature(P, sat.h_v + excess, sat, helium), sat.h_v + excess, rho)
    liquid = carried_liquid(separator, V_l)
    return Outflow(sat.T, sat.h_v - liquid * (sat.h_v - sat.h_l), sat.rho_v / mixture_thinness(liquid, sat))


@inlined
def carried_liquid(separator: PhaseSeparator, V_l: float) -> float:
    """Return the share of liquid in what leaves a vessel, by mass."""
    share = at_most(at_least((V_l / separator.volume - CARRY_OVER) / (1.0 - CARRY_OVER), 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@inlined
def mixture_thinness(liquid: float, sat: Saturation) -> float:
    """Return by how much a mixture with this share of liquid is thinner than saturated vapour, 1 or less."""
    thin: float = 1.0 - liquid * (1.0 - sat.rho_v / sat.rho_l)
    return thin


@inlined
def thinness(separator: PhaseSeparator, P: float, V_l: float, helium: Helium) -> float:
    """Return by how much what leaves is thinner than saturated vapour: 1 but in a dry vessel, and in a full one."""
    if V_l.real >= 0.0:
        liquid = carried_liquid(separator, V_l)
        if liquid.real <= 0.0:
            return 1.0 + 0.0 * P
        return mixture_thinness(liquid, saturation(P, helium))
    thin: float = separator.volume * saturation(P, helium).rho_v / dry_content(separator, P, V_l, helium).mass
    return thin


@inlined
def bath_relief(separator: PhaseSeparator, P: float, rho: float) -> float:
    """Return what the relief valve blows into the recovery line (kg/s): choked flow of density `rho`."""
    opened = at_most(at_least(P - separator.relief_pressure, 0.0) / separator.relief_span, 1.0)
    flow: float = separator.relief_area * opened * CHOKED * np.sqrt(P * rho)
    return flow


@inlined
def separate(
    c: Content, inflow: float, h_in: float, outflow: float, h_out: float, heat: float
) -> tuple[float, float]:  # fmt: skip
    """Return dP/dt (Pa/s) and dV_l/dt (m3/s) of a vessel that holds `c`, from the balances of mass and of energy.

    `inflow` (kg/s) enters with `h_in` (J/kg), `outflow` (kg/s) leaves with `h_out`, `heat` in W.
    """
    dM = inflow - outflow
    dU = inflow * h_in - outflow * h_out + heat
    determinant = c.M_P * c.U_V - c.M_V * c.U_P
    dP = (dM * c.U_V - c.M_V * dU) / determinant
    dV = (c.M_P * dU - c.U_P * dM) / determinant
    return dP, dV


class Account(NamedTuple):
    """Content of a bath at the start of a step, and the sum of its weighted rates over the stages.

    Mass and energy are curved functions of P and V_l, with bends where the vessel runs dry or a flow stops: integrating
    the two states keeps them to 1e-14 kg a step in ordinary operation, and not there. An account does everywhere.
    """

    mass: float  # kg
    energy: float  # J
    inflow: float  # kg/s
    heat: float  # W


@inlined
def start_account(c: Content, slope: Array) -> Account:
    """Begin to keep account of a step of a bath that holds `c` and whose P and V_l have the rates `slope[:2]`."""
    return Account(c.mass, c.energy, c.M_P * slope[0] + c.M_V * slope[1], c.U_P * slope[0] + c.U_V * slope[1])


@inlined
def add_to_account(account: Account, c: Content, slope: Array, weight: float) -> Account:
    """Add the rates of a stage at which the bath holds `c`."""
    stage = start_account(c, slope)
    return Account(
        account.mass, account.energy, account.inflow + weight * stage.inflow, account.heat + weight * stage.heat
    )


@inlined
def settle_account(separator: PhaseSeparator, account: Account, dt: float, x: Array, helium: Helium) -> None:
    """Correct P and V_l in `x`, if need be, so that the bath holds what the account says; `dt` (s) is of a weight."""
    mass, energy = account.mass + dt * account.inflow, account.energy + dt * account.heat
    c = content(separator, x[0], x[1], helium)
    if abs(mass - c.mass) > LEAST_MASS or abs(energy - c.energy) > LEAST_ENERGY:
        found, P, V_l = holding(separator, x[0], x[1], mass, energy, helium)
        if found:
            x[0], x[1] = P, V_l


@kernel
def holding(
    separator: PhaseSeparator, P: float, V_l: float, mass: float, energy: float, helium: Helium
) -> tuple[bool, float, float]:
    """Return whether a vessel can hold `mass` (kg) and `energy` (J), with which P (Pa) and V_l (m3) near those given.

    From far away Newton's method may find none, or one beyond the critical point.
    """
    for _ in range(MAX_NEWTON_STEPS):
        c = content(separator, P, V_l, helium)
        more, hotter = mass - c.mass, energy - c.energy
        if abs(more) <= ROUNDING * mass and abs(hotter) <= 0.1 * LEAST_ENERGY + ROUNDING * abs(energy):
            return LEAST_PRESSURE < P < CRITICAL_PRESSURE, P, V_l
        determinant = c.M_P * c.U_V - c.M_V * c.U_P
        dP = (more * c.U_V - c.M_V * hotter) / determinant
        dV = (c.M_P * hotter - c.U_P * more) / determinant
        if (V_l < 0.0) == (V_l + dV < 0.0):
            P, V_l = P + dP, V_l + dV
        else:  # the bend between dry and wet: go there, and on with the other side's slopes
            P, V_l = P - V_l / dV * dP, 0.0 if V_l < 0.0 else -JUST_DRY
    return False, P, V_l
