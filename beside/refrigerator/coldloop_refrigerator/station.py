"""The warm compression station, S4: lines, buffer, two screw compressors, and the valves that move helium between them.

Lines and vessels have the temperature of their walls: lines, oil separators, coolers and adsorbers are steel of a
hundred times the gas's heat capacity. The mass is the state: what enters a circuit of such volumes is then what they
hold, to rounding. The compressors are oil-flooded, of fixed displacement, with efficiencies over the pressure ratio;
their gas is cooled to ambient.

Sizes are those of a station for the flow that the cold box takes, 93.4 g/s from 1.05 to 16 bar; `docs/refrigerator.md`
gives the reason of each. States, `STATION_STATES`: what the volumes hold and what was lost (kg), the speeds of the
compressors (share of the full one), the openings of the valves (%). The exchangers' passes belong to the high-pressure
line: its mass is theirs, too, and its pressure that of `coldloop_refrigerator.high_pressure`.
"""

from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.expansion import Actuator, ReliefValve, Valve, gas_valve_flow, relief_flow
from coldloop_plant.helium import GAS_CONSTANT, WARM_CP
from coldloop_plant.numeric import Array, at_least

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


LEAST_EFFICIENCY = 0.15  # isothermal, far from the built-in ratio


class ScrewCompressor(NamedTuple):
    """A screw compressor with its motor, at fixed speed."""

    displacement: float
    """Swept volume at full speed, m3/s."""
    filling: float
    """Volumetric efficiency without a pressure rise, 0 to 1."""
    slip: float
    """Loss of volumetric efficiency per unit of pressure ratio; leakage through the rotors' gaps."""
    isothermal: float
    """Isothermal efficiency at the built-in pressure ratio, 0 to 1."""
    built_in_ratio: float
    """Pressure ratio that the rotors' ports are made for."""
    mismatch: float
    """Loss of isothermal efficiency per squared logarithm of the ratio over the built-in one."""
    motor: float
    """Efficiency of the motor, 0 to 1."""


class Compression(NamedTuple):
    """Flow and power of a compressor."""

    mass_flow: float
    """kg/s."""
    power: float
    """Electrical power, W."""


@kernel
def compress(compressor: ScrewCompressor, speed: float, P_in: float, P_out: float, T_in: float) -> Compression:
    """Return flow and power at a share `speed` of the full one, from `P_in` to `P_out` (Pa), suction at `T_in` (K).

    m = s V_d rho eta_v(r) with eta_v = filling - slip (r - 1); P = m R T ln r / (eta_iso(r) eta_motor), with
    eta_iso = isothermal - mismatch ln(r / built-in)^2. A check valve keeps gas from flowing back.
    """
    ratio = at_least(P_out / at_least(P_in, 1.0), 1.0)
    volumetric = at_least(compressor.filling - compressor.slip * (ratio - 1.0), 0.0)
    mass_flow = at_least(speed, 0.0) * compressor.displacement * gas_density(P_in, T_in) * volumetric
    detuned = np.log(ratio / compressor.built_in_ratio)
    efficiency = at_least(compressor.isothermal - compressor.mismatch * detuned * detuned, LEAST_EFFICIENCY)
    power = mass_flow * GAS_CONSTANT * T_in * np.log(ratio) / (efficiency * compressor.motor)
    return Compression(mass_flow, power)


STATION_STATES: Final = ("M_HP", "M_LP", "M_buffer", "M_lost", "NC1", "NC2", "CV956", "CV952", "CV953")
STATION_STATE_UNITS: Final = (*["kg"] * 4, "1", "1", "%", "%", "%")
NOMINAL_HP: Final = 16e5
"""Pressure (Pa) at which a leak has the flow that it is described by."""


