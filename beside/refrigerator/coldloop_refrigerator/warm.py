"""The warm part: the nitrogen pre-cooler S3 (exchanger NEF6, nitrogen bath NEF5) and the compression station S4.

S4 is lines, buffer, two screw compressors, and the valves that move helium between them.

Lines and vessels have the temperature of their walls: lines, oil separators, coolers and adsorbers are steel of a
hundred times the gas's heat capacity. The mass is the state: what enters a circuit of such volumes is then what they
hold, to rounding. The compressors are oil-flooded, of fixed displacement, with efficiencies over the pressure ratio;
their gas is cooled to ambient.

Sizes are those of a station for the flow that the cold box takes, 93.4 g/s from 1.05 to 16 bar; `docs/refrigerator.md`
gives the reason of each. States, `STATION_STATES`: what the volumes hold and what was lost (kg), the speeds of the
compressors (share of the full one), the openings of the valves (%). The exchangers' passes belong to the high-pressure
line: its mass is theirs, too, and its pressure that of `coldloop_refrigerator.high_pressure`.

S3: states, `PRECOOLER_STATES`: the cells of NEF6 from the hot end on and the coil of NEF5 (K), the nitrogen in the bath
(kg), the opening of its feed valve CV167 (%).

Helium flows through the coil in nitrogen that boils at about atmospheric pressure. Saturated nitrogen at 1.05 bar boils
at 77.66 K with 198.8 kJ/kg and weighs 804.7 kg/m3; delivered at 2.5 bar and 80 K it brings 4.9 kJ/kg above the
saturated liquid, which flash off (CoolProp 8.0). The cold vapour leaves unused.

NEF6 is warm: the heat capacity of its helium is constant, and few cells are enough. The cells of `heat_exchanger` take
the mean of each as the driving temperature, so their number bounds how close the streams come: half the fall over a
cell, 14 K between 300 and 80 K with eight of them. Here each cell is itself a counter-flow exchanger: at rest, cells in
series are exactly one exchanger of the sum of their UA.
"""

from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant.components import expansion
from coldloop_plant.components.expansion import Actuator, ReliefValve, Valve
from coldloop_plant.components.heat_exchanger import STILL, TRICKLE, HeatExchanger, LowPressureFlow
from coldloop_plant.helium import GAS_CONSTANT, WARM_CP
from coldloop_plant.numeric import Array, at_least, at_most

SECOND_VIRIAL = 2.953e-3  # m3/kg, of helium at 300 K (CoolProp; 2.963e-3 at 290 K, 2.942e-3 at 310 K)


class GasVolume(NamedTuple):
    """A volume of helium at ambient temperature."""

    volume: float  # m3


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

    displacement: float  # Swept volume at full speed, m3/s
    filling: float  # Volumetric efficiency without a pressure rise, 0 to 1
    slip: float  # Loss of volumetric efficiency per unit of pressure ratio; leakage through the rotors' gaps
    isothermal: float  # Isothermal efficiency at the built-in pressure ratio, 0 to 1
    built_in_ratio: float  # Pressure ratio that the rotors' ports are made for
    mismatch: float  # Loss of isothermal efficiency per squared logarithm of the ratio over the built-in one
    motor: float  # Efficiency of the motor, 0 to 1


class Compression(NamedTuple):
    """Flow and power of a compressor."""

    mass_flow: float  # kg/s
    power: float  # Electrical power, W


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

    hp: GasVolume  # High-pressure line with oil separators, cooler and adsorber
    lp: GasVolume  # Low-pressure line
    buffer: GasVolume  # Medium-pressure vessel
    nc1: ScrewCompressor
    nc2: ScrewCompressor
    bypass: Valve  # CV956, from the high-pressure to the low-pressure line
    discharge: Valve  # CV952, from the high-pressure line to the buffer
    charge: Valve  # CV953, from the buffer to the low-pressure line
    actuator: Actuator  # Actuator of each of the three valves
    hp_relief: ReliefValve
    lp_relief: ReliefValve
    buffer_relief: ReliefValve
    cooler_approach: float  # Excess of the compressed gas's temperature over the surroundings, K
    run_up: float  # Time constant of a compressor that starts, s
    run_down: float  # The same for one that stops, s


