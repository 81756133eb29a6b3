"""The warm compression station, S4: lines, buffer, two screw compressors, and the valves that move helium between them.

Sizes are those of a station for the flow that the cold box takes, 93.4 g/s from 1.05 to 16 bar; `docs/refrigerator.md`
gives the reason of each. States, `STATION_STATES`: what the volumes hold and what was lost (kg), the speeds of the
compressors (share of the full one), the openings of the valves (%). The exchangers' passes belong to the high-pressure
line: its mass is theirs, too, and its pressure that of `coldloop_plant.refrigerator.high_pressure`.
"""

from typing import Final, NamedTuple

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.actuator import Actuator, check_actuator
from coldloop_plant.components.gas_valve import (
    ReliefValve,
    check_gas_valve,
    check_relief_valve,
    gas_valve_flow,
    relief_flow,
)
from coldloop_plant.components.gas_volume import SECOND_VIRIAL, GasVolume, check_gas_volume, gas_pressure
from coldloop_plant.components.parameters import require
from coldloop_plant.components.screw_compressor import ScrewCompressor, check_screw_compressor, compress
from coldloop_plant.components.valve import Valve
from coldloop_plant.helium.properties import WARM_CP
from coldloop_plant.numeric import Array, at_least

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
    """Of each of the three valves."""
    hp_relief: ReliefValve
    lp_relief: ReliefValve
    buffer_relief: ReliefValve
    cooler_approach: float
    """By how much the compressed gas is warmer than the surroundings, K."""
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
    return Pressures(
        HP,
        gas_pressure(station.lp, x[1], T_ambient),
        gas_pressure(station.buffer, x[2], T_ambient),
    )


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
    x: Array,
    P: Pressures,
    to_box: float,
    from_box: float,
    T_ambient: float,
    leak: float,
    run: Array,
    station: CompressionStation,
    dx: Array,
) -> StationFlows:
    """Write the rates of the station's states but its valves into `dx` (9, per second) and return the flows.

    Args:
        x: States, `STATION_STATES`.
        P: From `station_pressures`.
        to_box: What the cold box takes out of line and passes, kg/s.
        from_box: What it returns to the low-pressure line, kg/s.
        T_ambient: K.
        leak: From the high-pressure line into the air, kg/s when that is at 16 bar.
        run: 1 for a compressor that is to run, 0 for one that is not.
        station: Parameters.
        dx: Rates.
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


def check_station(station: CompressionStation) -> None:
    """Refuse parameters that no station has (`ParameterError`)."""
    for name in ("hp", "lp", "buffer"):
        check_gas_volume(name, getattr(station, name))
    for name in ("nc1", "nc2"):
        check_screw_compressor(name, getattr(station, name))
    for name in ("bypass", "discharge", "charge"):
        check_gas_valve(name, getattr(station, name))
    check_actuator("actuator", station.actuator)
    for name in ("hp_relief", "lp_relief", "buffer_relief"):
        check_relief_valve(name, getattr(station, name))
    require("station", "cooler_approach", station.cooler_approach, -1e-12, 50.0)
    require("station", "run_up", station.run_up, 0.499999, 600.0)
    require("station", "run_down", station.run_down, 0.499999, 600.0)