class CompressionStation(NamedTuple):
    """Components of S4, in SI units."""

    hp: GasVolume
    """High-pressure line with oil separators, cooler and adsorber."""
    lp: GasVolume
    """Low-pressure line."""
    buffer: GasVolume
    """Medium-pressure vessel."""
    nc1: ScrewCompressor
    nc2: ScrewCompressor
    bypass: Valve
    """CV956, from the high-pressure to the low-pressure line."""
    discharge: Valve
    """CV952, from the high-pressure line to the buffer."""
    charge: Valve
    """CV953, from the buffer to the low-pressure line."""
    actuator: Actuator
    """Actuator of each of the three valves."""
    hp_relief: ReliefValve
    lp_relief: ReliefValve
    buffer_relief: ReliefValve
    cooler_approach: float
    """Excess of the compressed gas's temperature over the surroundings, K."""
    run_up: float
    """Time constant of a compressor that starts, s."""
    run_down: float
    """The same for one that stops, s."""


class Pressures(NamedTuple):
    """Pressures of the three volumes, Pa."""

    HP: float
    LP: float
    buffer: float


@kernel
def station_pressures(HP: float, x: Array, station: CompressionStation, T_ambient: float) -> Pressures:
    """Return the high pressure `HP` (Pa) and those that follow from the masses in `x` (9, `STATION_STATES`)."""
    return Pressures(HP, gas_pressure(station.lp, x[1], T_ambient), gas_pressure(station.buffer, x[2], T_ambient))


class StationFlows(NamedTuple):
    """Mass flows (kg/s) and powers (W) of the station."""

    compressed: float
    """Through both compressors."""
    bypass: float
    discharge: float
    charge: float
    out: float
    """Through the three relief valves and the leak."""
    power: float
    """Electrical, of both compressors."""
    cooling: float
    """Heat that the coolers give to the surroundings."""


@kernel
def station_rates(
    x: Array, P: Pressures, to_box: float, from_box: float, T_ambient: float, leak: float, run: Array,
    station: CompressionStation, dx: Array,
) -> StationFlows:  # fmt: skip
    """Write the rates of the station's states but its valves into `dx` (9, per second) and return the flows.

    The cold box takes `to_box` (kg/s) out of line and passes, and returns `from_box` to the low-pressure line. `leak`
    is that from the high-pressure line into the air, kg/s when that is at `NOMINAL_HP`; `run` (2) is 1 for a compressor
    that is to run, 0 for one that is not.
    """
    T_hot = T_ambient + station.cooler_approach
    first = compress(station.nc1, x[4], P.LP, P.HP, T_ambient)
    second = compress(station.nc2, x[5], P.LP, P.HP, T_ambient)
    bypass = gas_valve_flow(station.bypass, x[6], P.HP, P.LP, T_hot)
    discharge = gas_valve_flow(station.discharge, x[7], P.HP, P.buffer, T_hot)
    charge = gas_valve_flow(station.charge, x[8], P.buffer, P.LP, T_ambient)
    hp_relief = relief_flow(station.hp_relief, P.HP, T_hot)
    lp_relief = relief_flow(station.lp_relief, P.LP, T_ambient)
    buffer_relief = relief_flow(station.buffer_relief, P.buffer, T_ambient)
    leaking = leak * P.HP / NOMINAL_HP
    compressed = first.mass_flow + second.mass_flow
    dx[0] = compressed - bypass - discharge - hp_relief - leaking - to_box
    dx[1] = from_box + bypass + charge - lp_relief - compressed
    dx[2] = discharge - charge - buffer_relief
    dx[3] = hp_relief + lp_relief + buffer_relief + leaking
    for i in range(2):
        rising = run[i] > x[4 + i].real
        dx[4 + i] = (run[i] - x[4 + i]) / (station.run_up if rising else station.run_down)
    power = first.power + second.power
    warmed = compressed * (WARM_CP * station.cooler_approach + SECOND_VIRIAL * (P.HP - P.LP))
    return StationFlows(compressed, bypass, discharge, charge, dx[3], power, at_least(power - warmed, 0.0))