@kernel
def station_rates(
    x: Array, HP: float, LP: float, P_buffer: float, to_box: float, from_box: float, T_ambient: float, leak: float,
    run: Array, station: CompressionStation, dx: Array, signals: Array,
) -> None:  # fmt: skip
    """Write the rates of the station's states but its valves into `dx` (9, per second), and flows and powers.

    Pressures in Pa. The cold box takes `to_box` (kg/s) out of line and passes, and returns `from_box` to the
    low-pressure line. `leak` is that from the high-pressure line into the air, kg/s when that is at `NOMINAL_HP`; `run`
    (2) is 1 for a compressor that is to run, 0 for one that is not. Into `signals` (7) go what passes the compressors,
    the bypass, the discharge and the charge valve and what leaves through relief valves and leak (g/s), the electrical
    power of the compressors, and the heat that the coolers give to the surroundings (kW).
    """
    T_hot = T_ambient + station.cooler_approach
    first = compress(station.nc1, x[4], LP, HP, T_ambient)
    second = compress(station.nc2, x[5], LP, HP, T_ambient)
    bypass = expansion.gas_valve_flow(station.bypass, x[6], HP, LP, T_hot)
    discharge = expansion.gas_valve_flow(station.discharge, x[7], HP, P_buffer, T_hot)
    charge = expansion.gas_valve_flow(station.charge, x[8], P_buffer, LP, T_ambient)
    hp_relief = expansion.relief_flow(station.hp_relief, HP, T_hot)
    lp_relief = expansion.relief_flow(station.lp_relief, LP, T_ambient)
    buffer_relief = expansion.relief_flow(station.buffer_relief, P_buffer, T_ambient)
    leaking = leak * HP / NOMINAL_HP
    compressed = first.mass_flow + second.mass_flow
    dx[0] = compressed - bypass - discharge - hp_relief - leaking - to_box
    dx[1] = from_box + bypass + charge - lp_relief - compressed
    dx[2] = discharge - charge - buffer_relief
    dx[3] = hp_relief + lp_relief + buffer_relief + leaking
    for i in range(2):
        rising = run[i] > x[4 + i].real
        dx[4 + i] = (run[i] - x[4 + i]) / (station.run_up if rising else station.run_down)
    power = first.power + second.power
    warmed = compressed * (WARM_CP * station.cooler_approach + SECOND_VIRIAL * (HP - LP))
    signals[0], signals[1], signals[2] = 1e3 * compressed, 1e3 * bypass, 1e3 * discharge
    signals[3], signals[4] = 1e3 * charge, 1e3 * dx[3]
    signals[5], signals[6] = 1e-3 * power, 1e-3 * at_least(power - warmed, 0.0)


BOILING_POINT = 77.66  # K
LATENT_HEAT = 198.8e3  # J/kg
LIQUID_DENSITY = 804.7  # kg/m3
FEED_EXCESS = 4.9e3  # J/kg
FEED_PRESSURE = 1.45e5  # Pa, from the tank to the bath
LEAST_FLOW = 1e-6  # kg/s
ROOM = 0.02  # share of the vessel that vapour needs to condense freely


class NitrogenBath(NamedTuple):
    """NEF5, its vessel and its feed valve."""

    UA: float  # UA of the wetted coil, W/K
    volume: float  # Volume of the vessel, m3
    wet_level: float  # Level (%) above which the whole coil is wet
    capacity: float  # Heat capacity of the coil and the helium in it at 80 K, J/K
    feed: Valve  # CV167, for liquid nitrogen


class Boiling(NamedTuple):
    """Heat and flows of the nitrogen bath."""

    heat: float  # Taken from the helium, W
    boil_off: float  # Vapour, kg/s
    feed: float  # Liquid delivered, kg/s


@kernel
def nitrogen_level(bath: NitrogenBath, mass: float) -> float:
    """Return the level (%, 0 to 100) of `mass` (kg) of nitrogen."""
    return at_most(at_least(100.0 * mass / (LIQUID_DENSITY * bath.volume), 0.0), 100.0)


@kernel
def boil(
    bath: NitrogenBath, mass: float, helium_flow: float, cp: float, T_in: float, T_coil: float, opening: float,
    supply: float,
) -> Boiling:  # fmt: skip
    """Return heat, boil-off and feed with `mass` (kg) of nitrogen in the bath and helium entering at `T_in` (K).

    Q = m cp (T_in - T_N) (1 - exp(-UA wet/(m cp))), `cp` in J/(kg K); as the helium comes to rest it is the heat of the
    coil itself, at `T_coil` (K). Heat to colder helium condenses vapour that the vent line gives back, where the vessel
    has room for it: less and less in the last of it (`ROOM`). The wet share of
    the coil grows smoothly with the level. `opening` (%) is that of the feed valve, `supply` 1 with nitrogen
    in the tank and 0 without. A full vessel takes no more than what boils off.
    """
    share = at_most(nitrogen_level(bath, mass) / bath.wet_level, 1.0)
    wet = share * share * (3.0 - 2.0 * share)
    capacity_flow = at_least(helium_flow, LEAST_FLOW) * cp
    heat = capacity_flow * (T_in - BOILING_POINT) * (1.0 - np.exp(-bath.UA * wet / capacity_flow))
    moving = at_least(at_most(helium_flow / STILL, 1.0), 0.0)
    if moving.real < 1.0:
        heat = moving * heat + (1.0 - moving) * bath.UA * wet * (T_coil - BOILING_POINT)
    if heat.real < 0.0:
        room = 1.0 - mass / (LIQUID_DENSITY * bath.volume)
        heat = heat * at_most(at_least(room / ROOM, 0.0), 1.0)
    feed = supply * expansion.effective_area(bath.feed, opening) * np.sqrt(2.0 * LIQUID_DENSITY * FEED_PRESSURE)
    if mass.real >= LIQUID_DENSITY * bath.volume:
        feed = at_most(feed, at_least(heat, 0.0) / (LATENT_HEAT - FEED_EXCESS))
    return Boiling(heat, (heat + feed * FEED_EXCESS) / LATENT_HEAT, feed)


SMALL = 1e-3
LARGEST_EXPONENT = 30.0


@kernel
def _decay(z: float) -> float:
    """Return (1 - exp(-z))/z, which is 1 at z = 0."""
    if abs(z.real) < SMALL:
        return 1.0 - z * (0.5 - z * (1.0 / 6.0 - z / 24.0))
    decay: float = (1.0 - np.exp(-z)) / z
    return decay


@kernel
def exchanged_heat(UA: float, C_high: float, C_low: float, difference: float) -> float:
    """Return the heat (W) between two counter-flowing streams of heat capacity flows `C_high` and `C_low` (W/K).

    `difference` (K) is that of the two temperatures at which they enter. The closed solution of the two energy
    balances, written so that it is smooth where both capacity flows are equal: Q = dT g/(1/UA + g/C_high), g = (1 -
    exp(-z))/z, z = UA (1/C_low - 1/C_high).
    """
    unbalance = 1.0 / C_low - 1.0 / C_high
    if abs(UA * unbalance.real) > LARGEST_EXPONENT:
        UA = LARGEST_EXPONENT / abs(unbalance.real)  # a longer one exchanges no more
    g = _decay(UA * unbalance)
    return difference * g / (1.0 / UA + g / C_high)


@kernel
def transfer_warm(
    exchanger: HeatExchanger, T: Array, T_hot: float, flows: Array, low: LowPressureFlow, heat: Array
) -> LowPressureFlow:
    """Write what each cell gives to the low-pressure gas into `heat` (W) and return that gas at the hot end.

    `T` holds the temperature at which the high-pressure gas leaves each cell, hot end first (K), and of its wall;
    `T_hot` (K) is that at which it enters the first one, `flows` (kg/s) what enters each. As that flow comes to rest,
    the low-pressure gas takes its heat from the wall.
    """
    UA = exchanger.UA / exchanger.cells
    swept = at_least(low.mass_flow, TRICKLE)
    C_low, sweeping = swept * WARM_CP, at_most(low.mass_flow / TRICKLE, 1.0)
    T_low, h_low = low.T, low.h
    for i in range(exchanger.cells - 1, -1, -1):
        T_before = T[i - 1] if i > 0 else T_hot
        given = exchanged_heat(UA, at_least(flows[i], TRICKLE) * WARM_CP, C_low, T_before - T_low)
        if flows[i].real < STILL:
            moving = at_least(flows[i] / STILL, 0.0)
            by_wall = (1.0 - moving) * C_low * (1.0 - np.exp(-2.0 * UA / C_low))
            given = sweeping * (moving * given + by_wall * (T[i] - T_low))
        heat[i] = given
        T_low = T_low + given / C_low
        h_low = h_low + given / swept
    return LowPressureFlow(low.mass_flow, low.P, T_low, h_low)


NEF6_CELLS: Final = 8
PRECOOLER_STATES: Final = (*(f"T_nef6_{i}" for i in range(1, NEF6_CELLS + 1)), "T_nef5", "M_N2", "CV167")
PRECOOLER_STATE_UNITS: Final = (*["K"] * (NEF6_CELLS + 1), "kg", "%")


class Precooler(NamedTuple):
    """Components of S3, in SI units."""

    nef6: HeatExchanger  # From ambient temperature to the nitrogen bath
    nef5: NitrogenBath  # The bath
    actuator: Actuator  # Actuator of CV167


class Precooling(NamedTuple):
    """Flows of the pre-cooler."""

    warm_end: LowPressureFlow  # The low-pressure flow as it leaves for the compressors
    boiling: Boiling


@kernel
def precooler_flows(
    x: Array, T_hot: float, flows: Array, low: LowPressureFlow, supply: float, precooler: Precooler, dx: Array
) -> Precooling:
    """Write the rate of the nitrogen into `dx` (11, per second); return what the pre-cooler does.

    In the place of the rates of the exchangers' temperatures is the heat that they give (W). `T_hot` (K) is that of the
    helium from the compressors, `flows` (9, kg/s) are those of high-pressure helium into each cell of NEF6 and through
    the coil, `low` comes from the cold box, `supply` is 1 with nitrogen in the tank and 0 without.
    """
    cells = precooler.nef6.cells
    warm_end = transfer_warm(precooler.nef6, x[:cells], T_hot, flows[:cells], low, dx[:cells])
    boiling = boil(precooler.nef5, x[cells + 1], flows[cells], WARM_CP, x[cells - 1], x[cells], x[cells + 2], supply)
    dx[cells] = boiling.heat
    dx[cells + 1] = boiling.feed - boiling.boil_off
    return Precooling(warm_end, boiling)
